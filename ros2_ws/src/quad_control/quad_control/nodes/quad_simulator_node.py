# SPDX-License-Identifier: Apache-2.0
"""The simulated craft as a node: motor commands in, IMU, range, battery and truth out."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from node_core.diagnostics import OK, WARN, Timings, status
from node_core.node import WorkspaceNode
from node_core.ports import BadMessage
from quad_control import codec
from quad_control.craft import SimulatorParams
from quad_control.simulation import QuadSimulator

_RANGE_RATE, _BATTERY_RATE = 20.0, 5.0  # Hz
# In lock-step, a command that does not come within this time (s) counts as lost and time goes on.
_LOST = 5.0
# After a longer pause of the machine the missed time is not caught up with (s).
_LONGEST_BURST = 0.1


class QuadSimulatorNode(WorkspaceNode):
    """`realtime`: samples on a steady clock. `lockstep`: each motor command asks for the next sample."""

    def __init__(self) -> None:
        super().__init__('quad_simulator', SimulatorParams)
        self._params = p = self.parameters[SimulatorParams]
        self._craft = QuadSimulator(p, p, rate=p.rate, seed=p.seed, roll=p.start_roll, height=p.start_height)
        self._imu = self.publish_to(codec.IMU, 'imu/data_raw')
        self._truth = self.publish_to(codec.ODOMETRY, 'truth/odometry')
        self._range = self.publish_to(codec.RANGE, 'range')
        self._battery = self.publish_to(codec.BATTERY, 'battery')
        # Stamps follow the node's clock in real time, so that other sensors may join.
        self._offset = 0 if p.pace == 'lockstep' else self.get_clock().now().nanoseconds - self._craft.stamp
        self._pulses: tuple | None = None
        self._samples = 0
        self._lost = 0
        self._late = 0.0
        self._round_trips = Timings()
        self._sent: dict[int, int] = {}
        self._craft.sense()  # loads the kernels before anything listens
        self._started = time.monotonic()
        self.listen(codec.JOINTS, 'motors/command', self._on_command)
        period = _LOST / 10.0 if p.pace == 'lockstep' else 1.0 / p.rate
        self.create_timer(period, self._on_timer, clock=self.steady_clock)
        self.get_logger().info(
            f'{p.pace} at {p.rate:g} Hz, {"pinned" if p.pinned else "free"}, seed {p.seed}'
        )

    def _sense(self) -> None:
        sample = self._craft.sense()
        stamp = sample.stamp + self._offset
        self._put(self._imu, codec.encode_imu, sample._replace(stamp=stamp))
        self._sent[stamp] = time.monotonic_ns()
        self._put(self._truth, codec.encode_truth, self._craft.truth()._replace(stamp=stamp))
        rate = self._params.rate
        if self._samples % round(rate / _RANGE_RATE) == 0:
            self._put(self._range, codec.encode_range, self._craft.range()._replace(stamp=stamp))
        if self._samples % round(rate / _BATTERY_RATE) == 0:
            self._put(self._battery, codec.encode_battery, self._craft.battery()._replace(stamp=stamp))
        self._samples += 1

    @staticmethod
    def _put(output: tuple, encode: Any, sample: Any) -> None:
        publisher, message = output
        encode(sample, message)
        publisher.publish(message)

    def _on_command(self, message: Any) -> None:
        try:
            stamp, self._pulses = codec.decode_motors(message)
        except BadMessage as error:
            self.get_logger().warning(f'motor command rejected: {error}', throttle_duration_sec=1.0)
            return
        sent = self._sent.pop(stamp, None)
        if sent is None:
            return
        self._round_trips.add(time.monotonic_ns() - sent)
        if self._params.pace == 'lockstep':
            self._advance()

    def _on_timer(self) -> None:
        if self._params.pace == 'lockstep':
            if not self._samples:
                # The first sample must not be lost: wait until both ends of the loop are there.
                topic = self.resolve_topic_name('motors/command')
                if self._imu[0].get_subscription_count() and self.count_publishers(topic):
                    self._sense()
            elif self._sent and time.monotonic_ns() - max(self._sent.values()) > _LOST * 1e9:
                self._advance()
            return
        due = (time.monotonic() - self._started) * self._params.rate - self._samples
        if due > _LONGEST_BURST * self._params.rate:
            self._started += due / self._params.rate
            self._late += due / self._params.rate
            due = 1.0
        for _ in range(int(due) + 1 if due >= 0.0 else 0):
            self._advance()

    def _advance(self) -> None:
        if self._params.pace == 'lockstep':
            self._lost += len(self._sent)
            self._sent.clear()
        elif len(self._sent) > self._params.rate:
            # Unanswered for a second: nobody flies the craft, or commands were lost.
            self._lost += len(self._sent)
            self._sent.clear()
        if self._samples:
            self._craft.advance(self._pulses)
        self._sense()

    def diagnose(self) -> DiagnosticArray:
        """Report samples, lost answers and the time from a sample to its motor command."""
        lost, self._lost = self._lost, 0
        late, self._late = self._late, 0.0
        text = f'left out {late:.2f} s: the machine was busy' if late else 'ok'
        values = {
            'samples': self._samples,
            'unanswered': lost,
            'answer_p50_ms': 1e3 * self._round_trips.percentile(50.0),
            'answer_p99_ms': 1e3 * self._round_trips.percentile(99.0),
            'height_m': float(self._craft.x[2]),
            'voltage_v': float(self._craft.x[21]),
        }
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, WARN if late else OK, text, values)])


def build_node() -> QuadSimulatorNode:
    """Return the node."""
    return QuadSimulatorNode()
