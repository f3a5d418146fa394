# SPDX-License-Identifier: Apache-2.0
"""Live processes: the attitude loop with a pilot in the air, and what happens when its controller dies."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from dataclasses import dataclass

from node_core.testing import Process, probe

# A calm hover does not tilt further (rad).
CALM = math.radians(15.0)
# The pilot sends by the wall clock; at this many setpoints per second none is missed in faster time.
_STICKS = 200.0
# A stopped motor's pulse (µs), with a count of the chip to spare.
_IDLE = 1001.0
# The first start compiles the kernels.
_START = 300.0


@dataclass(frozen=True)
class LiveFlight:
    """Simulated time aloft (s), in-to-out p50 and p99 (ms), lost answers, largest tilt (rad), crash."""

    seconds: float
    p50: float
    p99: float
    lost: int
    tilt: float
    crashed: bool


def fly_live(rate: float, seconds: float) -> LiveFlight:
    """Hover for `seconds` of simulated time at `rate` (Hz); the simulator waits for each motor command.

    In-to-out is the wall time from publishing an IMU sample to receiving the command that answers it, so it
    holds two hops, the filter and the controller.
    """
    with ExitStack() as stack:
        start = stack.enter_context
        lockstep = {'lockstep': True}
        start(Process.node('quad_control', 'attitude_filter', params={**lockstep, 'period': 1.0 / rate}))
        start(Process.node('quad_control', 'attitude_controller', params=lockstep))
        start(Process.node('quad_control', 'pilot', params={'mission': 'hover', 'rate': _STICKS}))
        watcher = start(probe())
        status = watcher.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
        truths = watcher.collect('nav_msgs/msg/Odometry', 'truth/odometry')
        watcher.wait_for_publisher('motors/command')
        watcher.wait_for_publisher('setpoint')
        # 12 Ah: ten minutes must not end with the battery.
        craft = start(
            Process.node(
                'quad_control',
                'quad_simulator',
                params={'pace': 'lockstep', 'rate': rate, 'seed': 3, 'capacity': 12.0},
            )
        )
        tilt, up_at, last, crashed = 0.0, None, 0.0, False
        p50 = p99 = math.nan
        lost = 0
        quiet = time.monotonic()
        while up_at is None or last - up_at < seconds:
            watcher.spin(0.05)
            if truths:
                quiet = time.monotonic()
            if not craft.running or time.monotonic() - quiet > _START:
                raise RuntimeError(f'the simulator fell silent:\n{craft.output}')
            for message in truths:
                q, z = message.pose.pose.orientation, message.pose.pose.position.z
                last = _seconds(message)
                if up_at is None:
                    up_at = last if z > 1.0 else None
                    continue
                tilt = max(tilt, 2.0 * math.asin(min(math.hypot(q.x, q.y), 1.0)))
                crashed = crashed or z < 0.1
            truths.clear()
            for array in status:
                for entry in array.status:
                    if entry.name == 'quad_simulator':
                        values = {pair.key: float(pair.value) for pair in entry.values}
                        p50, p99 = values['answer_p50_ms'], values['answer_p99_ms']
                        lost += int(values['unanswered'])
            status.clear()
        return LiveFlight(last - up_at, p50, p99, lost, tilt, crashed)


def kill_live() -> float:
    """Kill the controller process in a hover; return the time (s) from the last pulses of flight to idle."""
    with ExitStack() as stack:

        def start(name: str, **params) -> Process:
            return stack.enter_context(Process.node('quad_control', name, params=params))

        start('attitude_filter', lockstep=True)
        controller = start('attitude_controller', lockstep=True)
        start('pilot', mission='hover', rate=_STICKS)
        start('esc_driver', bus='fake')
        watcher = stack.enter_context(probe())
        pulses = watcher.collect('sensor_msgs/msg/JointState', 'esc/pulses')
        truths = watcher.collect('nav_msgs/msg/Odometry', 'truth/odometry')
        for topic in ('motors/command', 'setpoint', 'esc/pulses'):
            watcher.wait_for_publisher(topic)
        start('quad_simulator', pace='lockstep', seed=3)
        watcher.until(lambda: truths and truths[-1].pose.pose.position.z > 1.0, 'a hover', _START)
        controller.kill()
        watcher.until(lambda: max(pulses[-1].position) <= _IDLE, 'idle pulses', _START)
        flying = [m for m in pulses if max(m.position) > _IDLE]
        return _seconds(pulses[-1]) - _seconds(flying[-1])


def _seconds(message) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
