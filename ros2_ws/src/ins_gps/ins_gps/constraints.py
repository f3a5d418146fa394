# SPDX-License-Identifier: Apache-2.0
"""Optional pseudo-measurements: zero velocity while still, and a road vehicle's motion along its axis.

Source: Groves, 2nd ed., 15.1.4 (non-holonomic) and 15.3.2 (zero velocity).
"""

import math

import numpy as np
from numba import njit

from ins_gps.correction import ACCEPTED, joint_update
from ins_gps.faults import spread_signatures
from ins_gps.layout import (
    ACC,
    ACC_BIAS,
    ALIGN_FORCE,
    ATT,
    CONSTRAINED,
    FORCE,
    NAVIGATION,
    NSEC,
    RATE,
    SEC,
    STILL,
    VEL,
    WHEEL_SUMS,
    ZERO_USED,
)
from ins_gps.prediction import advance_covariance, covariance_of, inject
from kalman_core.earth import gravity
from kalman_core.rotation import matrix_from_quat

# Zero velocity needs this long (s) of specific force and rate steady within these bounds.
_STILL_TIME = 1.0
_STILL_FORCE = 0.3  # m/s²
_STILL_RATE = 0.02  # rad/s
_STILL_SPEED = 1.0  # m/s: a steady cruise is not a stop
# Steady braking is as quiet as a stop, but its force is not that of gravity; beside this bound the tilt may
# be off by three σ.
_STILL_ACCELERATION = 0.15  # m/s²
# Both kinds come at this interval (s); at IMU rate their errors would not be independent.
_INTERVAL = 0.2
_GATE = 15.0  # squared σ, 1e-4
# A skid builds up: its innovations pass the gate one by one and pull the velocity back each time. Their leaky
# sum tells; of white innovations it has a variance of 1/(1 − keep²), and the limit is four of its σ.
_KEEP = 0.8
_SUM_LIMIT = 4.0 / math.sqrt(1.0 - _KEEP * _KEEP)
_LARGEST = 5.0  # σ that one innovation adds at most, so that the sum forgets a skid within two seconds


@njit(cache=True, nogil=True)
def _accelerates(state, channels):
    """Say whether the averaged force is more than gravity and the uncertainty of the tilt explain."""
    P = covariance_of(state, channels)
    mat = matrix_from_quat(state[NAVIGATION + 6 : NAVIGATION + 10])
    g = gravity(state[NAVIGATION], state[NAVIGATION + 2])
    total = 0.0
    for i in range(2):
        a = 0.0
        for k in range(3):
            a += mat[i, k] * (state[ALIGN_FORCE + k] - state[ACC_BIAS + k])
        total += a * a
    variance = g * g * (P[ATT, ATT] + P[ATT + 1, ATT + 1])
    for k in range(3):
        variance += P[ACC + k, ACC + k]
    return math.sqrt(total) > _STILL_ACCELERATION + 3.0 * math.sqrt(variance)


@njit(cache=True, nogil=True)
def zero_velocity_update(state, channels, config, sigma):
    """Correct with zero velocity if the IMU has been still; return the number of components used."""
    now = state[SEC] + 1e-9 * state[NSEC]
    moving = False
    for k in range(3):
        if (
            abs(state[FORCE + k] - state[ALIGN_FORCE + k]) > _STILL_FORCE
            or abs(state[RATE + k]) > _STILL_RATE
        ):
            moving = True
    v = state[NAVIGATION + 3 : NAVIGATION + 6]
    if math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2) > _STILL_SPEED:
        moving = True
    if not moving and _accelerates(state, channels):
        moving = True
    if moving or state[STILL] == 0.0:
        state[STILL] = now
        return 0
    if now - state[STILL] < _STILL_TIME or now - state[ZERO_USED] < _INTERVAL:
        return 0
    state[ZERO_USED] = now
    advance_covariance(state, channels, config)
    P = covariance_of(state, channels)
    n = P.shape[0]
    H = np.zeros((3, n))
    nu = np.empty(3)
    for k in range(3):
        H[k, VEL + k] = 1.0
        nu[k] = -v[k]
    status = np.full(3, ACCEPTED, np.int64)
    dx = np.zeros(n)
    R, information = np.full(3, sigma * sigma), np.zeros((3, 3))
    _, used = joint_update(P, H, nu, R, status, _GATE, dx, np.zeros(3), information)
    nowhere = np.full(3, -1, np.int64)
    spread_signatures(state, channels, H, nu, R, status, information, nowhere, nowhere, 0.0)
    inject(state, channels, dx)
    return used


@njit(cache=True, nogil=True)
def non_holonomic_update(state, channels, config, sigma):
    """Correct with zero lateral and vertical velocity of the body; return how many were used, −1: gated."""
    now = state[SEC] + 1e-9 * state[NSEC]
    if now - state[CONSTRAINED] < _INTERVAL:
        return 0
    state[CONSTRAINED] = now
    advance_covariance(state, channels, config)
    P = covariance_of(state, channels)
    n = P.shape[0]
    mat = matrix_from_quat(state[NAVIGATION + 6 : NAVIGATION + 10])
    v = state[NAVIGATION + 3 : NAVIGATION + 6]
    H = np.zeros((2, n))
    nu = np.empty(2)
    for i in range(2):
        c = mat[:, i + 1]
        nu[i] = -(c[0] * v[0] + c[1] * v[1] + c[2] * v[2])
        for k in range(3):
            H[i, VEL + k] = c[k]
        # c turns with the attitude error: d(cᵀv) = (c × v)·error
        H[i, ATT] = c[1] * v[2] - c[2] * v[1]
        H[i, ATT + 1] = c[2] * v[0] - c[0] * v[2]
        H[i, ATT + 2] = c[0] * v[1] - c[1] * v[0]
    status = np.full(2, ACCEPTED, np.int64)
    slips = False
    for i in range(2):
        variance = sigma * sigma
        for r in range(n):
            if H[i, r] != 0.0:
                for k in range(n):
                    variance += H[i, r] * P[r, k] * H[i, k]
        w = min(_LARGEST, max(-_LARGEST, nu[i] / math.sqrt(variance)))
        state[WHEEL_SUMS + i] = _KEEP * state[WHEEL_SUMS + i] + w
        if abs(state[WHEEL_SUMS + i]) > _SUM_LIMIT:
            slips = True
    if slips:
        return -1
    dx = np.zeros(n)
    R, information = np.full(2, sigma * sigma), np.zeros((2, 2))
    _, used = joint_update(P, H, nu, R, status, _GATE, dx, np.zeros(2), information)
    nowhere = np.full(2, -1, np.int64)
    spread_signatures(state, channels, H, nu, R, status, information, nowhere, nowhere, 0.0)
    inject(state, channels, dx)
    return used if used > 0 else -1
