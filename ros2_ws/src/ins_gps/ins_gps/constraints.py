# SPDX-License-Identifier: Apache-2.0
"""Optional pseudo-measurements: zero velocity while still, and a road vehicle's motion along its axis.

Source: Groves, 2nd ed., 15.1.4 (non-holonomic) and 15.3.2 (zero velocity).
"""

import math

import numpy as np
from numba import njit

from ins_gps.correction import ACCEPTED, joint_update
from ins_gps.layout import (
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
    ZERO_USED,
)
from ins_gps.prediction import advance_covariance, covariance_of, inject
from kalman_core.rotation import matrix_from_quat

# Zero velocity needs this long (s) of specific force and rate steady within these bounds.
_STILL_TIME = 1.0
_STILL_FORCE = 0.3  # m/s²
_STILL_RATE = 0.02  # rad/s
_STILL_SPEED = 1.0  # m/s: a steady cruise is not a stop
# Both kinds come at this interval (s); at IMU rate their errors would not be independent.
_INTERVAL = 0.2
_GATE = 15.0  # squared σ, 1e-4


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
    _, used = joint_update(
        P, H, nu, np.full(3, sigma * sigma), status, _GATE, dx, np.zeros(3), np.zeros((3, 3))
    )
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
    dx = np.zeros(n)
    _, used = joint_update(
        P, H, nu, np.full(2, sigma * sigma), status, _GATE, dx, np.zeros(2), np.zeros((2, 2))
    )
    inject(state, channels, dx)
    return used if used > 0 else -1
