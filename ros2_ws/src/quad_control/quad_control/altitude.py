# SPDX-License-Identifier: Apache-2.0
"""Vertical loop: height and climb rate from a range finder and the accelerometer, hover thrust, hold."""

from __future__ import annotations

import math

import numpy as np

from quad_control.params import GRAVITY, ControllerParams

# Flat state: height (m), climb rate (m/s), time of the last range (s), hover thrust (fraction), integral
# (fraction), held height (m), whether held, time low on the ground since (s, < 0 none), correction of the
# vertical acceleration (m/s²), heights in a row that did not fit.
_HEIGHT, _CLIMB, _RANGE_TIME, _HOVER, _INTEGRAL, _HELD, _HOLDING, _LOW_SINCE, _TRIM, _JUMPS = range(10)
SIZE = 10
# Observer with a triple pole at 2 rad/s: slower than the range finder's noise, faster than a drift.
_POLE = 2.0
# Range samples may be 0.1 s apart (10 Hz finder); longer than this (s) is silence.
_FRESH = 0.5
# Hover thrust is learnt with this time constant (s) while the vertical force is within these limits of g.
_HOVER_TIME, _HOVER_LOW, _HOVER_HIGH = 0.5, 0.7, 1.3
# A height that jumps is believed when so many in a row do not fit: 0.4 s at 10 Hz.
_JUMP_CONFIRMATIONS = 4
# On the ground: lower than this (m) and not moving faster than this (m/s) for this long (s).
_LANDED_HEIGHT, _LANDED_CLIMB, _LANDED_TIME = 0.25, 0.15, 0.5
# Held heights move with climb rates of at most this (m/s).
_MAX_CLIMB = 1.5
# Integral limit, fraction of thrust.
_INTEGRAL_LIMIT = 0.2


class Altitude:
    """Keeps height, climb rate and hover thrust in `state` (10,)."""

    def __init__(self, state: np.ndarray) -> None:
        self.state = state
        self.reset()

    def reset(self) -> None:
        """Forget height and hover thrust."""
        self.state[:] = 0.0
        self.state[_RANGE_TIME] = -math.inf
        self.state[_LOW_SINCE] = -1.0

    @property
    def hover(self) -> float:
        """Thrust fraction per motor that hovers, learnt in flight; 0 before."""
        return float(self.state[_HOVER])

    @hover.setter
    def hover(self, value: float) -> None:
        self.state[_HOVER] = value

    def fresh(self, time: float) -> bool:
        """Whether a range was heard lately; `time` s."""
        return time - self.state[_RANGE_TIME] < _FRESH

    @property
    def climb_rate(self) -> float:
        """Climb rate (m/s); it means something while a height is heard."""
        return float(self.state[_CLIMB])

    def predict(self, up: float, dt: float) -> None:
        """Carry height and climb rate on with the vertical acceleration `up` (m/s²)."""
        self.state[_HEIGHT] += dt * self.state[_CLIMB]
        self.state[_CLIMB] += dt * (up + self.state[_TRIM])

    def correct(self, height: float, time: float, jump: float = math.inf) -> bool:
        """Take a measured height (m) at `time` (s); False: more than `jump` (m) off and not yet believed."""
        s = self.state
        gap = time - s[_RANGE_TIME]
        if gap > _FRESH:
            s[_HEIGHT], s[_CLIMB] = height, 0.0
        elif abs(error := height - s[_HEIGHT]) > jump:
            s[_JUMPS] += 1.0
            if s[_JUMPS] < _JUMP_CONFIRMATIONS:
                return False
            s[_HEIGHT] = height  # the ground has stepped, not the craft: it climbs as before
        else:
            s[_HEIGHT] += min(3.0 * _POLE * gap, 1.0) * error
            s[_CLIMB] += min(3.0 * _POLE**2 * gap, 1.0) * error
            s[_TRIM] += _POLE**3 * gap * error
        s[_RANGE_TIME], s[_JUMPS] = time, 0.0
        return True

    def learn_hover(self, thrust: float, force_up: float, dt: float) -> None:
        """Learn the hover thrust: the thrust fraction given over the specific force it made."""
        ratio = force_up / GRAVITY
        if thrust < 0.05 or not _HOVER_LOW < ratio < _HOVER_HIGH:
            return
        here = thrust / ratio
        if self.state[_HOVER] == 0.0:
            self.state[_HOVER] = here
        else:
            self.state[_HOVER] += min(dt / _HOVER_TIME, 1.0) * (here - self.state[_HOVER])

    def climb(self, rate: float, p: ControllerParams, dt: float) -> float:
        """Return the throttle for a climb `rate` (m/s)."""
        s = self.state
        error = rate - s[_CLIMB]
        integral = s[_INTEGRAL] + p.climb_i * error * dt
        s[_INTEGRAL] = min(max(integral, -_INTEGRAL_LIMIT), _INTEGRAL_LIMIT)
        return min(max(s[_HOVER] + p.climb_p * error + s[_INTEGRAL], 0.0), 1.0)

    def hold(self, p: ControllerParams, dt: float) -> float:
        """Return the throttle that keeps the height at which hold began."""
        s = self.state
        if not s[_HOLDING]:
            s[_HOLDING], s[_HELD], s[_INTEGRAL] = 1.0, s[_HEIGHT], 0.0
        rate = p.altitude_p * (s[_HELD] - s[_HEIGHT])
        return self.climb(min(max(rate, -_MAX_CLIMB), _MAX_CLIMB), p, dt)

    def release(self) -> None:
        """End a hold."""
        self.state[_HOLDING] = 0.0

    def sinking(self, time: float, rate: float) -> bool:
        """Whether a height heard lately is above the ground and falls by more than `rate` (m/s)."""
        return self.fresh(time) and self.state[_HEIGHT] > _LANDED_HEIGHT and self.state[_CLIMB] < -rate

    def on_ground(self, time: float) -> bool:
        """Whether the craft has been low and at rest long enough to stop the motors."""
        s = self.state
        if s[_HEIGHT] > _LANDED_HEIGHT or abs(s[_CLIMB]) > _LANDED_CLIMB:
            s[_LOW_SINCE] = -1.0
            return False
        if s[_LOW_SINCE] < 0.0:
            s[_LOW_SINCE] = time
        return time - s[_LOW_SINCE] > _LANDED_TIME


def upward_acceleration(q, force) -> float:
    """Return the vertical acceleration (m/s²) of ``q_nb`` (4,) and specific force (3,) [m/s², body]."""
    w, x, y, z = q
    up = 2.0 * (x * z - w * y) * force[0] + 2.0 * (y * z + w * x) * force[1]
    return up + ((1.0 - 2.0 * (x * x + y * y)) * force[2] - GRAVITY)


def pressure_height(pressure: float, ground: float) -> float:
    """Return the height (m) over where `ground` (Pa) was measured; ISA: 15 °C at the ground, 6.5 K/km."""
    return 288.15 / 0.0065 * (1.0 - (pressure / ground) ** 0.190263)
