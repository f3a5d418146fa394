# SPDX-License-Identifier: Apache-2.0
"""The magnetic heading of the inertial attitude filter: gated, and never a judge of tilt."""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import matrix_from_quat, quat_from_rotvec, quat_multiply, quat_normalize, wrap
from ship_inclinometer.attitude_layout import (
    C_DECLINATION,
    C_DEVIATION,
    C_DIP_GATE,
    C_MAG_LOCKOUT,
    C_MAG_NOISE,
    C_NORM_GATE,
    C_SWING,
    DEV,
    GATED,
    HEADING,
    MAG_DIP,
    MAG_NORM,
    MAG_RELEARNED,
    OK,
    P_,
    PHASE_ALIGN,
    RELEARNED_DEVIATION,
    S_COV,
    S_DIP,
    S_FIELD_TIME,
    S_MAG,
    S_MAG_BAD,
    S_MAG_LAST,
    S_MAG_LAST_TIME,
    S_MAG_R,
    S_NORM,
    S_P,
    S_PHASE,
    S_Q,
    S_V,
    S_VP,
    S_X1,
    S_X2,
    TH,
    VP,
    X1,
    X2,
    N,
    V,
)
from ship_inclinometer.attitude_update import heading_angle, innovation_variance, scalar_update


@njit(cache=True, nogil=True)
def mag_step(state, c, t, field, gate):
    """Use a magnetic field (3,) [T] for the heading alone; return (code, NIS).

    Gated by norm and dip against what was learned, then by the innovation. Tilt is considered, never moved.
    While aligning the heading is simply that of the field: through a tilt that may be 30 deg off, the dip
    makes any heading of it, and no small-angle filter comes back from there.
    """
    cov = state[S_COV:].reshape(N, N)
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    m = mat @ field
    norm = math.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
    level2 = m[0] ** 2 + m[1] ** 2
    if not level2 > (0.05 * norm) ** 2:
        return MAG_DIP, 0.0
    north = 0.5 * math.pi - c[C_DECLINATION]
    innovation = wrap(north - math.atan2(m[1], m[0]))
    innovation = wrap(innovation - _deviation(c, north - heading_angle(state) - innovation))
    white = (c[C_MAG_NOISE] ** 2) / level2
    if state[S_PHASE] == PHASE_ALIGN or state[S_MAG] < 0.0:
        _set_heading(state, cov, c, innovation)
        state[S_NORM] = norm
        state[S_DIP] = -m[2] / norm
        state[S_MAG_R] = white
        state[S_MAG] = t
        return OK, 1.0
    code = _judge_field(state, cov, c, norm, -m[2] / norm)
    h = np.zeros(N)
    h[TH] = -m[2] * m[0] / level2
    h[TH + 1] = -m[2] * m[1] / level2
    h[TH + 2] = 1.0
    h[DEV] = 1.0
    spread = innovation_variance(cov, h)
    if t - state[S_MAG_LAST_TIME] < 0.1 and state[S_MAG_LAST_TIME] >= 0.0:
        # Half the square of successive differences is white noise alone, whatever the deviation.
        difference = min(abs(wrap(innovation - state[S_MAG_LAST])), 0.2)
        state[S_MAG_R] += 0.01 * (0.5 * difference**2 - state[S_MAG_R])
    state[S_MAG_LAST] = innovation
    state[S_MAG_LAST_TIME] = t
    variance = max(state[S_MAG_R], 0.25 * white)
    nis = innovation**2 / (spread + variance)
    if code == OK and nis > gate:
        code = GATED
    if code != OK:
        if state[S_MAG_BAD] < 0.0:
            state[S_MAG_BAD] = t
        if t - state[S_MAG_BAD] > c[C_MAG_LOCKOUT]:
            # The field has changed for good (cargo, a crane): start from it with a wide deviation.
            cov[DEV, DEV] += RELEARNED_DEVIATION**2
            if innovation**2 > gate * (spread + variance + RELEARNED_DEVIATION**2):
                # No cargo turns it that far: it is the heading that was lost.
                _set_heading(state, cov, c, innovation)
            state[S_NORM] = norm
            state[S_DIP] = -m[2] / norm
            state[S_FIELD_TIME] = 0.0
            state[S_MAG_BAD] = -1.0
            return MAG_RELEARNED, nis
        return code, nis
    state[S_MAG_BAD] = -1.0
    _learn_field(state, norm, -m[2] / norm, min(t - state[S_MAG], 1.0))
    state[S_MAG] = t
    scalar_update(state, cov, h, innovation, variance, HEADING, mat[2])
    return OK, nis


@njit(cache=True, nogil=True)
def _deviation(c, heading):
    """Return what the ship swing found at a magnetic heading [rad, clockwise], see `calibration.swing`."""
    once = c[C_SWING + 1] * math.sin(heading) + c[C_SWING + 2] * math.cos(heading)
    twice = c[C_SWING + 3] * math.sin(2.0 * heading) + c[C_SWING + 4] * math.cos(2.0 * heading)
    return c[C_SWING] + once + twice


@njit(cache=True, nogil=True)
def _set_heading(state, cov, c, innovation):
    """Turn the attitude, and all that is known in the level plane, onto the magnetic heading."""
    turn = quat_from_rotvec(np.array([0.0, 0.0, innovation]))
    state[S_Q : S_Q + 4] = quat_normalize(quat_multiply(turn, state[S_Q : S_Q + 4]))
    cosine, sine = math.cos(innovation), math.sin(innovation)
    for i in (S_V, S_P, S_VP, S_X1, S_X2):
        x, y = state[i], state[i + 1]
        state[i] = cosine * x - sine * y
        state[i + 1] = sine * x + cosine * y
    # What is doubted in the level plane turns along, else it would point another way in body axes.
    for i in (TH, V, P_, VP, X1, X2):
        for j in range(N):
            x, y = cov[i, j], cov[i + 1, j]
            cov[i, j] = cosine * x - sine * y
            cov[i + 1, j] = sine * x + cosine * y
        for j in range(N):
            x, y = cov[j, i], cov[j, i + 1]
            cov[j, i] = cosine * x - sine * y
            cov[j, i + 1] = sine * x + cosine * y
    for j in range(N):
        cov[TH + 2, j] = 0.0
        cov[j, TH + 2] = 0.0
    # The tilt at the start may be 10 deg off, and the dip multiplies that.
    cov[TH + 2, TH + 2] = 0.3**2 + c[C_DEVIATION] ** 2


@njit(cache=True, nogil=True)
def _judge_field(state, cov, c, norm, dip):
    tilt = math.sqrt(cov[TH, TH] + cov[TH + 1, TH + 1])
    if abs(norm / state[S_NORM] - 1.0) > c[C_NORM_GATE]:
        return MAG_NORM
    if abs(math.asin(min(max(dip, -1.0), 1.0)) - math.asin(state[S_DIP])) > c[C_DIP_GATE] + 3.0 * tilt:
        return MAG_DIP
    return OK


@njit(cache=True, nogil=True)
def _learn_field(state, norm, dip, dt):
    """Follow norm and dip: a mean over the first 100 s, then with 100 s."""
    state[S_FIELD_TIME] = min(state[S_FIELD_TIME] + dt, 100.0)
    weight = min(dt / max(state[S_FIELD_TIME], dt, 1e-3), 1.0)
    state[S_NORM] += weight * (norm - state[S_NORM])
    state[S_DIP] = min(max(state[S_DIP] + weight * (dip - state[S_DIP]), -1.0), 1.0)
