# SPDX-License-Identifier: Apache-2.0
"""The two-state Kalman filter of paper 004: one angle and the bias of its rate, as kernels.

An axis is a (6,) array: angle (rad), bias (rad/s), P00, P01, P10, P11. `step_published` follows the printed
listing operation by operation, with its erratum: the covariance update uses entries of P that it has
already overwritten, so P loses its symmetry. `step_corrected` updates P with the values before the update.
Innovations wrap to [-pi, pi); within that interval wrapping changes no bit.
"""

import numpy as np
from numba import njit

from kalman_core.rotation import wrap

AXIS = 6
ANGLE, BIAS, P00, P01, P10, P11 = range(AXIS)


@njit(cache=True, nogil=True)
def predict(axis, rate, dt, q_angle, q_bias):
    """Advance `axis` in place by `dt` (s) with the measured `rate` (rad/s). Paper 004, steps 1 and 2.

    `q_angle` (rad²/s) and `q_bias` ((rad/s)²/s) are the process noise per second.
    """
    axis[ANGLE] += dt * (rate - axis[BIAS])
    axis[P00] += dt * (dt * axis[P11] - axis[P10] - axis[P01] + q_angle)
    axis[P01] -= dt * axis[P11]
    axis[P10] -= dt * axis[P11]
    axis[P11] += q_bias * dt


@njit(cache=True, nogil=True)
def correct_published(axis, angle, r):
    """Correct `axis` in place with the measured `angle` (rad, variance `r`), as printed (steps 3 to 7).

    Returns the innovation (rad) and its variance (rad²).
    """
    s = axis[P00] + r
    k0 = axis[P00] / s
    k1 = axis[P10] / s
    y = wrap(angle - axis[ANGLE])
    axis[ANGLE] = wrap(axis[ANGLE] + k0 * y)
    axis[BIAS] += k1 * y
    axis[P00] -= k0 * axis[P00]
    axis[P01] -= k0 * axis[P01]
    axis[P10] -= k1 * axis[P00]
    axis[P11] -= k1 * axis[P01]
    return y, s


@njit(cache=True, nogil=True)
def correct(axis, angle, r):
    """Correct `axis` in place with the measured `angle` (rad, variance `r`), P updated in its right order.

    Returns the innovation (rad) and its variance (rad²).
    """
    s = axis[P00] + r
    k0 = axis[P00] / s
    k1 = axis[P10] / s
    y = wrap(angle - axis[ANGLE])
    axis[ANGLE] = wrap(axis[ANGLE] + k0 * y)
    axis[BIAS] += k1 * y
    cross = axis[P01]
    # (1 - K0) = r / s without cancellation when r is small against P00.
    axis[P00] *= r / s
    axis[P01] = cross * (r / s)
    axis[P10] = axis[P01]
    axis[P11] -= k1 * cross
    return y, s


@njit(cache=True, nogil=True)
def step_published(axis, rate, angle, dt, q_angle, q_bias, r):
    """Predict and correct as printed. Returns the innovation (rad) and its variance (rad²)."""
    predict(axis, rate, dt, q_angle, q_bias)
    return correct_published(axis, angle, r)


@njit(cache=True, nogil=True)
def step_corrected(axis, rate, angle, dt, q_angle, q_bias, r):
    """Predict and correct with P in its right order. Returns the innovation (rad) and its variance (rad²)."""
    predict(axis, rate, dt, q_angle, q_bias)
    return correct(axis, angle, r)


@njit(cache=True, nogil=True)
def filter_axis(axis, rates, angles, dt, q_angle, q_bias, r, published):
    """Run one axis over arrays: `rates` and `angles` are (n,), `dt` (s) is constant.

    `axis` ends as the final state. Returns the (n, 2) angle and bias after each correction.
    """
    out = np.empty((rates.shape[0], 2))
    for i in range(rates.shape[0]):
        if published:
            step_published(axis, rates[i], angles[i], dt, q_angle, q_bias, r)
        else:
            step_corrected(axis, rates[i], angles[i], dt, q_angle, q_bias, r)
        out[i, 0] = axis[ANGLE]
        out[i, 1] = axis[BIAS]
    return out
