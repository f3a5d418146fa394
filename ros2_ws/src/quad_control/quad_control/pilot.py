# SPDX-License-Identifier: Apache-2.0
"""A pilot for simulations and the page: fixed sticks, or a mission that takes off and hovers in place."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kalman_core.parameters import parameter
from quad_control.arming import ARMED, DESCENT, NAMES, STOPPED
from quad_control.samples import Setpoint

# While the controller refuses, the arm switch stays on and off for these times (s) before it is tried again:
# off only shortly, so that it is hardly ever off just when the controller arms.
_ON, _OFF = 2.0, 0.2
# Sticks by eye: lean per metre and per m/s away from the start, at most this much (rad).
_LEAN_POSITION, _LEAN_VELOCITY, _MOST_LEAN = 0.04, 0.1, 0.15
# The mission holds no higher than this share of what the range finder reaches: a climb overshoots.
_REACH_SHARE = 0.8


@dataclass(frozen=True)
class PilotParams:
    """The sticks, and what the pilot does with them."""

    mission: str = parameter(
        'manual',
        'manual: the sticks below; hover: arm, climb to `height`, stay there; sticks are added',
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
        1.5,
        "height of the hover mission, at most 0.8 of the range finder's reach",
        unit='m',
        minimum=0.3,
        maximum=50.0,
        live=True,
    )
    climb_throttle: float = parameter(
        0.25, 'throttle of the take-off', unit='fraction', minimum=0.05, maximum=1.0, live=True
    )
    link_range: float = parameter(
        150.0, 'range of the radio link (paper): beyond it no setpoint goes out', unit='m', minimum=1.0
    )
    rate: float = parameter(50.0, 'rate of setpoints', unit='Hz', minimum=5.0, maximum=500.0)


class Pilot:
    """Turns parameters, height and arming state into setpoints."""

    def __init__(self, params: PilotParams) -> None:
        self.params = params
        # Height (m) of the range finder, None while it sees no ground; how far it reaches (m).
        self.height: float | None = 0.0
        self.reach = math.inf
        self._state = 'disarmed'
        self._given_up = False
        self._switch = False
        self._changed = 0
        self._up = False
        self._blind = False
        # What the pilot sees: position (m, ENU), velocity (m/s, body), yaw (rad).
        self.position = (0.0, 0.0, 0.0)
        self.velocity = (0.0, 0.0, 0.0)
        self.yaw = 0.0

    @property
    def params(self) -> PilotParams:
        """What the pilot is told to do; telling it anew makes it try again after a stop."""
        return self._params

    @params.setter
    def params(self, params: PilotParams) -> None:
        self._params = params
        self._given_up = False

    @property
    def state(self) -> str:
        """The arming state heard last."""
        return self._state

    @state.setter
    def state(self, name: str) -> None:
        self._state = name
        # Stopped motors (a kill, a fault) are for a person to look at: the mission does not arm again.
        self._given_up = self._given_up or name == NAMES[STOPPED]

    def on_range(self, height: float, nearest: float, reach: float) -> None:
        """Take a range (m) with the limits of its sensor; REP-117: -inf is too near, +inf too far."""
        if reach > nearest >= 0.0:
            self.reach = reach
        if height < nearest:
            self.height = 0.0
        else:
            self.height = height if height <= self.reach else None

    @property
    def target(self) -> float:
        """Height (m) at which the mission holds: what is asked, or what can be measured."""
        return min(self.params.height, _REACH_SHARE * self.reach)

    @property
    def trouble(self) -> str:
        """Why the mission does not do what it is told, or an empty string."""
        if self.params.mission == 'manual':
            return ''
        if self.height is None:
            return (
                'no ground in the range finder: no take-off, and in the air no setpoint (the craft descends)'
            )
        if self.target < self.params.height:
            return (
                f'height is {self.params.height:g} m, the range finder reaches {self.reach:g} m: '
                f'holds at {self.target:g} m'
            )
        return ''

    def step(self, stamp: int) -> Setpoint | None:
        """Return the sticks at `stamp` (ns), or None: the craft is out of the link's range, or too high."""
        p = self.params
        if math.hypot(*self.position) > p.link_range:
            return None
        if p.mission == 'manual':
            return Setpoint(stamp, p.roll, p.pitch, p.yaw_rate, p.throttle, p.arm, p.hold)
        flying = self.state in (NAMES[ARMED], NAMES[DESCENT])
        if flying and self._sinks_into_sight():
            return None
        if self._given_up or self.height is None:
            return Setpoint(stamp, 0.0, 0.0, 0.0, 0.0, False)
        # A descent is a flight too: the switch stays on.
        if not flying:
            self._up = False
            # Off and on again: a switch that stays on is not a wish to arm.
            if stamp - self._changed > (_ON if self._switch else _OFF) * 1e9:
                self._switch, self._changed = not self._switch, stamp
            return Setpoint(stamp, 0.0, 0.0, 0.0, 0.0, self._switch)
        self._up = self._up or self.height > self.target
        roll, pitch = self._by_eye()
        return Setpoint(stamp, p.roll + roll, p.pitch + pitch, p.yaw_rate, p.climb_throttle, True, self._up)

    def _sinks_into_sight(self) -> bool:
        """Whether the ground is out of sight: the failsafe brings the craft down to the target height."""
        self._blind = self.height is None or (self._blind and self.height > self.target)
        return self._blind

    def _by_eye(self) -> tuple[float, float]:
        """Return the lean (rad) that brings the craft back over its start."""
        x, y, _ = self.position
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        ahead, left = c * x + s * y, c * y - s * x
        forward = _LEAN_POSITION * ahead + _LEAN_VELOCITY * self.velocity[0]
        sideways = _LEAN_POSITION * left + _LEAN_VELOCITY * self.velocity[1]
        # Nose up (negative pitch) goes backwards, left side up (positive roll) goes to the right.
        return _limited(sideways), _limited(-forward)


def _limited(lean: float) -> float:
    return min(max(lean, -_MOST_LEAN), _MOST_LEAN)
