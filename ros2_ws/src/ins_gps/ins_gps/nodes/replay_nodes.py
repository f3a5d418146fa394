# SPDX-License-Identifier: Apache-2.0
"""Nodes that publish a prepared series in its own time: the simulator and RINEX files."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from ins_gps import codec
from ins_gps.observations import EpochBuilder
from ins_gps.params import RinexParams, SimulatorParams
from ins_gps.rinex import RinexError, read_navigation, read_observations
from ins_gps.scenarios import scenario_of, truth_estimate
from ins_gps.simulation_gnss import simulate
from kalman_core.parameters import ParameterError
from node_core.diagnostics import OK, WARN, status
from node_core.node import WorkspaceNode

NANOSECONDS = 1_000_000_000
_TICK = 0.002  # s; each sample still has its own deadline


class SeriesNode(WorkspaceNode):
    """Publishes (due time ns, publish callable) pairs in order, on the steady clock."""

    def __init__(self, name: str, params: type) -> None:
        super().__init__(name, params)
        self._series: list[tuple[int, Any]] = []
        self._next = 0
        self._speed = 1.0
        self._started = 0

    def begin(self, series: list[tuple[int, Any]], speed: float) -> None:
        """Start publishing; times are relative to the first."""
        self._series, self._speed = series, speed
        self._started = time.monotonic_ns()
        self.create_timer(_TICK, self._publish_due, clock=self.steady_clock)

    def _publish_due(self) -> None:
        if self._next >= len(self._series):
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


class UavSimulatorNode(SeriesNode):
    """Publishes IMU, GNSS observations and truth of one scenario, stamped from now on."""

    def __init__(self) -> None:
        super().__init__('uav_simulator', SimulatorParams)
        params = self.parameters[SimulatorParams]
        now = self.get_clock().now().nanoseconds or time.time_ns()
        run = simulate(scenario_of(params, now), params.seed)
        imu, self._imu = self.publish_to(codec.IMU, 'imu/data_raw')
        gnss, self._gnss = self.publish_to(codec.CLOUD, 'gnss/observations')
        truth, self._truth = self.publish_to(codec.ODOMETRY, 'truth/odometry')
        self._publish_imu, self._publish_gnss, self._publish_truth = imu.publish, gnss.publish, truth.publish
        series = []
        for index, sample in enumerate(run.imu_samples()):
            series.append((sample.stamp, self._send_imu(sample)))
            estimate = truth_estimate(run, index + 1)
            series.append((sample.stamp, self._send_truth(estimate)))
        for epoch in run.epochs:
            series.append((epoch.stamp, self._send_gnss(epoch)))
        series.sort(key=lambda item: item[0])
        self.get_logger().info(f"'{params.trajectory}' for {params.duration:g} s, seed {params.seed}")
        self.begin(series, params.speed)

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


class RinexDriverNode(SeriesNode):
    """Publishes the epochs of an observation file."""

    def __init__(self) -> None:
        super().__init__('rinex_driver', RinexParams)
        params = self.parameters[RinexParams]
        try:
            observations = read_observations(params.observations)
            files = [read_navigation(p.strip()) for p in params.navigation.split(',') if p.strip()]
        except RinexError as error:
            raise ParameterError(str(error)) from error
        if not files:
            raise ParameterError("parameter 'navigation' is empty, expected a RINEX navigation file")
        coefficients = next((f.klobuchar for f in files if math.isfinite(f.klobuchar.sum())), None)
        leap = params.leap_seconds if params.time_scale == 'utc' else 0
        ephemerides = np.vstack([f.ephemerides for f in files])
        builder = EpochBuilder(ephemerides, coefficients, atmosphere=params.atmosphere, leap=leap)
        publisher, self._message = self.publish_to(codec.CLOUD, params.topic)
        self._publish, self._frame = publisher.publish, params.frame
        epochs = [builder.build(raw) for raw in observations.epochs]
        if not epochs:
            raise ParameterError(f"parameter 'observations': {params.observations} has no epochs")
        self.get_logger().info(f'{len(epochs)} epochs of {params.observations}')
        self.begin([(epoch.stamp, self._send(epoch)) for epoch in epochs], params.speed)

    def _send(self, epoch):
        def send() -> None:
            codec.encode_observations(epoch, self._message, self._frame)
            self._publish(self._message)

        return send
