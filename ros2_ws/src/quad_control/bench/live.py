# SPDX-License-Identifier: Apache-2.0
"""The attitude loop through live processes: simulator, filter, controller, back; and a pilot."""

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
                last = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
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
