# SPDX-License-Identifier: Apache-2.0
"""Covariance transitions and scalar updates of the inertial attitude filter, see `attitude_layout`."""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import euler_from_quat, quat_from_rotvec, quat_multiply, quat_normalize
from ship_inclinometer.attitude_layout import (
    ALL,
    BA,
    BG,
    DEV,
    P_,
    S_BA,
    S_BG,
    S_GNSS,
    S_P,
    S_POWER,
    S_Q,
    S_SPEED,
    S_TIME,
    S_V,
    S_VP,
    S_X1,
    S_X2,
    TH,
    TILT,
    VP,
    X1,
    X2,
    N,
    V,
)


@njit(cache=True, nogil=True)
def add_row(cov, target, source, factor):
    """Apply the elementary transition ``x[target] += factor * x[source]`` to the covariance in place."""
    for j in range(N):
        cov[target, j] += factor * cov[source, j]
    for j in range(N):
        cov[j, target] += factor * cov[j, source]


@njit(cache=True, nogil=True)
def scale_row(cov, target, factor):
    """Apply ``x[target] *= factor`` to the covariance in place."""
    for j in range(N):
        cov[target, j] *= factor
    for j in range(N):
        cov[j, target] *= factor


@njit(cache=True, nogil=True)
def scalar_update(state, cov, h, innovation, variance, moves, up):
    """Use one scalar measurement ``innovation = h · error + noise`` and return its NIS.

    h (N,). `moves` says what it may correct: ALL, TILT (all but heading, the gyro bias about the vertical
    and the accelerometer bias) or HEADING (heading and the gyro bias about the vertical). The rest is
    considered, not moved (Schmidt; covariance in Joseph's form), and so is the magnetic deviation always.
    up (3,) is the vertical in body axes.
    """
    ph = np.zeros(N)
    for j in range(N):
        if h[j] != 0.0:
            for i in range(N):
                ph[i] += cov[i, j] * h[j]
    s = variance
    for j in range(N):
        s += h[j] * ph[j]
    gain = ph / s
    gain[DEV] = 0.0
    if moves != ALL:
        about = gain[BG] * up[0] + gain[BG + 1] * up[1] + gain[BG + 2] * up[2]
        if moves == TILT:
            gain[TH + 2] = 0.0
            for i in range(3):
                gain[BG + i] -= about * up[i]
                # Heave and sway keep step with roll: what looks like a bias is the sea.
                gain[BA + i] = 0.0
        else:
            heading = gain[TH + 2]
            gain[:] = 0.0
            gain[TH + 2] = heading
            for i in range(3):
                gain[BG + i] = about * up[i]
    for i in range(N):
        for j in range(i, N):
            value = cov[i, j] - gain[i] * ph[j] - ph[i] * gain[j] + s * gain[i] * gain[j]
            cov[i, j] = value
            cov[j, i] = value
    inject(state, gain * innovation)
    return innovation * innovation / s


@njit(cache=True, nogil=True)
def innovation_variance(cov, h):
    """Return ``h cov h`` for h (N,)."""
    total = 0.0
    for i in range(N):
        if h[i] != 0.0:
            for j in range(N):
                total += h[i] * cov[i, j] * h[j]
    return total


@njit(cache=True, nogil=True)
def inject(state, error):
    """Move an error vector (N,) into the nominal state."""
    q = quat_multiply(quat_from_rotvec(error[TH : TH + 3]), state[S_Q : S_Q + 4])
    state[S_Q : S_Q + 4] = quat_normalize(q)
    for i in range(3):
        state[S_BG + i] += error[BG + i]
        state[S_BA + i] += error[BA + i]
        state[S_V + i] += error[V + i]
        state[S_P + i] += error[P_ + i]
        state[S_X1 + i] += error[X1 + i]
        state[S_X2 + i] += error[X2 + i]
    state[S_VP] += error[VP]
    state[S_VP + 1] += error[VP + 1]


@njit(cache=True, nogil=True)
def wave_frequency(state, up):
    """Return the wave displacement's mean angular frequency [rad/s], within periods of 4 to 30 s."""
    if up:
        ratio = state[S_SPEED + 1] / state[S_POWER + 2]
    else:
        ratio = state[S_SPEED] / (state[S_POWER] + state[S_POWER + 1])
    return min(max(math.sqrt(ratio), 2.0 * math.pi / 30.0), 2.0 * math.pi / 4.0)


@njit(cache=True, nogil=True)
def heading_angle(state):
    """Return the yaw [rad] of the nominal attitude."""
    _, _, yaw = euler_from_quat(state[S_Q : S_Q + 4])
    return yaw


@njit(cache=True, nogil=True)
def tracked(state):
    """Whether a GNSS velocity was used within the last 5 s."""
    return state[S_GNSS] >= 0.0 and state[S_TIME] - state[S_GNSS] < 5.0


@njit(cache=True, nogil=True)
def widen(cov, sigma):
    """Doubt the level velocity of ship and path alike, by `sigma` [m/s], as far as is new doubt."""
    for i in range(2):
        added = max(sigma**2 - cov[VP + i, VP + i], 0.0)
        cov[V + i, V + i] += added
        cov[VP + i, VP + i] += added
        cov[V + i, VP + i] += added
        cov[VP + i, V + i] += added
