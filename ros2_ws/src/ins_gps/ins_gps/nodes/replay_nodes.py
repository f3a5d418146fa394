# SPDX-License-Identifier: Apache-2.0
"""Nodes that publish a prepared series in its own time: the simulator and RINEX files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from ins_gps import codec
from ins_gps.observations import EpochBuilder
from ins_gps.params import RinexParams, SimulatorParams
from ins_gps.rinex import RawEpoch, RinexError, read_navigation, read_observations
from ins_gps.samples import GnssEpoch, ReceiverFix
from ins_gps.scenarios import restamped, scenario_of, truth_estimate
from ins_gps.simulation_gnss import simulate
from kalman_core.earth import geodetic_from_ecef
from kalman_core.parameters import ParameterError
from node_core.byte_node import LAST_WORDS, SourceNode
from node_core.diagnostics import OK, WARN, status
from node_core.node import WorkspaceNode

# A header's position is called approximate: receivers write a fix of their own into it.
_HEADER_SIGMA = 5.0  # m
_APPROXIMATED = 1  # NavSatFix.COVARIANCE_TYPE_APPROXIMATED
_TICK = 0.002  # s; each sample still has its own deadline


class UavSimulatorNode(WorkspaceNode):
    """Publishes IMU, GNSS observations and truth of one scenario, stamped from now on."""

    def __init__(self) -> None:
        super().__init__('uav_simulator', SimulatorParams)
        params = self.parameters[SimulatorParams]
        now = self.get_clock().now().nanoseconds or time.time_ns()
        run = simulate(scenario_of(params, now), params.seed)
        # Making the run takes seconds, by which its stamps would be late; the paper's keep their own time.
        if run.stamps[0] == now:
            run = restamped(run, self.get_clock().now().nanoseconds or time.time_ns())
        imu, self._imu = self.publish_to(codec.IMU, 'imu/data_raw')
        gnss, self._gnss = self.publish_to(codec.CLOUD, 'gnss/observations')
        truth, self._truth = self.publish_to(codec.ODOMETRY, 'truth/odometry')
        self._publish_imu, self._publish_gnss, self._publish_truth = imu.publish, gnss.publish, truth.publish
        self._sent_by = (imu, gnss, truth)
        series: list[tuple[int, Any]] = []
        for index, sample in enumerate(run.imu_samples()):
            series.append((sample.stamp, self._send_imu(sample)))
            estimate = truth_estimate(run, index + 1)
            series.append((sample.stamp, self._send_truth(estimate)))
        for epoch in run.epochs:
            series.append((epoch.stamp, self._send_gnss(epoch)))
        series.sort(key=lambda item: item[0])
        self.get_logger().info(f"'{params.trajectory}' for {params.duration:g} s, seed {params.seed}")
        self._series, self._speed = series, params.speed
        self._next, self._started = 0, time.monotonic_ns()
        self.create_timer(_TICK, self._publish_due, clock=self.steady_clock)

    def _send_imu(self, sample):
        def send() -> None:
            codec.encode_imu(sample, self._imu)
            self._publish_imu(self._imu)

        return send

    def _send_truth(self, estimate):
        def send() -> None:
            codec.encode_odometry(estimate, self._truth)
            self._publish_truth(self._truth)

        return send

    def _send_gnss(self, epoch):
        def send() -> None:
            codec.encode_observations(epoch, self._gnss)
            self._publish_gnss(self._gnss)

        return send

    def _publish_due(self) -> None:
        if self._next >= len(self._series):
            for publisher in self._sent_by:
                publisher.wait_for_all_acked(LAST_WORDS)
            raise SystemExit(0)
        due = self._series[0][0] + (time.monotonic_ns() - self._started) * self._speed
        while self._next < len(self._series) and self._series[self._next][0] <= due:
            self._series[self._next][1]()
            self._next += 1

    def diagnose(self) -> DiagnosticArray:
        """Report how much was published."""
        done = self._next
        level, text = (OK, 'ok') if done else (WARN, 'nothing published yet')
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, {'messages': done})])


class Epochs:
    """Gives the epochs of an observation file one by one."""

    def __init__(self, epochs: list[RawEpoch]) -> None:
        self._epochs = iter(epochs)

    def read(self) -> RawEpoch | None:
        """Return the next epoch, None at the end."""
        return next(self._epochs, None)

    def close(self) -> None:
        """Nothing is held open."""


class RinexDriverNode(SourceNode):
    """Publishes the epochs of an observation file, each with the header's position of the antenna."""

    what = 'epoch'
    params: RinexParams

    def __init__(self) -> None:
        super().__init__('rinex_driver', RinexParams)
        params = self.params
        for name in ('observations', 'navigation'):
            if not getattr(params, name).strip(' ,'):
                raise ParameterError(f"parameter '{name}' is empty, expected the path of a RINEX file")
        self._observations = self._load('observations', read_observations, params.observations)
        names = [name.strip() for name in params.navigation.split(',') if name.strip()]
        files = [self._load('navigation', read_navigation, name) for name in names]
        coefficients = next((f.klobuchar for f in files if math.isfinite(f.klobuchar.sum())), None)
        leap = params.leap_seconds if params.time_scale == 'utc' else 0
        self._builder = EpochBuilder(
            np.vstack([f.ephemerides for f in files]), coefficients, atmosphere=params.atmosphere, leap=leap
        )
        if not self._observations.epochs:
            raise ParameterError(f"parameter 'observations': {params.observations} has no epochs")
        epochs, self._message = self.publish_to(codec.CLOUD, params.topic)
        publishers = [epochs]
        self._publish, self._publish_position = epochs.publish, None
        if params.position_topic:
            positions, self._position = self.publish_to(codec.FIX, params.position_topic)
            self._publish_position = positions.publish
            publishers.append(positions)
            if not np.isfinite(self._observations.position).all() or not self._observations.position.any():
                raise ParameterError(f"parameter 'position_topic': {params.observations} has no position")
        self.begin(params.observations, *publishers, recorded=True)

    @staticmethod
    def _load(name: str, reader: Callable[[str], Any], path: str) -> Any:
        try:
            return reader(path)
        except RinexError as error:
            raise ParameterError(f"parameter '{name}': {error}") from error

    def open(self) -> Epochs:
        """Return the epochs of the file."""
        return Epochs(self._observations.epochs)

    def samples(self, item: RawEpoch, arrival: int) -> Iterable[GnssEpoch]:
        """Add satellite states."""
        return (self._builder.build(item),)

    def publish(self, sample: GnssEpoch) -> bool:
        """Publish an epoch, after the position that goes with it."""
        if self._publish_position is not None:
            geodetic = np.array(geodetic_from_ecef(self._observations.position))
            fix = ReceiverFix(sample.stamp, geodetic, _HEADER_SIGMA**2 * np.eye(3), 0, _APPROXIMATED)
            codec.encode_receiver_fix(fix, self._position, self.params.frame)
            self._publish_position(self._position)
        codec.encode_observations(sample, self._message, self.params.frame)
        self._publish(self._message)
        return True
