# SPDX-License-Identifier: Apache-2.0
"""Kernels of the attitude filter: strapdown at sample rate, one error-state update per block.

Local level is ENU with y towards magnetic north. Per sample the kernels integrate the quaternion, rotate
the specific force un-normalised into local level and sum what the update needs; the covariance moves once
per block (`block` s, about ten samples), which is exact for the bias because the integral of the rotation
matrix is summed.

Error state (10): attitude theta_n (3), gyro bias b (3), horizontal velocity v (2) and position p (2), with

    truth = exp(theta_n) * estimate           attitude, velocity, position (+ v, + p)
    truth = estimate + b                      bias,

so that velocity and position turn with the attitude. The transition then contains gravity and no measured
force, and heading, which no accelerometer shows, stays unobservable in the covariance too.
Velocity and position are those of a motion that stays where it is: a second-order Gauss-Markov process

    a = -2 zeta w0 v - w0² p + w,     w white with density q,

whose acceleration vanishes below w0 as omega². The mean horizontal acceleration of a block measures that
equation, so a lasting apparent acceleration is tilt and a passing one is motion. The density q is the larger
of a floor and what the innovations show, and w0 follows the frequency of the motion.
The magnetic field corrects heading (and through it the bias) only; tilt and motion are considered, not
corrected (Schmidt's consider update).

Sources: Sola (2017) for the multiplicative error state; Barrau and Bonnabel, "The invariant extended Kalman
filter as a stable observer" (2017), for errors that turn with the attitude; Gelb, "Applied Optimal
Estimation" (1974), for shaping filters and consider updates; the motion model in this role is this
package's own.
"""

import math

from numba import njit

from imu_kalman.attitude_block import clear_sums, close_block
from imu_kalman.attitude_faults import (
    begin_checks,
    bridge_gap,
    end_jumps,
    force_jump,
    is_gap,
    jump_limit,
    rate_jump,
    repeat_step,
)
from imu_kalman.attitude_layout import (
    ACC_SUM,
    ALIGNED,
    BIAS,
    BIAS_VAR,
    BLOCK,
    COUNT,
    COV,
    DELAY,
    DELAY_VAR,
    DOUBT,
    FAILED,
    FORCE_N,
    GRAVITY,
    GYR_SUM,
    GYR_VAR,
    HEADING_VAR,
    HELD,
    J_COUNT,
    J_STEP,
    JUMP,
    LAST_ACC,
    LAST_GYR,
    LEVEL,
    LEVEL_MIN,
    MAG_COUNT,
    MAG_DELAY,
    MAG_N,
    MAX_ANGULAR_ACC,
    MAX_GAP,
    MAX_JERK,
    MIN_FORCE,
    MIN_JUMP,
    MIN_PUSH,
    MOTION_ACC,
    MOTION_AGE,
    NANOSEC,
    OK,
    PERIOD,
    PHASE,
    POS,
    PUSH,
    RATE,
    RATE2,
    REST_TIME,
    RESTARTED,
    ROT,
    SEC,
    SPAN,
    STARTED,
    VEL,
    WAITING,
    N,
    Q,
)
from imu_kalman.attitude_linear import start_covariance

# Change of rate times gap (rad) beyond which the attitude after the gap is unknown, not merely uncertain.
_LOST_TURN = 0.5
# A variance told with the rate that drops by more says that its sender has taken off a bias.
_BIAS_TAKEN = 0.1
# Up to this square of half the angle of a step (rad²) the series below are exact to the last bit.
_SERIES = 0.01


@njit(cache=True, nogil=True)
def elapsed(state, sec, nanosec):
    """Return the time (s) since the last inertial sample; exact in float64 wherever the epoch is."""
    return ((sec - state[SEC]) * 1e9 + (nanosec - state[NANOSEC])) / 1e9


@njit(cache=True, nogil=True)
def start(state, par, ax, ay, az, keep_bias):
    """Set roll and pitch from one specific force (m/s²), heading unknown, and begin the alignment."""
    cov = state[COV:].reshape(N, N)
    if not keep_bias:
        state[:] = 0.0
        begin_checks(state)
        for i in range(3, 6):
            cov[i, i] = par[BIAS_VAR]
    half_roll = 0.5 * math.atan2(ay, az)
    half_pitch = 0.5 * math.atan2(-ax, math.sqrt(ay * ay + az * az))
    cr, sr = math.cos(half_roll), math.sin(half_roll)
    cp, sp = math.cos(half_pitch), math.sin(half_pitch)
    state[Q] = cr * cp
    state[Q + 1] = sr * cp
    state[Q + 2] = cr * sp
    state[Q + 3] = -sr * sp
    state[VEL : POS + 2] = 0.0
    state[RATE : RATE + 3] = 0.0
    state[GRAVITY : ALIGNED + 1] = 0.0
    state[LEVEL] = par[LEVEL_MIN]
    state[REST_TIME] = 0.0
    state[MOTION_ACC : MOTION_AGE + 1] = 0.0
    clear_sums(state)
    end_jumps(state)
    start_covariance(state, par, cov)
    state[PHASE] = 1.0


@njit(cache=True, nogil=True)
def largest_change(state, at, x, y, z):
    """Return the largest change of an axis against the last sample taken, which lies at `at`."""
    return max(abs(x - state[at]), max(abs(y - state[at + 1]), abs(z - state[at + 2])))


@njit(cache=True, nogil=True)
def strapdown(state, dt, gx, gy, gz, ax, ay, az):
    """Integrate one sample over `dt` (s): attitude, velocity, position and the sums of the block."""
    wx = gx - state[BIAS]
    wy = gy - state[BIAS + 1]
    wz = gz - state[BIAS + 2]
    w2 = wx * wx + wy * wy + wz * wz
    h = 0.25 * dt * dt * w2
    if h < _SERIES:
        c = 1.0 - h * (0.5 - h * (1.0 / 24.0 - h * (1.0 / 720.0 - h / 40320.0)))
        s = 0.5 * dt * (1.0 - h * (1.0 / 6.0 - h * (1.0 / 120.0 - h * (1.0 / 5040.0 - h / 362880.0))))
    else:
        half = math.sqrt(h)
        c = math.cos(half)
        s = 0.5 * dt * math.sin(half) / half
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
def lost(state, par, dt, gx, gy, gz):
    """Whether a gap hides a turn that nobody measured: longer than a block, and rates that do not agree."""
    if dt <= par[BLOCK]:
        return False
    x = gx - state[LAST_GYR]
    y = gy - state[LAST_GYR + 1]
    z = gz - state[LAST_GYR + 2]
    return (x * x + y * y + z * z) * dt * dt > _LOST_TURN * _LOST_TURN


@njit(cache=True, nogil=True)
def inertial_step(state, par, work, sec, nanosec, gx, gy, gz, ax, ay, az):
    """Take one inertial sample (rad/s, m/s²) at sec + nanosec; update `state` in place.

    Returns OK, STARTED, RESTARTED (after a gap; bias kept), WAITING (no direction to start from), HELD (a
    wild jump; the last sample was used instead), REALIGNING (the attitude contradicted gravity) or FAILED
    (numerics; the next sample starts anew).
    """
    dt = elapsed(state, sec, nanosec)
    code = OK
    gap = False
    rx, ry, rz = gx, gy, gz
    if state[PHASE] == 0.0 or dt > par[MAX_GAP] or lost(state, par, dt, gx, gy, gz):
        if ax * ax + ay * ay + az * az < par[MIN_FORCE] * par[MIN_FORCE]:
            return WAITING
        code = STARTED if state[PHASE] == 0.0 else RESTARTED
        start(state, par, ax, ay, az, code == RESTARTED)
        dt = 0.0
    else:
        # A sample is the rate at its stamp: over the step since the last one counts the mean of both.
        rx = 0.5 * (gx + state[LAST_GYR])
        ry = 0.5 * (gy + state[LAST_GYR + 1])
        rz = 0.5 * (gz + state[LAST_GYR + 2])
        gap = is_gap(state, dt)
        if gap:
            bridge_gap(state, par, dt, gx, gy, gz)
        else:
            change = largest_change(state, LAST_GYR, gx, gy, gz)
            limit = jump_limit(state, JUMP, par[MIN_JUMP], par[MAX_ANGULAR_ACC], dt)
            if change > limit or state[JUMP + J_COUNT] != 0.0:
                if rate_jump(state, par, dt, limit, change, gx, gy, gz):
                    code = HELD
                    rx, ry, rz = state[LAST_GYR], state[LAST_GYR + 1], state[LAST_GYR + 2]
                    gx, gy, gz = rx, ry, rz
            else:
                state[JUMP + J_STEP] = max(state[JUMP + J_STEP], change)
                repeat_step(state, par, dt, gx, gy, gz, ax, ay, az)
        change = largest_change(state, LAST_ACC, ax, ay, az)
        limit = jump_limit(state, PUSH, par[MIN_PUSH], par[MAX_JERK], dt)
        if change > limit or state[PUSH + J_COUNT] != 0.0:
            if force_jump(state, dt, limit, change, ax, ay, az):
                code = HELD
                ax, ay, az = state[LAST_ACC], state[LAST_ACC + 1], state[LAST_ACC + 2]
        elif not gap:
            state[PUSH + J_STEP] = max(state[PUSH + J_STEP], change)
    state[LAST_GYR] = gx
    state[LAST_GYR + 1] = gy
    state[LAST_GYR + 2] = gz
    state[LAST_ACC] = ax
    state[LAST_ACC + 1] = ay
    state[LAST_ACC + 2] = az
    state[SEC] = sec
    state[NANOSEC] = nanosec
    if code in (OK, HELD):
        before = state[VEL], state[VEL + 1], state[POS], state[POS + 1]
        strapdown(state, dt, rx, ry, rz, ax, ay, az)
        state[RATE] = gx - state[BIAS]
        state[RATE + 1] = gy - state[BIAS + 1]
        state[RATE + 2] = gz - state[BIAS + 2]
        if gap and dt > par[BLOCK]:
            # One sample says nothing about the speed gained in a long gap.
            state[VEL], state[VEL + 1], state[POS], state[POS + 1] = before
        if state[SPAN] >= par[BLOCK] - 0.5 * dt:
            closed = close_block(state, par, work)
            if closed != OK:
                code = closed
            if closed == FAILED:
                state[PHASE] = 0.0
    return code


@njit(cache=True, nogil=True)
def follow_variance(state, par, variance):
    """Follow the variance ((rad/s)²; 0: unknown) told with the next rate; when it drops the bias is new.

    A driver that calibrates subtracts a bias from then on: what was learned of it would be subtracted twice.
    """
    if not 0.0 < variance < math.inf:
        return
    if variance < _BIAS_TAKEN * state[GYR_VAR]:
        cov = state[COV:].reshape(N, N)
        for i in range(3):
            cov[3 + i, :] = 0.0
            cov[:, 3 + i] = 0.0
            cov[3 + i, 3 + i] = par[BIAS_VAR]
            state[LAST_GYR + i] -= state[BIAS + i]
            state[BIAS + i] = 0.0
        state[REST_TIME] = 0.0
    state[GYR_VAR] = variance


@njit(cache=True, nogil=True)
def magnetic_step(state, par, sec, nanosec, mx, my, mz):
    """Add one field sample (T) to the block, turned to local level by the attitude at its own time."""
    if state[PHASE] == 0.0:
        return
    if elapsed(state, sec, nanosec) > max(par[BLOCK], 2.0 * state[PERIOD]):
        # The attitude at that time is not known.
        return
    # The field changed at its stamp less its delay, which the attitude is turned to with the last rate.
    dt = elapsed(state, sec, nanosec) - par[MAG_DELAY]
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
def carried(state, par, out):
    """Write the attitude at the sample's stamp into out[:4]: the state's, turned on by rate times delay."""
    x = 0.5 * par[DELAY] * state[RATE]
    y = 0.5 * par[DELAY] * state[RATE + 1]
    z = 0.5 * par[DELAY] * state[RATE + 2]
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    # Unit to first order of a turn of some hundredths of a radian; the scale makes it exact.
    n = 1.0 / math.sqrt(1.0 + x * x + y * y + z * z)
    out[0] = n * (q0 - q1 * x - q2 * y - q3 * z)
    out[1] = n * (q1 + q0 * x + q2 * z - q3 * y)
    out[2] = n * (q2 + q0 * y - q1 * z + q3 * x)
    out[3] = n * (q3 + q0 * z + q1 * y - q2 * x)


@njit(cache=True, nogil=True)
def attitude_cov(state, par, i, j):
    """Return an entry (rad²) of the covariance of the carried attitude, lasting errors included."""
    value = state[COV + N * i + j]
    if i == j:
        value += state[DOUBT]
        rate2 = state[RATE] ** 2 + state[RATE + 1] ** 2 + state[RATE + 2] ** 2
        value += rate2 * par[DELAY_VAR]
        if i == 2:
            value += par[HEADING_VAR]
    return value
