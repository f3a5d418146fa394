# SPDX-License-Identifier: Apache-2.0
"""The node that publishes a simulated car's sensors, the truth, and its CAN frames."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from ev_velocity.can_frames import CarOnCan
from ev_velocity.codec import JOINTS
from ev_velocity.drive_messages import DriveMessages
from ev_velocity.scenarios import RATE
from ev_velocity.sim_params import SimulatorParams
from ev_velocity.simulation import named
from kalman_core.parameters import ParameterError
from node_core.diagnostics import OK, WARN, status
from node_core.message_types import message_class
from node_core.messages import set_floats, set_stamp
from node_core.node import WorkspaceNode

TRUTH_EVERY = 1  # 500 Hz: the optical speed sensor
REFERENCE_PULSES = 1000  # of the reference encoder, per turn
CAN_EVERY = 10  # 50 Hz
# After a longer pause of the machine old samples are left out: nobody waits for them.
LONGEST_BURST = 1_000_000_000  # ns


class VehicleSimulatorNode(WorkspaceNode):
    """Every message has its own deadline on the steady clock, so that the rate cannot drift."""

    def __init__(self) -> None:
        super().__init__('vehicle_simulator', SimulatorParams)
        self._params = params = self.parameters[SimulatorParams]
        self._bus = self._open_bus(params)
        self._by_topic: dict[str, Any] = {}
        for topic, kind in DriveMessages.topics:
            self._by_topic[topic], _ = self.publish_to(kind, topic.lstrip('/'))
        self._reference_publisher, self._reference = self.publish_to(JOINTS, 'truth/encoder')
        self._reference.name = ['encoder']
        self._start = self.get_clock().now().nanoseconds or time.time_ns()
        self._offset = time.monotonic_ns() - self._start
        self._sent = self._skipped = self._skipped_before = 0
        self._begin()
        self.create_timer(1.0 / RATE, self._publish_due, clock=self.steady_clock)
        self.get_logger().info(f"'{params.scenario}', seed {params.seed}")

    def _open_bus(self, params: SimulatorParams) -> CarOnCan | None:
        if not params.can_interface:
            return None
        try:
            return CarOnCan(params.can_interface, params.can_channel)
        except Exception as error:  # python-can's interfaces raise whatever their libraries do
            text = f"can_interface '{params.can_interface}', can_channel '{params.can_channel}': {error}"
            raise ParameterError(text) from None

    def _begin(self) -> None:
        drive = named(self._params.scenario, self._params.seed, self._params.duration)
        self._drive = drive
        turned = np.cumsum(drive.wheel_speed) / RATE / (2.0 * np.pi * 0.285) * REFERENCE_PULSES
        self._pulses = np.floor(turned) * (2.0 * np.pi / REFERENCE_PULSES)
        messages = DriveMessages(drive, lambda kind: message_class(kind)(), self._start, TRUTH_EVERY)
        self._events: Iterator[tuple[int, str, Any]] = iter(messages)
        self._next = next(self._events)
        self._end = self._start + round(float(drive.t[-1]) * 1e9)

    def _publish_due(self) -> None:
        now = time.monotonic_ns() - self._offset
        while self._next[0] <= now:
            stamp, topic, message = self._next
            if now - stamp > LONGEST_BURST:
                self._skipped += 1
            else:
                self._by_topic[topic].publish(message)
                self._sent += 1
                if topic == '/truth/velocity':
                    self._publish_wheel(stamp)
            following = next(self._events, None)
            if following is None:
                if not self._params.loop:
                    self.get_logger().info('the drive is over')
                    self._next = (2**63, '', None)
                    return
                self._start = self._end + round(1e9 / RATE)
                self._begin()
                return
            self._next = following

    def _publish_wheel(self, stamp: int) -> None:
        index = min(round((stamp - self._start) * 1e-9 * RATE), self._pulses.size - 1)
        set_stamp(self._reference.header, stamp)
        set_floats(self._reference, 'position', [float(self._pulses[index])])
        self._reference_publisher.publish(self._reference)
        if self._bus is not None and index % CAN_EVERY == 0:
            drive = self._drive
            self._bus.send(
                speed=float(drive.wheel_speed[index]),
                accelerator=float(drive.accelerator[index]),
                brake=float(drive.brake[index]),
            )

    def destroy_node(self) -> None:
        """Close the bus with the node."""
        if self._bus is not None:
            self._bus.close()
        super().destroy_node()

    def diagnose(self) -> DiagnosticArray:
        """Report what was published and what was left out."""
        skipped = self._skipped - self._skipped_before
        self._skipped_before = self._skipped
        text = f'{skipped} messages left out: the machine was busy or asleep' if skipped else 'ok'
        values = {'messages': self._sent, 'skipped': self._skipped, 'seed': self._params.seed}
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, WARN if skipped else OK, text, values)])
