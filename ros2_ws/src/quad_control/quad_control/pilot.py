# SPDX-License-Identifier: Apache-2.0
"""A pilot for simulations and the page: fixed sticks, or a mission that takes off and hovers."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import parameter
from quad_control.samples import Setpoint

# The arm switch is tried again this often (s) while the controller refuses.
_RETRY = 1.0


@dataclass(frozen=True)
class PilotParams:
    """The sticks, and what the pilot does with them."""

    mission: str = parameter(
        'manual',
        'manual: the sticks below; hover: arm, climb to `height`, hold it; sticks still steer',
        choices=('manual', 'hover'),
        live=True,
    )
    roll: float = parameter(0.0, 'roll stick', unit='rad', minimum=-1.2, maximum=1.2, live=True)
    pitch: float = parameter(0.0, 'pitch stick', unit='rad', minimum=-1.2, maximum=1.2, live=True)
    yaw_rate: float = parameter(0.0, 'yaw stick', unit='rad/s', minimum=-6.0, maximum=6.0, live=True)
    throttle: float = parameter(0.0, 'throttle stick', unit='fraction', minimum=0.0, maximum=1.0, live=True)
    arm: bool = parameter(False, 'arm switch', live=True)
    hold: bool = parameter(False, 'altitude hold switch', live=True)
    height: float = parameter(
        1.5, 'height of the hover mission', unit='m', minimum=0.3, maximum=50.0, live=True
    )
    climb_throttle: float = parameter(
        0.25, 'throttle of the take-off', unit='fraction', minimum=0.05, maximum=1.0, live=True
    )
    rate: float = parameter(50.0, 'rate of setpoints', unit='Hz', minimum=5.0, maximum=500.0)


class Pilot:
    """Turns parameters, height and arming state into setpoints."""

    def __init__(self, params: PilotParams) -> None:
        self.params = params
        self.height = 0.0
        self.state = 'disarmed'
        self._switch = False
        self._changed = 0
        self._up = False

    def step(self, stamp: int) -> Setpoint:
        """Return the sticks at `stamp` (ns)."""
        p = self.params
        if p.mission == 'manual':
            return Setpoint(stamp, p.roll, p.pitch, p.yaw_rate, p.throttle, p.arm, p.hold)
        armed = self.state == 'armed'
        if not armed:
            self._up = False
            # Off and on again: a switch that stays on is not a wish to arm.
            if stamp - self._changed > _RETRY * 1e9:
                self._switch, self._changed = not self._switch, stamp
            return Setpoint(stamp, 0.0, 0.0, 0.0, 0.0, self._switch)
        self._up = self._up or self.height > p.height
        return Setpoint(stamp, p.roll, p.pitch, p.yaw_rate, p.climb_throttle, True, self._up)
