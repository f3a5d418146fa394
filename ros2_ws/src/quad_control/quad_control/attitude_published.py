# SPDX-License-Identifier: Apache-2.0
"""The paper's filter: per axis a Kalman filter on (angle, rate), as printed and corrected.

Source: paper 000, eqs. 1-10. Two things are selectable. The printed Q has σ²Δt²/3 = 5.33e-6 as its first
entry where its own formula gives σ²Δt³/3 = 2.67e-8; and the gyro, said to be used, is in no equation: the
corrected filter takes its rate as a second measurement.
"""

from __future__ import annotations

import math

from numba import njit

from kalman_core.rotation import wrap
from quad_control.params import GRAVITY

# Start covariance (paper): rad², (rad/s)².
ANGLE_PRIOR, RATE_PRIOR = 0.05, 1.0


@njit(cache=True, nogil=True)
def accelerometer_angles(fx, fy, fz):
    """Return (roll, pitch) [rad] of a specific force in body axes, x forward, y left, z up; eqs. 5 and 6."""
    return math.atan2(fy, fz), math.atan2(-fx, math.sqrt(fy * fy + fz * fz))


@njit(cache=True, nogil=True)
def adaptive_factor(fx, fy, fz, gain, deadband):
    """Return the factor of R in hard manoeuvres, 1 + k·max(0, |‖a‖ − g|/g − deadband)."""
    norm = math.sqrt(fx * fx + fy * fy + fz * fz)
    return 1.0 + gain * max(0.0, abs(norm - GRAVITY) / GRAVITY - deadband)


@njit(cache=True, nogil=True)
def printed_q11(sigma, dt, published):
    """Return Q(1,1) (rad²): σ²Δt²/3 as printed, or σ²Δt³/3."""
    return sigma * sigma * (dt * dt if published else dt * dt * dt) / 3.0


@njit(cache=True, nogil=True)
def step(x, P, dt, sigma, q11, angle, r_angle, rate, r_rate):
    """Advance one axis by `dt` (s), then correct with `angle` (rad) and, where r_rate > 0, `rate` (rad/s).

    x: (2,) angle (rad) and rate (rad/s), P: (2, 2); both in place. Returns the angle innovation (rad) and
    its variance (rad²). Source: eqs. 2-10.
    """
    s2 = sigma * sigma
    q12 = s2 * dt * dt / 2.0
    x[0] = wrap(x[0] + dt * x[1])
    p00 = P[0, 0] + dt * (P[0, 1] + P[1, 0]) + dt * dt * P[1, 1] + q11
    p01 = P[0, 1] + dt * P[1, 1] + q12
    p11 = P[1, 1] + s2 * dt
    variance = p00 + r_angle
    innovation = wrap(angle - x[0])
    k0, k1 = p00 / variance, p01 / variance
    x[0] = wrap(x[0] + k0 * innovation)
    x[1] += k1 * innovation
    p11 -= k1 * p01
    p01 *= 1.0 - k0
    p00 *= 1.0 - k0
    if r_rate > 0.0:
        s = p11 + r_rate
        difference = rate - x[1]
        k0, k1 = p01 / s, p11 / s
        x[0] = wrap(x[0] + k0 * difference)
        x[1] += k1 * difference
        p00 -= k0 * p01
        p01 *= 1.0 - k1
        p11 *= 1.0 - k1
    P[0, 0], P[0, 1], P[1, 0], P[1, 1] = p00, p01, p01, p11
    return innovation, variance
