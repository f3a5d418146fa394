# SPDX-License-Identifier: Apache-2.0
"""The node around the simulator: plays a simulated run in real time, over and over with new seeds."""

from __future__ import annotations

import time
from dataclasses import asdict, fields, replace
from typing import Any

from kalman_core.parameters import ParameterError
from node_core.node import WorkspaceNode
from ship_inclinometer.recording import TYPES, events, fill
from ship_inclinometer.simulation import SimulatorParams, scenario, simulate
from ship_inclinometer.simulation_params import PlayParams


class ShipSimulatorNode(WorkspaceNode):
    """Publishes imu/data_raw, imu/mag, gnss/velocity, log/speed and truth/orientation."""

    def __init__(self) -> None:
        super().__init__('ship_simulator', PlayParams, SimulatorParams)
        self._play = self.parameters[PlayParams]
        self._params = self._merged()
        self._seed = self._play.seed
        self._outputs = {topic: self.publish_to(kind, topic) for topic, kind in TYPES.items()}
        self._begin()
        self.create_timer(0.002, self._step, clock=self.steady_clock)
        self.get_logger().info(f'scenario {self._play.scenario}, seed {self._seed}')

    def _merged(self) -> SimulatorParams:
        """Return the scenario with what was given beside it: parameters that differ from their default."""
        given = asdict(self.parameters[SimulatorParams])
        changes = {f.name: given[f.name] for f in fields(SimulatorParams) if given[f.name] != f.default}
        changes = {n: tuple(v) if isinstance(v, list) else v for n, v in changes.items()}
        try:
            return replace(scenario(self._play.scenario), **changes)
        except ValueError as error:
            raise ParameterError(str(error)) from error

    def _begin(self) -> None:
        self._recording = simulate(self._params, self._seed)
        self._start = self.get_clock().now().nanoseconds
        self._begun = time.monotonic_ns()
        self._events = events(self._recording, self._start)
        self._next: Any = next(self._events, None)

    def _step(self) -> None:
        elapsed = round((time.monotonic_ns() - self._begun) * self._play.time_factor)
        while self._next is not None and self._next[0] - self._start <= elapsed:
            stamp, topic, index = self._next
            publisher, message = self._outputs[topic]
            fill(self._recording, topic, index, stamp, message)
            publisher.publish(message)
            self._next = next(self._events, None)
        if self._next is None:
            self._seed += 1
            self._begin()
            self.get_logger().info(f'next run, seed {self._seed}')
