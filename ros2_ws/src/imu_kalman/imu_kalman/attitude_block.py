# SPDX-License-Identifier: Apache-2.0
"""The error-state update at the end of each block; model and sources: see `attitude_kernel`."""

import math

from numba import njit

from imu_kalman.attitude_layout import (
    ACC_PSD,
    ACC_SUM,
    BIAS,
    BIAS_PSD,
    CORRECTION,
    COUNT,
    COV,
    DAMPING,
    DIP_GATE,
    FORCE_N,
    GAIN,
    GYR_SUM,
    GYRO_PSD,
    HALF,
    LEVEL,
    LEVEL_DECAY,
    LEVEL_MIN,
    LEVEL_SPAN,
    MAG_COUNT,
    MAG_DECAY,
    MAG_DISTURBED,
    MAG_LEVEL,
    MAG_N,
    MAG_NIS,
    MAG_PSD,
    MAG_RELEARNED,
    MAG_SPAN,
    MAG_STATUS,
    MAG_USED,
    MOTION_ACC,
    MOTION_AGE,
    MOTION_NIS,
    MOTION_VEL,
    NEW_DIP,
    NEW_NORM,
    NEW_TIME,
    NORM_GATE,
    OMEGA_MAX,
    OMEGA_MIN,
    OMEGA_SHARE,
    PH,
    PHI,
    POS,
    PRIOR,
    RATE2,
    REF_AGE,
    REF_DIP,
    REF_MEMORY,
    REF_NORM,
    REF_RECOVERY,
    REST_ACC,
    REST_FORCE,
    REST_GYR,
    REST_PSD,
    REST_RATE,
    REST_SPAN,
    REST_TIME,
    ROT,
    ROW,
    SCALE_PSD,
    SPAN,
    USE_MAG,
    VECTORS,
    VEL,
    N,
    Q,
)

# Spans up to this age (s) of the field reference are averaged equally: a start needs a value at once.
_REF_START = 2.0
# Measured levels of motion and of magnetic disturbance rise this much faster than they decay: both start
# suddenly.
_ATTACK = 4.0
# Time constant (s) of the mean squares that give the frequency of the motion: a few of its periods.
_FREQUENCY_MEMORY = 10.0
# Keeps the ratio finite before anything has moved ((m/s)²).
_LEAST_VEL2 = 1e-9
# Below this share of the horizontal field heading is not observable.
_MIN_HORIZONTAL = 0.05


@njit(cache=True, nogil=True)
def turn(state, x, y, z):
    """Left-multiply the attitude by the exponential of the rotation vector (x, y, z) [rad], exactly."""
    h2 = 0.25 * (x * x + y * y + z * z)
    h = math.sqrt(h2)
    c = math.cos(h)
    s = 0.5 * math.sin(h) / h if h > 1e-6 else 0.5
    x *= s
    y *= s
    z *= s
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    a0 = c * q0 - x * q1 - y * q2 - z * q3
    a1 = c * q1 + x * q0 + y * q3 - z * q2
    a2 = c * q2 - x * q3 + y * q0 + z * q1
    a3 = c * q3 + x * q2 - y * q1 + z * q0
    n = 1.0 / math.sqrt(a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    state[Q] = a0 * n
    state[Q + 1] = a1 * n
    state[Q + 2] = a2 * n
    state[Q + 3] = a3 * n


@njit(cache=True, nogil=True)
def inject(state, work, scale):
    """Apply the correction ``gain * scale`` (N,) to attitude, bias, velocity and position, and sum it."""
    gain = work[VECTORS, GAIN]
    for i in range(N):
        work[VECTORS, CORRECTION, i] += gain[i] * scale
    turn(state, gain[0] * scale, gain[1] * scale, gain[2] * scale)
    for i in range(3):
        state[BIAS + i] += gain[3 + i] * scale
    for i in range(2):
        state[VEL + i] += gain[6 + i] * scale
        state[POS + i] += gain[8 + i] * scale


@njit(cache=True, nogil=True)
def clear_sums(state):
    """Begin a new block."""
    state[SPAN : MAG_COUNT + 1] = 0.0


@njit(cache=True, nogil=True)
def transition(state, phi):
    """Fill the (N, N) transition matrix of the block; its structure is described in `propagate`."""
    span = state[SPAN]
    fx, fy, fz = state[FORCE_N], state[FORCE_N + 1], state[FORCE_N + 2]
    phi[:] = 0.0
    for i in range(N):
        phi[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            phi[i, 3 + j] = -state[ROT + 3 * i + j]
    phi[6, 1] = fz
    phi[6, 2] = -fy
    phi[7, 0] = -fz
    phi[7, 2] = fx
    for i in range(2):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += phi[6 + i, k] * state[ROT + 3 * k + j]
            # Constant force and bias over the block: the bias acts on velocity through half of the span.
            phi[6 + i, 3 + j] = -0.5 * s
            phi[8 + i, 3 + j] = -span / 6.0 * s
            phi[8 + i, j] = 0.5 * span * phi[6 + i, j]
        phi[8 + i, 6 + i] = span


@njit(cache=True, nogil=True)
def propagate(state, par, work, cov):
    """Move `cov` over the block: ``cov = phi cov phi' + Q`` (phi is left in work[PHI])."""
    phi = work[PHI]
    half = work[HALF]
    transition(state, phi)
    for j in range(N):
        for i in range(3):
            s = cov[i, j]
            for k in range(3, 6):
                s += phi[i, k] * cov[k, j]
            half[i, j] = s
            half[3 + i, j] = cov[3 + i, j]
        for i in range(6, 8):
            s = cov[i, j]
            t = cov[i + 2, j] + phi[i + 2, i] * cov[i, j]
            for k in range(6):
                s += phi[i, k] * cov[k, j]
                t += phi[i + 2, k] * cov[k, j]
            half[i, j] = s
            half[i + 2, j] = t
    for i in range(N):
        for j in range(3):
            s = half[i, j]
            for k in range(3, 6):
                s += half[i, k] * phi[j, k]
            cov[i, j] = s
            cov[i, 3 + j] = half[i, 3 + j]
        for j in range(6, 8):
            s = half[i, j]
            t = half[i, j + 2] + half[i, j] * phi[j + 2, j]
            for k in range(6):
                s += half[i, k] * phi[j, k]
                t += half[i, k] * phi[j + 2, k]
            cov[i, j] = s
            cov[i, j + 2] = t
    span = state[SPAN]
    attitude_var = par[GYRO_PSD] * span + par[SCALE_PSD] * state[RATE2]
    for i in range(3):
        cov[i, i] += attitude_var
        cov[3 + i, 3 + i] += par[BIAS_PSD] * span
    for i in range(6, 8):
        cov[i, i] += par[ACC_PSD] * span
    for i in range(N):
        for j in range(i):
            cov[i, j] = cov[j, i]


@njit(cache=True, nogil=True)
def scalar_update(state, cov, work, h, innovation, variance, considered):
    """Correct with one scalar measurement of row `h` (N,) and noise `variance`.

    With `considered` only heading and bias are corrected and the covariance is that of this smaller gain.
    Returns the variance of the innovation.
    """
    ph = work[VECTORS, PH]
    gain = work[VECTORS, GAIN]
    s = variance
    for i in range(N):
        t = 0.0
        for j in range(N):
            t += cov[i, j] * h[j]
        ph[i] = t
        s += h[i] * t
    for i in range(N):
        gain[i] = ph[i]
    if considered:
        gain[0] = 0.0
        gain[1] = 0.0
        for i in range(6, N):
            gain[i] = 0.0
    inverse = 1.0 / s
    for i in range(N):
        for j in range(i + 1):
            # P - K h'P - P h K' + K s K', which for the full gain is the usual P - K s K'.
            t = cov[i, j] + inverse * (gain[i] * gain[j] - gain[i] * ph[j] - ph[i] * gain[j])
            cov[i, j] = t
            cov[j, i] = t
    inject(state, work, innovation * inverse)
    return s


@njit(cache=True, nogil=True)
def rest_update(state, par, work, cov):
    """Detect rest and, at rest, measure the bias with the mean rate of the block.

    Rest: for `rest_time` all block means of rate and specific force lay within a small distance of their
    running mean. Block means, not samples: noise and vibration average out, so the limits can be far below
    what slow rolling shows (a rate that is steady for seconds tilts, and the force gives that away).
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
    if state[REST_TIME] < par[REST_SPAN]:
        return
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
        mean = state[FORCE_N + i] / span
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
def magnetic_update(state, par, work, cov):
    """Check the block's mean field against the reference and correct heading with it."""
    span = state[SPAN]
    inverse = 1.0 / state[MAG_COUNT]
    mx = state[MAG_N] * inverse
    my = state[MAG_N + 1] * inverse
    mz = state[MAG_N + 2] * inverse
    horizontal = math.sqrt(mx * mx + my * my)
    norm = math.sqrt(horizontal * horizontal + mz * mz)
    dip = math.atan2(-mz, horizontal)
    disturbance = field_disturbance(state, par, norm, dip, span)
    if not field_accepted(state, par, norm, dip, span):
        return
    if horizontal < _MIN_HORIZONTAL * norm:
        return
    # A disturbance e of any direction turns the horizontal field by e / cos(dip).
    variance = (par[MAG_PSD] + par[MAG_SPAN] * disturbance / math.cos(state[REF_DIP]) ** 2) / span
    h = work[VECTORS, ROW]
    h[:] = 0.0
    slope = mz / (horizontal * horizontal)
    h[0] = -mx * slope
    h[1] = -my * slope
    h[2] = 1.0
    innovation = math.atan2(mx, my)
    total = scalar_update(state, cov, work, h, innovation, variance, True)
    state[MAG_NIS] = innovation * innovation / total


@njit(cache=True, nogil=True)
def field_disturbance(state, par, norm, dip, span):
    """Follow the mean square of the field's relative disturbance by strength and dip; return the larger of
    it and this block's.
    """
    if state[REF_AGE] == 0.0:
        state[REF_NORM] = norm
        state[REF_DIP] = dip
    strength = norm / state[REF_NORM] - 1.0
    angle = dip - state[REF_DIP]
    shown = 0.5 * (strength * strength + angle * angle)
    rate = _ATTACK if shown > state[MAG_LEVEL] else 1.0
    state[MAG_LEVEL] += (shown - state[MAG_LEVEL]) * min(1.0, rate * span / par[MAG_DECAY])
    return max(shown, state[MAG_LEVEL])


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
    if state[NEW_TIME] < par[REF_RECOVERY]:
        return False
    state[REF_NORM] = state[NEW_NORM]
    state[REF_DIP] = state[NEW_DIP]
    state[NEW_TIME] = 0.0
    state[MAG_STATUS] = MAG_RELEARNED
    return True


@njit(cache=True, nogil=True)
def close_block(state, par, work):
    """Propagate the covariance over the block and apply its measurements; False when numerics failed."""
    cov = state[COV:].reshape(N, N)
    propagate(state, par, work, cov)
    work[PRIOR, :, :] = cov
    work[VECTORS, CORRECTION] = 0.0
    rest_update(state, par, work, cov)
    motion_update(state, par, work, cov)
    if par[USE_MAG] != 0.0 and state[MAG_COUNT] > 0.0:
        magnetic_update(state, par, work, cov)
    clear_sums(state)
    trace = 0.0
    for i in range(N):
        if not cov[i, i] >= 0.0:
            return False
        trace += cov[i, i]
    return math.isfinite(trace + state[Q] + state[VEL] + state[VEL + 1] + state[POS] + state[POS + 1])
