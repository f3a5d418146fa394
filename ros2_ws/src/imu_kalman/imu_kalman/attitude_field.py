# SPDX-License-Identifier: Apache-2.0
"""Heading from the magnetic field: reference, disturbance and update; model: see `attitude_kernel`."""

import math

from numba import njit

from imu_kalman.attitude_layout import (
    ALIGNED,
    DIP_GATE,
    GAIN,
    MAG_COUNT,
    MAG_DECAY,
    MAG_DISTURBED,
    MAG_LEVEL,
    MAG_MEAN_NIS,
    MAG_N,
    MAG_NIS,
    MAG_PSD,
    MAG_RELEARNED,
    MAG_SPAN,
    MAG_STATUS,
    MAG_USED,
    MAG_WAIT,
    MIN_FIELD,
    NEW_DIP,
    NEW_NORM,
    NEW_TIME,
    NORM_GATE,
    REF_AGE,
    REF_DIP,
    REF_MEMORY,
    REF_NORM,
    REF_RECOVERY,
    ROW,
    START_SPAN,
    UNKNOWN_ANGLE_VAR,
    VECTORS,
    N,
)
from imu_kalman.attitude_linear import inject, scalar_update, turned_since

# Spans up to this age (s) of the field reference are averaged equally: a start needs a value at once.
_REF_START = 2.0
# Measured levels of motion and of magnetic disturbance rise this much faster than they decay: both start
# suddenly.
_ATTACK = 4.0
# Mean square of the relative disturbance of a field that nothing is known of: indoors 0.3 is common.
_UNKNOWN_DISTURBANCE = 0.3**2
# A mean NIS of the heading as large as 5 sigma throughout this time (s) contradicts the heading.
_CONTRADICTION = 25.0
_CONTRADICTION_MEMORY = 1.0
# Noise densities hold for the time since the last field, up to this (s).
_LONGEST_WAIT = 1.0
# Below this share of the horizontal field heading is not observable.
_MIN_HORIZONTAL = 0.05


@njit(cache=True, nogil=True)
def turn_field(state, x, y):
    """Turn the field summed in this block by the rotation vector (x, y, 0) [rad]."""
    angle = math.sqrt(x * x + y * y)
    if angle == 0.0:
        return
    ux, uy = x / angle, y / angle
    c, s = math.cos(angle), math.sin(angle)
    mx, my, mz = state[MAG_N], state[MAG_N + 1], state[MAG_N + 2]
    along = (1.0 - c) * (ux * mx + uy * my)
    state[MAG_N] = c * mx + s * uy * mz + along * ux
    state[MAG_N + 1] = c * my - s * ux * mz + along * uy
    state[MAG_N + 2] = c * mz + s * (ux * my - uy * mx)


@njit(cache=True, nogil=True)
def magnetic_update(state, par, work, cov):
    """Check the block's mean field against the reference and correct heading with it."""
    inverse = 1.0 / state[MAG_COUNT]
    mx = state[MAG_N] * inverse
    my = state[MAG_N + 1] * inverse
    mz = state[MAG_N + 2] * inverse
    horizontal = math.sqrt(mx * mx + my * my)
    norm = math.sqrt(horizontal * horizontal + mz * mz)
    if norm < MIN_FIELD:
        return
    span = min(state[MAG_WAIT], _LONGEST_WAIT)
    state[MAG_WAIT] = 0.0
    dip = math.atan2(-mz, horizontal)
    # A reference needs roll and pitch: while these are sought, any field is taken and little believed.
    disturbance = _UNKNOWN_DISTURBANCE
    if state[ALIGNED] >= par[START_SPAN]:
        disturbance = field_disturbance(state, par, norm, dip, span)
        if not field_accepted(state, par, norm, dip, span):
            return
    share = max(horizontal / norm, _MIN_HORIZONTAL)
    # A disturbance e of any direction turns the horizontal field by e / cos(dip).
    disturbed = disturbance / (share * share)
    h = work[VECTORS, ROW]
    h[:] = 0.0
    # Taken where the field is expected (north), not where it was found: a row that follows the measured
    # direction correlates with the innovation and would turn its noise into a lasting tilt.
    h[1] = -mz / max(horizontal, _MIN_HORIZONTAL * norm)
    h[2] = 1.0
    innovation = math.atan2(mx, my) - turned_since(work, h)
    if cov[2, 2] >= UNKNOWN_ANGLE_VAR or state[ALIGNED] < par[START_SPAN]:
        set_heading(state, cov, work, math.atan2(mx, my), par[MAG_PSD] / span + disturbed)
        return
    variance = (par[MAG_PSD] + par[MAG_SPAN] * disturbed) / span
    total = scalar_update(state, cov, work, h, innovation, variance, True)
    nis = innovation * innovation / total
    state[MAG_NIS] = nis
    state[MAG_MEAN_NIS] += (nis - state[MAG_MEAN_NIS]) * min(1.0, span / _CONTRADICTION_MEMORY)
    if state[MAG_MEAN_NIS] > _CONTRADICTION:
        forget_angle(cov, 2)
        state[MAG_MEAN_NIS] = 0.0
        state[MAG_STATUS] = MAG_RELEARNED


@njit(cache=True, nogil=True)
def forget_angle(cov, axis):
    """Make the attitude about an axis unknown and independent of all else; a field then sets heading."""
    for i in range(N):
        cov[axis, i] = 0.0
        cov[i, axis] = 0.0
    cov[axis, axis] = UNKNOWN_ANGLE_VAR


@njit(cache=True, nogil=True)
def set_heading(state, cov, work, angle, variance):
    """Turn an unknown heading by `angle` (rad) at once, whatever its size."""
    gain = work[VECTORS, GAIN]
    gain[:] = 0.0
    gain[2] = 1.0
    inject(state, work, angle)
    forget_angle(cov, 2)
    cov[2, 2] = min(variance, UNKNOWN_ANGLE_VAR)


@njit(cache=True, nogil=True)
def field_disturbance(state, par, norm, dip, span):
    """Return the mean square of the field's relative disturbance, as far as strength and dip show it.

    It is the largest of this block's, the level followed, and, for a young reference, what a field might be
    disturbed by that has no other to be compared with.
    """
    if state[REF_AGE] == 0.0:
        state[REF_NORM] = norm
        state[REF_DIP] = dip
    strength = norm / state[REF_NORM] - 1.0
    angle = dip - state[REF_DIP]
    shown = 0.5 * (strength * strength + angle * angle)
    rate = _ATTACK if shown > state[MAG_LEVEL] else 1.0
    state[MAG_LEVEL] += (shown - state[MAG_LEVEL]) * min(1.0, rate * span / par[MAG_DECAY])
    unknown = _UNKNOWN_DISTURBANCE * math.exp(-state[REF_AGE] / _REF_START)
    return max(unknown, max(shown, state[MAG_LEVEL]))


@njit(cache=True, nogil=True)
def field_accepted(state, par, norm, dip, span):
    """Gate strength (T) and dip (rad, down positive) against the reference; follow or relearn it."""
    if state[REF_AGE] == 0.0:
        state[REF_NORM] = norm
        state[REF_DIP] = dip
    if (
        abs(norm - state[REF_NORM]) <= par[NORM_GATE] * state[REF_NORM]
        and abs(dip - state[REF_DIP]) <= par[DIP_GATE]
    ):
        state[REF_AGE] += span
        memory = state[REF_AGE] if state[REF_AGE] < _REF_START else par[REF_MEMORY]
        weight = min(1.0, span / memory)
        state[REF_NORM] += weight * (norm - state[REF_NORM])
        state[REF_DIP] += weight * (dip - state[REF_DIP])
        state[NEW_TIME] = 0.0
        state[MAG_STATUS] = MAG_USED
        return True
    state[MAG_STATUS] = MAG_DISTURBED
    same = abs(norm - state[NEW_NORM]) <= par[NORM_GATE] * state[NEW_NORM]
    if state[NEW_TIME] == 0.0 or not same or abs(dip - state[NEW_DIP]) > par[DIP_GATE]:
        state[NEW_NORM] = norm
        state[NEW_DIP] = dip
        state[NEW_TIME] = span
        return False
    state[NEW_TIME] += span
    weight = span / state[NEW_TIME]
    state[NEW_NORM] += weight * (norm - state[NEW_NORM])
    state[NEW_DIP] += weight * (dip - state[NEW_DIP])
    # A young reference (a start beside iron) has no more right than a field that lasts as long.
    if state[NEW_TIME] < min(par[REF_RECOVERY], max(state[REF_AGE], _REF_START)):
        return False
    state[REF_NORM] = state[NEW_NORM]
    state[REF_DIP] = state[NEW_DIP]
    state[NEW_TIME] = 0.0
    state[MAG_STATUS] = MAG_RELEARNED
    return True
