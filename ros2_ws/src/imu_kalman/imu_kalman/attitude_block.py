# SPDX-License-Identifier: Apache-2.0
"""What happens at the end of each block: rest, motion, alignment; model: see `attitude_kernel`."""

import math

from numba import njit

from imu_kalman.attitude_faults import follow_readings
from imu_kalman.attitude_field import forget_angle, magnetic_update, turn_field
from imu_kalman.attitude_layout import (
    ACC_SUM,
    ALIGNED,
    BIAS,
    BIAS_VAR,
    BLIND,
    BROKEN,
    CORRECTION,
    COUNT,
    COV,
    DAMPING,
    DEAF,
    FAILED,
    FORCE_N,
    GRAVITY,
    GRAVITY_NORM,
    GYR_SUM,
    LEVEL,
    LEVEL_DECAY,
    LEVEL_MIN,
    LEVEL_SPAN,
    LINK,
    LINKED,
    LOST,
    MAG_COUNT,
    MAG_WAIT,
    MIN_FORCE,
    MOTION_ACC,
    MOTION_AGE,
    MOTION_NIS,
    MOTION_VEL,
    OK,
    OMEGA_MAX,
    OMEGA_MIN,
    OMEGA_SHARE,
    PHI,
    POS,
    PRIOR,
    PUSHED,
    REALIGNING,
    REPEATS,
    REST_ACC,
    REST_FORCE,
    REST_GYR,
    REST_PSD,
    REST_RATE,
    REST_SPAN,
    REST_TIME,
    RESTS,
    RIGID,
    ROW,
    SPAN,
    START_SPAN,
    START_VEL_VAR,
    STUCK,
    UNKNOWN_ANGLE_VAR,
    USE_MAG,
    VECTORS,
    VEL,
    N,
    Q,
)
from imu_kalman.attitude_linear import (
    propagate,
    scalar_update,
    start_covariance,
    turn,
    turned_since,
    whole_turn,
)

# Measured levels of motion and of magnetic disturbance rise this much faster than they decay: both start
# suddenly.
_ATTACK = 4.0
# Time constant (s) of the mean squares that give the frequency of the motion: a few of its periods.
_FREQUENCY_MEMORY = 10.0
# Keeps the ratio finite before anything has moved ((m/s)²).
_LEAST_VEL2 = 1e-9
# A mean rate this many sigma from the known bias is a turn rather than a bias,
_TURN_GATE = 5.0
# unless it stays for this many times `rest_time`: no check may lock the filter out.
_TURN_PATIENCE = 40.0
# At rest speed (m/s) and distance from the mean place (m) are below 0.05.
_STILL_VAR = 0.05**2
# With a variance of both tilt angles together beyond this (rad²) corrections are not linear any more.
_LOST_TILT = 0.5
# At rest a tilt error (rad) beyond this and beyond 5 sigma is no accelerometer bias (0.5 m/s²).
_REST_TILT = 0.05
# At rest force shows tilt to the accelerometer's bias: so much (rad) is wrong however unsure the filter is.
_REST_TILT_SURE = 0.08


@njit(cache=True, nogil=True)
def clear_sums(state):
    """Begin a new block."""
    state[SPAN : MAG_COUNT + 1] = 0.0
    state[STUCK : REPEATS + 4] = 0.0


@njit(cache=True, nogil=True)
def hold_still(state, cov):
    """Set velocity and position of the motion to zero, known well and independent of all else."""
    state[VEL : POS + 2] = 0.0
    state[LEVEL] = 0.0
    for i in range(6, N):
        for j in range(N):
            cov[i, j] = 0.0
            cov[j, i] = 0.0
        cov[i, i] = _STILL_VAR


@njit(cache=True, nogil=True)
def rest_needed(state, par, cov):
    """Return the quiet time (s) after which the mean rate is believed to be bias, infinite for a turn.

    A turn that leaves the force as it is can only be one about the vertical, so the rate along the force is
    what counts. A bias moves away slowly from what is known of it, and never beyond what `bias_sigma` says.
    """
    force2 = rate = change = variance = 0.0
    for i in range(3):
        up = state[REST_ACC + i]
        force2 += up * up
        rate += up * state[REST_GYR + i]
        change += up * (state[REST_GYR + i] - state[BIAS + i])
        for j in range(3):
            variance += up * cov[3 + i, 3 + j] * state[REST_ACC + j]
    gate2 = _TURN_GATE * _TURN_GATE
    if force2 < par[MIN_FORCE] * par[MIN_FORCE] or rate * rate > gate2 * par[BIAS_VAR] * force2:
        return math.inf
    known = math.sqrt(max(variance, 0.0) / force2 + par[REST_PSD] / par[REST_SPAN])
    if abs(change) / math.sqrt(force2) > _TURN_GATE * known + par[REST_RATE]:
        return _TURN_PATIENCE * par[REST_SPAN]
    return par[REST_SPAN]


@njit(cache=True, nogil=True)
def rest_update(state, par, work, cov):
    """Detect rest and, at rest, measure the bias with the mean rate of the block.

    Rest: for `rest_time` all block means of rate and specific force lay within a small distance of their
    running mean. Block means, not samples: noise and vibration average out, so the limits can be far below
    what slow rolling shows (a rate that is steady for seconds tilts, and the force gives that away). A steady
    turn about the vertical does not tilt: `rest_needed` tells it from a bias.
    """
    inverse = 1.0 / state[COUNT]
    quiet = state[REST_TIME] > 0.0
    for i in range(3):
        rate = abs(state[GYR_SUM + i] * inverse - state[REST_GYR + i])
        force = abs(state[ACC_SUM + i] * inverse - state[REST_ACC + i])
        quiet = quiet and rate <= par[REST_RATE] and force <= par[REST_FORCE]
    state[REST_TIME] = state[REST_TIME] + state[SPAN] if quiet else state[SPAN]
    weight = state[SPAN] / min(state[REST_TIME], par[REST_SPAN])
    for i in range(3):
        state[REST_GYR + i] += weight * (state[GYR_SUM + i] * inverse - state[REST_GYR + i])
        state[REST_ACC + i] += weight * (state[ACC_SUM + i] * inverse - state[REST_ACC + i])
    if state[REST_TIME] < rest_needed(state, par, cov):
        return
    state[RESTS] += 1.0
    hold_still(state, cov)
    h = work[VECTORS, ROW]
    for i in range(3):
        h[:] = 0.0
        h[3 + i] = 1.0
        innovation = state[GYR_SUM + i] * inverse - state[BIAS + i]
        scalar_update(state, cov, work, h, innovation, par[REST_PSD] / state[SPAN], False)


@njit(cache=True, nogil=True)
def motion_frequency(state, par):
    """Follow the mean squares of acceleration and velocity; return w0 (rad/s) of the motion model.

    For any narrow band their ratio is the band's frequency squared; w0 is a share of that frequency.
    """
    span = state[SPAN]
    state[MOTION_AGE] += span
    weight = span / min(state[MOTION_AGE], _FREQUENCY_MEMORY)
    acc2 = (state[FORCE_N] ** 2 + state[FORCE_N + 1] ** 2) / (span * span)
    vel2 = state[VEL] ** 2 + state[VEL + 1] ** 2
    state[MOTION_ACC] += weight * (acc2 - state[MOTION_ACC])
    state[MOTION_VEL] += weight * (vel2 - state[MOTION_VEL])
    omega = par[OMEGA_SHARE] * math.sqrt(state[MOTION_ACC] / max(state[MOTION_VEL], _LEAST_VEL2))
    return min(max(omega, par[OMEGA_MIN]), par[OMEGA_MAX])


@njit(cache=True, nogil=True)
def motion_update(state, par, work, cov):
    """Measure the equation of the motion with the mean horizontal acceleration of the block."""
    span = state[SPAN]
    phi = work[PHI]
    h = work[VECTORS, ROW]
    omega = motion_frequency(state, par)
    c_vel = 2.0 * par[DAMPING] * omega
    c_pos = omega * omega
    variance = max(par[LEVEL_MIN], par[LEVEL_SPAN] * state[LEVEL]) / span
    power = 0.0
    nis = 0.0
    for i in range(2):
        h[:] = 0.0
        for k in range(3):
            h[k] = phi[6 + i, k] / span
        h[6 + i] = c_vel
        h[8 + i] = c_pos
        # The force was summed before the updates of this block turned the attitude.
        mean = state[FORCE_N + i] / span + turned_since(work, h)
        innovation = -(mean + c_vel * state[VEL + i] + c_pos * state[POS + i])
        total = scalar_update(state, cov, work, h, innovation, variance, False)
        nis += innovation * innovation / total
        # What the innovation shows beyond what the state's own uncertainty explains.
        power += innovation * innovation - (total - variance)
    state[MOTION_NIS] = nis
    shown = max(0.5 * power, 0.0)
    rate = _ATTACK if shown > state[LEVEL] else 1.0
    state[LEVEL] += (shown - state[LEVEL]) * min(1.0, rate * span / par[LEVEL_DECAY])


@njit(cache=True, nogil=True)
def align(state, par, work, cov):
    """Turn the attitude so that the specific force summed since the start points up.

    The sum is taken in local level as it is believed, so it may turn by any angle; a linear update could not
    follow. Motion that stays in place adds little to a sum over a second.
    """
    for i in range(3):
        state[GRAVITY + i] += state[FORCE_N + i]
    gx, gy, gz = state[GRAVITY], state[GRAVITY + 1], state[GRAVITY + 2]
    horizontal = math.sqrt(gx * gx + gy * gy)
    start_covariance(state, par, cov)
    state[VEL : POS + 2] = 0.0
    link = work[VECTORS, LINK]
    link[0] = BROKEN if state[ALIGNED] < 0.0 else RIGID
    state[ALIGNED] = max(state[ALIGNED], 0.0) + state[SPAN]
    if horizontal > 0.0 or gz < 0.0:
        angle = math.atan2(horizontal, gz)
        x = angle * gy / horizontal if horizontal > 0.0 else angle
        y = -angle * gx / horizontal if horizontal > 0.0 else 0.0
        turn(state, x, y, 0.0)
        turn_field(state, x, y)
    state[GRAVITY] = 0.0
    state[GRAVITY + 1] = 0.0
    state[GRAVITY + 2] = math.sqrt(horizontal * horizontal + gz * gz)


@njit(cache=True, nogil=True)
def tilt_plausible(state, par, cov):
    """Follow the specific force in local level over `start_time`; False when it contradicts the attitude.

    Only a wrong attitude makes the mean of a bounded motion point below 45°; at rest any tilt beyond its
    uncertainty is wrong.
    """
    if state[REST_TIME] >= par[REST_SPAN]:
        shown = math.sqrt(state[FORCE_N] ** 2 + state[FORCE_N + 1] ** 2) / (GRAVITY_NORM * state[SPAN])
        if shown > min(max(_REST_TILT, 5.0 * math.sqrt(cov[0, 0] + cov[1, 1])), _REST_TILT_SURE):
            return False
    keep = max(0.0, 1.0 - state[SPAN] / max(par[START_SPAN], state[SPAN]))
    for i in range(3):
        state[GRAVITY + i] = keep * state[GRAVITY + i] + state[FORCE_N + i]
    gx, gy, gz = state[GRAVITY], state[GRAVITY + 1], state[GRAVITY + 2]
    return gx * gx + gy * gy <= gz * abs(gz)


@njit(cache=True, nogil=True)
def realign(state):
    """Begin the alignment with the next block; nothing of what was believed of tilt is carried over."""
    state[ALIGNED] = -1.0
    state[GRAVITY : GRAVITY + 3] = 0.0


@njit(cache=True, nogil=True)
def hide_motion(par, cov):
    """Add what speed and place may have changed by in a block without a measurement."""
    for i in range(2):
        cov[6 + i, 6 + i] += par[START_VEL_VAR]


@njit(cache=True, nogil=True)
def close_block(state, par, work):
    """Propagate the covariance over the block and apply its measurements.

    Returns OK, REALIGNING (the attitude contradicts gravity), LOST (tilt is unknown; alignment begins with
    either) or FAILED (numerics).
    """
    cov = state[COV:].reshape(N, N)
    code = OK
    work[VECTORS, LINK, 0] = LINKED
    propagate(state, par, work, cov)
    work[PRIOR, :, :] = cov
    work[VECTORS, CORRECTION] = 0.0
    before = work[VECTORS, LINK, 1:5]
    before[:] = state[Q : Q + 4]
    follow_readings(state)
    if state[STUCK] > 0.0:
        # Repeated or missing readings look like rest.
        state[REST_TIME] = 0.0
    else:
        rest_update(state, par, work, cov)
    if max(state[BLIND], state[DEAF]) > 0.5 * state[SPAN]:
        hide_motion(par, cov)
    elif state[PUSHED] > 0.0:
        # The mean force of the block is doubted.
        pass
    elif state[ALIGNED] < par[START_SPAN]:
        align(state, par, work, cov)
    elif cov[0, 0] + cov[1, 1] > _LOST_TILT:
        realign(state)
        code = LOST
    else:
        motion_update(state, par, work, cov)
        if not tilt_plausible(state, par, cov):
            realign(state)
            code = REALIGNING
    for i in range(3):
        if cov[i, i] > UNKNOWN_ANGLE_VAR:
            forget_angle(cov, i)
    state[MAG_WAIT] += state[SPAN]
    if par[USE_MAG] != 0.0 and state[MAG_COUNT] > 0.0:
        magnetic_update(state, par, work, cov)
    if work[VECTORS, LINK, 0] != LINKED:
        whole_turn(state, before, work[VECTORS, CORRECTION])
    clear_sums(state)
    trace = 0.0
    for i in range(N):
        if not cov[i, i] >= 0.0:
            return FAILED
        trace += cov[i, i]
    if not math.isfinite(trace + state[Q] + state[VEL] + state[VEL + 1] + state[POS] + state[POS + 1]):
        return FAILED
    return code
