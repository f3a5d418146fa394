# SPDX-License-Identifier: Apache-2.0
"""Kernels of the attitude filter: strapdown at sample rate, one error-state update per block.

Local level is ENU with y towards magnetic north. Per sample the kernels integrate the quaternion, rotate
the specific force un-normalised into local level and sum what the update needs; the covariance moves once
per block (`block` s, about ten samples), which is exact for the bias because the integral of the rotation
matrix is summed.

Error state (10), ``truth = exp(theta_n) * estimate`` and ``truth = estimate + error`` for the rest:
attitude theta_n (3), gyro bias b (3), horizontal velocity v (2), horizontal position p (2). Velocity and
position are those of a motion that stays where it is: a second-order Gauss-Markov process

    a = -2 zeta w0 v - w0² p + w,     w white with density q,

whose acceleration vanishes below w0 as omega². The mean horizontal acceleration of a block measures that
equation, so a lasting apparent acceleration is tilt and a passing one is motion. The density q is the larger
of a floor and what the innovations show.
The magnetic field corrects heading (and through it the bias) only; tilt and motion are considered, not
corrected (Schmidt's consider update).

Sources: Sola (2017) for the multiplicative error state; Gelb, "Applied Optimal Estimation" (1974), for
shaping filters and consider updates; the motion model in this role is this package's own.
"""

import math

import numpy as np
from numba import njit

N = 10
# Layout of the flat state.
SEC, NANOSEC, PHASE = 0, 1, 2
Q = 3
BIAS = 7
VEL = 10
POS = 12
LEVEL = 14  # density q of the motion noise as measured
RATE = 15  # last rate without bias, to carry a magnetometer sample back to the last attitude
SPAN = 18  # s summed in this block
COUNT = 19
RATE2 = 20  # integral of |rate|²
FORCE_N = 21  # integral of the specific force in local level (3)
ROT = 24  # integral of the rotation matrix (9)
GYR_SUM = 33
ACC_SUM = 36
MAG_N = 39  # sum of the field in local level (3)
MAG_COUNT = 42
REST_TIME = 43
REST_GYR = 44
REST_ACC = 47
REF_NORM, REF_DIP, REF_AGE = 50, 51, 52
NEW_NORM, NEW_DIP, NEW_TIME = 53, 54, 55
MAG_STATUS = 56
MOTION_NIS = 57
MAG_NIS = 58
LAST_DT = 59
COV = 60
STATE = COV + N * N

# Parameter vector.
(
    BLOCK,
    GYRO_PSD,
    SCALE_PSD,
    BIAS_PSD,
    BIAS_VAR,
    ACC_PSD,
    TILT_VAR,
    C_VEL,
    C_POS,
    LEVEL_MIN,
    LEVEL_DECAY,
    REST_RATE,
    REST_FORCE,
    REST_SPAN,
    REST_PSD,
    MAG_PSD,
    NORM_GATE,
    DIP_GATE,
    MAG_MEMORY,
    MAG_RECOVERY,
    MAX_GAP,
    MIN_FORCE,
    USE_MAG,
) = range(23)
PARAMS = 23

# Codes of `inertial_step`.
OK, STARTED, RESTARTED, WAITING, FAILED = range(5)
# Values of state[MAG_STATUS]: what the last block with a field did.
MAG_NONE, MAG_USED, MAG_DISTURBED, MAG_RELEARNED = range(4)

# A wrapped angle of which nothing is known is uniform over the circle: variance pi²/3.
UNKNOWN_ANGLE_VAR = math.pi**2 / 3.0
# Spans up to this age (s) of the field reference are averaged equally: a start needs a value at once.
_REF_START = 2.0
# The measured level of motion rises this much faster than it decays: motion starts suddenly.
_ATTACK = 4.0
# Below this share of the horizontal field heading is not observable.
_MIN_HORIZONTAL = 0.05
# Before the filter has seen any motion, velocity (m/s) and position (m) are known this well at least.
_MOTION_START_VAR = 0.3**2


@njit(cache=True, nogil=True)
def elapsed(state, sec, nanosec):
    """Return the time (s) since the last inertial sample; exact in float64 wherever the epoch is."""
    return ((sec - state[SEC]) * 1e9 + (nanosec - state[NANOSEC])) / 1e9


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
def inject(state, gain, scale):
    """Apply the correction ``gain * scale`` (N,) to attitude, bias, velocity and position."""
    turn(state, gain[0] * scale, gain[1] * scale, gain[2] * scale)
    for i in range(3):
        state[BIAS + i] += gain[3 + i] * scale
    for i in range(2):
        state[VEL + i] += gain[6 + i] * scale
        state[POS + i] += gain[8 + i] * scale


@njit(cache=True, nogil=True)
def start(state, par, ax, ay, az, keep_bias):
    """Set attitude from one specific force (m/s²), heading unknown; clear sums and covariance.

    Roll and pitch err by what the body accelerates; velocity and position of the motion are zero with the
    variance of the motion model.
    """
    bias_var = np.zeros(3)
    for i in range(3):
        bias_var[i] = state[COV + (3 + i) * (N + 1)] if keep_bias else par[BIAS_VAR]
    if not keep_bias:
        state[:] = 0.0
    half_roll = 0.5 * math.atan2(ay, az)
    half_pitch = 0.5 * math.atan2(-ax, math.sqrt(ay * ay + az * az))
    cr, sr = math.cos(half_roll), math.sin(half_roll)
    cp, sp = math.cos(half_pitch), math.sin(half_pitch)
    state[Q] = cr * cp
    state[Q + 1] = sr * cp
    state[Q + 2] = cr * sp
    state[Q + 3] = -sr * sp
    state[VEL : POS + 2] = 0.0
    state[LEVEL] = par[LEVEL_MIN]
    clear_sums(state)
    state[REST_TIME] = 0.0
    state[COV:] = 0.0
    vel_var = max(par[LEVEL_MIN] / (2.0 * par[C_VEL]), _MOTION_START_VAR)
    pos_var = max(par[LEVEL_MIN] / (2.0 * par[C_VEL] * par[C_POS]), _MOTION_START_VAR)
    for i in range(2):
        state[COV + i * (N + 1)] = par[TILT_VAR]
        state[COV + (6 + i) * (N + 1)] = vel_var
        state[COV + (8 + i) * (N + 1)] = pos_var
    state[COV + 2 * (N + 1)] = UNKNOWN_ANGLE_VAR
    for i in range(3):
        state[COV + (3 + i) * (N + 1)] = bias_var[i]
    state[PHASE] = 1.0


@njit(cache=True, nogil=True)
def clear_sums(state):
    """Begin a new block."""
    state[SPAN : MAG_COUNT + 1] = 0.0


@njit(cache=True, nogil=True)
def strapdown(state, dt, gx, gy, gz, ax, ay, az):
    """Integrate one sample over `dt` (s): attitude, velocity, position and the sums of the block."""
    wx = gx - state[BIAS]
    wy = gy - state[BIAS + 1]
    wz = gz - state[BIAS + 2]
    w2 = wx * wx + wy * wy + wz * wz
    half = 0.5 * dt * math.sqrt(w2)
    c = math.cos(half)
    s = 0.5 * dt * math.sin(half) / half if half > 1e-6 else 0.5 * dt
    x = wx * s
    y = wy * s
    z = wz * s
    b0, b1, b2, b3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    q0 = b0 * c - b1 * x - b2 * y - b3 * z
    q1 = b0 * x + b1 * c + b2 * z - b3 * y
    q2 = b0 * y - b1 * z + b2 * c + b3 * x
    q3 = b0 * z + b1 * y - b2 * x + b3 * c
    # One Newton step keeps the norm: it is off by rounding only.
    n = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q0 *= n
    q1 *= n
    q2 *= n
    q3 *= n
    state[Q] = q0
    state[Q + 1] = q1
    state[Q + 2] = q2
    state[Q + 3] = q3
    r00 = 1.0 - 2.0 * (q2 * q2 + q3 * q3)
    r01 = 2.0 * (q1 * q2 - q0 * q3)
    r02 = 2.0 * (q1 * q3 + q0 * q2)
    r10 = 2.0 * (q1 * q2 + q0 * q3)
    r11 = 1.0 - 2.0 * (q1 * q1 + q3 * q3)
    r12 = 2.0 * (q2 * q3 - q0 * q1)
    r20 = 2.0 * (q1 * q3 - q0 * q2)
    r21 = 2.0 * (q2 * q3 + q0 * q1)
    r22 = 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    fx = r00 * ax + r01 * ay + r02 * az
    fy = r10 * ax + r11 * ay + r12 * az
    fz = r20 * ax + r21 * ay + r22 * az
    state[POS] += dt * (state[VEL] + 0.5 * dt * fx)
    state[POS + 1] += dt * (state[VEL + 1] + 0.5 * dt * fy)
    state[VEL] += dt * fx
    state[VEL + 1] += dt * fy
    state[RATE] = wx
    state[RATE + 1] = wy
    state[RATE + 2] = wz
    state[SPAN] += dt
    state[COUNT] += 1.0
    state[RATE2] += dt * w2
    state[FORCE_N] += dt * fx
    state[FORCE_N + 1] += dt * fy
    state[FORCE_N + 2] += dt * fz
    state[ROT] += dt * r00
    state[ROT + 1] += dt * r01
    state[ROT + 2] += dt * r02
    state[ROT + 3] += dt * r10
    state[ROT + 4] += dt * r11
    state[ROT + 5] += dt * r12
    state[ROT + 6] += dt * r20
    state[ROT + 7] += dt * r21
    state[ROT + 8] += dt * r22
    state[GYR_SUM] += gx
    state[GYR_SUM + 1] += gy
    state[GYR_SUM + 2] += gz
    state[ACC_SUM] += ax
    state[ACC_SUM + 1] += ay
    state[ACC_SUM + 2] += az


@njit(cache=True, nogil=True)
def inertial_step(state, par, work, sec, nanosec, gx, gy, gz, ax, ay, az):
    """Take one inertial sample (rad/s, m/s²) at sec + nanosec; update `state` in place.

    Returns OK, STARTED, RESTARTED (after a gap; bias kept), WAITING (no direction to start from) or FAILED
    (numerics; the next sample starts anew).
    """
    dt = elapsed(state, sec, nanosec)
    code = OK
    if state[PHASE] == 0.0 or dt > par[MAX_GAP]:
        if ax * ax + ay * ay + az * az < par[MIN_FORCE] * par[MIN_FORCE]:
            return WAITING
        code = STARTED if state[PHASE] == 0.0 else RESTARTED
        start(state, par, ax, ay, az, code == RESTARTED)
        dt = 0.0
    else:
        strapdown(state, dt, gx, gy, gz, ax, ay, az)
        if state[SPAN] >= par[BLOCK] - 0.5 * dt and not close_block(state, par, work):
            state[PHASE] = 0.0
            code = FAILED
    state[SEC] = sec
    state[NANOSEC] = nanosec
    state[LAST_DT] = dt
    return code


@njit(cache=True, nogil=True)
def magnetic_step(state, par, sec, nanosec, mx, my, mz):
    """Add one field sample (T) to the block, turned to local level by the attitude at its own stamp."""
    if state[PHASE] == 0.0:
        return
    dt = min(elapsed(state, sec, nanosec), par[BLOCK])
    wx = 0.5 * dt * state[RATE]
    wy = 0.5 * dt * state[RATE + 1]
    wz = 0.5 * dt * state[RATE + 2]
    b0, b1, b2, b3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    q0 = b0 - b1 * wx - b2 * wy - b3 * wz
    q1 = b1 + b0 * wx + b2 * wz - b3 * wy
    q2 = b2 + b0 * wy - b1 * wz + b3 * wx
    q3 = b3 + b0 * wz + b1 * wy - b2 * wx
    n = 1.0 / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    tx = 2.0 * n * (q2 * mz - q3 * my)
    ty = 2.0 * n * (q3 * mx - q1 * mz)
    tz = 2.0 * n * (q1 * my - q2 * mx)
    state[MAG_N] += mx + q0 * tx + q2 * tz - q3 * ty
    state[MAG_N + 1] += my + q0 * ty + q3 * tx - q1 * tz
    state[MAG_N + 2] += mz + q0 * tz + q1 * ty - q2 * tx
    state[MAG_COUNT] += 1.0


@njit(cache=True, nogil=True)
def close_block(state, par, work):
    """Propagate the covariance over the block and apply its measurements; False when numerics failed."""
    cov = state[COV:].reshape(N, N)
    propagate(state, par, work, cov)
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
    """Move `cov` over the block: ``cov = phi cov phi' + Q`` (phi is left in work[0])."""
    phi = work[0]
    half = work[1]
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
    """Correct with one scalar measurement of row `h` (N,) and noise `variance`; returns the NIS.

    With `considered` only heading and bias are corrected and the covariance is that of this smaller gain.
    """
    ph = work[2, 0]
    gain = work[2, 1]
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
    inject(state, gain, innovation * inverse)
    return innovation * innovation * inverse


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
    h = work[2, 2]
    for i in range(3):
        h[:] = 0.0
        h[3 + i] = 1.0
        innovation = state[GYR_SUM + i] * inverse - state[BIAS + i]
        scalar_update(state, cov, work, h, innovation, par[REST_PSD] / state[SPAN], False)


@njit(cache=True, nogil=True)
def motion_update(state, par, work, cov):
    """Measure the equation of the motion with the mean horizontal acceleration of the block."""
    span = state[SPAN]
    phi = work[0]
    h = work[2, 2]
    variance = max(par[LEVEL_MIN], state[LEVEL]) / span
    power = 0.0
    nis = 0.0
    for i in range(2):
        h[:] = 0.0
        for k in range(3):
            h[k] = phi[6 + i, k] / span
        h[6 + i] = par[C_VEL]
        h[8 + i] = par[C_POS]
        mean = state[FORCE_N + i] / span
        innovation = -(mean + par[C_VEL] * state[VEL + i] + par[C_POS] * state[POS + i])
        nis += scalar_update(state, cov, work, h, innovation, variance, False)
        power += innovation * innovation
    state[MOTION_NIS] = nis
    shown = 0.5 * power * span
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
    if not field_accepted(state, par, norm, math.atan2(-mz, horizontal), span):
        return
    if horizontal < _MIN_HORIZONTAL * norm:
        return
    h = work[2, 2]
    h[:] = 0.0
    slope = mz / (horizontal * horizontal)
    h[0] = -mx * slope
    h[1] = -my * slope
    h[2] = 1.0
    state[MAG_NIS] = scalar_update(state, cov, work, h, math.atan2(mx, my), par[MAG_PSD] / span, True)


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
        memory = state[REF_AGE] if state[REF_AGE] < _REF_START else par[MAG_MEMORY]
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
    if state[NEW_TIME] < par[MAG_RECOVERY]:
        return False
    state[REF_NORM] = state[NEW_NORM]
    state[REF_DIP] = state[NEW_DIP]
    state[NEW_TIME] = 0.0
    state[MAG_STATUS] = MAG_RELEARNED
    return True
