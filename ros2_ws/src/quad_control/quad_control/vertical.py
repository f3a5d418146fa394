# SPDX-License-Identifier: Apache-2.0
"""Climb rate and hover thrust where nothing measures height: a Kalman filter on accelerometer and thrust.

State: climb rate v (m/s, up), bias b of the vertical accelerometer (m/s²), thrust gain a (specific force per
thrust fraction, m/s²). The accelerometer drives v. Alone that drifts; what a rotor loses in thrust when it
climbs does not: specific force = a·thrust − inflow·v + b, so as long as the gain keeps, thrust tells a steady
climb from a hover. At rest before the flight v = 0 and b is seen; in flight v = 0 is a faint guess, since no
craft climbs for ever. A height sensor's climb rate takes its place while there is one.

Source: the inflow term is momentum theory's loss of thrust with axial speed, linear near hover (Leishman,
Principles of Helicopter Aerodynamics, 2nd ed., ch. 2).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from quad_control.params import GRAVITY

# Flat state: v, b, a, their covariance (3, 3), thrust behind the motors' lag, whether it has left the ground,
# time for which it looks landed (s).
_V, _B, _A = 0, 1, 2
_P = slice(3, 12)
_THRUST, _LIFTED, _LANDED = 12, 13, 14
SIZE = 15

# Before the flight: σ of the bias (m/s²; an uncalibrated MPU6050 has ±80 mg), what is left of it once the
# motors vibrate, and what is motion instead.
_BIAS_PRIOR, _BIAS_FLOOR, _LARGEST_BIAS = 0.3, 0.03, 1.0
# σ of the gain at lift-off, per gain.
_GAIN_PRIOR = 0.3
# σ of climb rate (m/s) and bias (m/s²) of a craft that is taken over in the air.
_CLIMB_PRIOR, _BIAS_TOLD = 0.5, 0.1
# Root densities: accelerometer in flight and at rest (m/s²/√Hz), walk of the bias (m/s²/√s), walk of the gain
# per gain (1/√s; 7 % in ten minutes, of which a battery that nobody measures may lose twice as much).
_FORCE_NOISE, _REST_NOISE, _BIAS_WALK, _GAIN_WALK = 0.06, 0.03, 1e-3, 3e-3
# Thrust as a measurement (m/s²/√Hz): gusts of 2 m/s over 2 s on the inflow; more the faster it climbs, since
# the inflow is known to about half of itself.
_THRUST_NOISE, _INFLOW_DOUBT = 2.5, 0.5
# v = 0 (m/s/√Hz): a climb of 3 m/s may go on for a minute. On the ground: forgets a false speed in 5 s.
_HOVER_NOISE, _GROUND_NOISE = 20.0, 0.3
# A measured climb rate (m/s/√Hz).
_AIDED_NOISE = 0.3
# The climb rate (m/s) that shows that the craft has left the ground.
_LIFT_OFF = 0.4
# Thrust follows the command with this lag (s): motors and filters.
_LAG = 0.05
# It stands on something: less thrust than this per hover thrust and still this share of gravity felt for so
# long (s), while it does not fall (m/s).
_IDLE, _CARRIED, _LANDED_TIME, _FALLING = 0.3, 0.7, 1.0, 3.0
# A specific force (m/s²) beyond this is a blow, or nonsense (8 g).
_MOST_FORCE = 80.0
# A gain that hovers at 2 % of the thrust, or does not hover at all, is none.
_LEAST_GAIN, _MOST_GAIN = GRAVITY, 50.0 * GRAVITY
# A descent adds the σ of the climb rate to its own rate, up to this (m/s), so that it sinks all the same; its
# thrust stays between these shares of hover: it neither falls nor climbs away.
_MOST_DOUBT, _LEAST_THRUST, _MOST_THRUST = 0.6, 0.6, 1.2


@njit(cache=True, nogil=True)
def _correct(s, h, innovation, variance):
    """Correct with a scalar measurement of row `h` (3,), in place."""
    P = s[3:12].reshape(3, 3)
    ph = np.zeros(3)
    total = variance
    for i in range(3):
        for j in range(3):
            ph[i] += P[i, j] * h[j]
        total += h[i] * ph[i]
    for i in range(3):
        s[i] += ph[i] / total * innovation
        for j in range(3):
            P[i, j] -= ph[i] * ph[j] / total
    s[_A] = min(max(s[_A], _LEAST_GAIN), _MOST_GAIN)


@njit(cache=True, nogil=True)
def _predict(s, force_up, dt):
    P = s[3:12].reshape(3, 3)
    s[_V] += dt * (force_up - GRAVITY - s[_B])
    for j in range(3):
        P[_V, j] -= dt * P[_B, j]
    for i in range(3):
        P[i, _V] -= dt * P[i, _B]
    P[_V, _V] += _FORCE_NOISE**2 * dt
    P[_B, _B] += _BIAS_WALK**2 * dt
    P[_A, _A] += (_GAIN_WALK * s[_A]) ** 2 * dt


@njit(cache=True, nogil=True)
def rest(s, force_up, dt):
    """Stand for `dt` (s): no speed, and the vertical specific force (m/s², up) shows the bias; in place."""
    P = s[3:12].reshape(3, 3)
    s[_V] = s[_THRUST] = s[_LIFTED] = s[_LANDED] = 0.0
    P[_V, :] = 0.0
    P[:, _V] = 0.0
    if abs(force_up - GRAVITY) > _LARGEST_BIAS:  # it falls, or is carried about
        return
    h = np.zeros(3)
    h[_B] = 1.0
    _correct(s, h, force_up - GRAVITY - s[_B], _REST_NOISE**2 / dt)
    P[_B, _B] = max(P[_B, _B], _BIAS_FLOOR**2)


@njit(cache=True, nogil=True)
def step(s, force_up, force_z, cosine, thrust, dt, aim, aim_noise, inflow):
    """Advance by `dt` (s), in place.

    force_up, force_z: specific force upwards and along the body's z axis (m/s²); cosine of the tilt; thrust:
    mean fraction that the motors were given; aim: climb rate (m/s) that is expected with root density
    `aim_noise` (m/s/√Hz), 0 = none is; inflow: loss of specific force per climb rate (1/s).
    """
    if max(abs(force_up), abs(force_z)) > _MOST_FORCE:
        return
    s[_THRUST] += min(dt / _LAG, 1.0) * (thrust - s[_THRUST])
    _predict(s, force_up, dt)
    h = np.zeros(3)
    h[_V] = 1.0
    if s[_LIFTED] == 0.0:
        _correct(s, h, -s[_V], _GROUND_NOISE**2 / dt)
        if s[_V] > _LIFT_OFF and s[_THRUST] > 0.0:
            s[_LIFTED] = 1.0
            s[_A] = min(max((force_z + inflow * s[_V]) / s[_THRUST], _LEAST_GAIN), _MOST_GAIN)
            P = s[3:12].reshape(3, 3)
            P[_A, :] = 0.0
            P[:, _A] = 0.0
            P[_A, _A] = (_GAIN_PRIOR * s[_A]) ** 2
        return
    if aim_noise > 0.0:
        _correct(s, h, aim - s[_V], aim_noise**2 / dt)
    idle = s[_THRUST] * s[_A] < _IDLE * GRAVITY
    if not idle:
        doubt = _INFLOW_DOUBT * inflow * s[_V]
        h[_V], h[_B], h[_A] = -inflow * cosine, 1.0, s[_THRUST]
        innovation = force_z - s[_A] * s[_THRUST] + inflow * cosine * s[_V] - s[_B]
        _correct(s, h, innovation, (_THRUST_NOISE**2 + doubt**2) / dt)
    standing = idle and force_z > _CARRIED * GRAVITY and abs(s[_V]) < _FALLING
    s[_LANDED] = s[_LANDED] + dt if standing else 0.0
    if s[_LANDED] > _LANDED_TIME:
        s[_LIFTED] = s[_LANDED] = s[_V] = 0.0


class VerticalFilter:
    """Keeps climb rate, accelerometer bias and thrust gain in `state` (15,)."""

    def __init__(self, state: np.ndarray) -> None:
        self.state = state
        self.reset()

    def reset(self) -> None:
        """Forget everything; it stands."""
        s = self.state
        s[:] = 0.0
        s[_A] = _LEAST_GAIN
        s[_P] = np.diag([0.0, _BIAS_PRIOR**2, (_GAIN_PRIOR * _LEAST_GAIN) ** 2]).ravel()

    def start(self, hover: float) -> None:
        """Begin in the air with the `hover` thrust (fraction)."""
        s = self.state
        self.reset()
        s[_LIFTED] = 1.0
        s[_A] = GRAVITY / hover
        s[_THRUST] = hover
        s[_P] = np.diag([_CLIMB_PRIOR**2, _BIAS_TOLD**2, (_GAIN_PRIOR * s[_A]) ** 2]).ravel()

    def rest(self, force_up: float, dt: float) -> None:
        """Stand for `dt` (s) with the vertical specific force (m/s²)."""
        rest(self.state, force_up, dt)

    def step(
        self,
        force_up: float,
        force_z: float,
        cosine: float,
        thrust: float,
        dt: float,
        climb: float | None,
        expected: bool,
        inflow: float,
    ) -> None:
        """Fly for `dt` (s); see the kernel. `climb`: a measured rate (m/s); `expected`: about 0 is, else."""
        noise = _AIDED_NOISE if climb is not None else _HOVER_NOISE if expected else 0.0
        step(self.state, force_up, force_z, cosine, thrust, dt, climb or 0.0, noise, inflow)

    def sink(self, rate: float, gain: float, inflow: float) -> float:
        """Return the throttle that sinks at `rate` (m/s) or somewhat faster; `gain` s/m, `inflow` 1/s."""
        wanted = -rate - min(self.sigma, _MOST_DOUBT)
        throttle = self.hover * (1.0 + inflow * wanted / GRAVITY) + gain * (wanted - self.climb)
        return min(max(throttle, _LEAST_THRUST * self.hover), _MOST_THRUST * self.hover, 1.0)

    @property
    def known(self) -> bool:
        """Whether the craft has been seen to leave the ground, so that rate and thrust mean something."""
        return bool(self.state[_LIFTED])

    @property
    def climb(self) -> float:
        """Climb rate (m/s)."""
        return float(self.state[_V])

    @property
    def sigma(self) -> float:
        """σ of the climb rate (m/s)."""
        return math.sqrt(max(float(self.state[3]), 0.0))

    @property
    def hover(self) -> float:
        """Thrust fraction that hovers without climbing."""
        return GRAVITY / float(self.state[_A])
