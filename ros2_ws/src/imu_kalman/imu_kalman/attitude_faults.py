# SPDX-License-Identifier: Apache-2.0
"""What the gyro did not measure: wild jumps, repeated readings, gaps, and what they add to the covariance.

While the rate is not measured it is held (or taken as the mean of both ends of a gap). How far the attitude
may have turned meanwhile follows from the motion of the last seconds: with the angular acceleration alpha and
the rate omega seen there, a time T hides an angle of the variance

    V(T) = T² min(alpha² T² / 4, 2 omega²)

about each axis: the rate runs away from the held one at first, and is independent of it in the end.

A reading that repeats to the last bit is no measurement if chance would hardly repeat it: that finds a frozen
sensor, a stuck axis and a saturated one alike. How often readings repeat by chance (coarse resolution, rest,
a simulator without noise) is counted while nothing is wrong.

Source: this package's own; V(T) is the integral of a held first-order process (Gelb, "Applied Optimal
Estimation", 1974, 3.8) at its two ends.
"""

import math

from numba import njit

from imu_kalman.attitude_layout import (
    BLIND,
    COUNT,
    COV,
    DEAF,
    DOUBT,
    FORCE_N,
    GRAVITY_NORM,
    GYR_SUM,
    HIDDEN_ACC,
    J_ADDED,
    J_AGE,
    J_BEYOND,
    J_COUNT,
    J_HELD,
    J_LEVEL,
    J_QUIET,
    J_STEP,
    J_VALUE,
    JUMP,
    LAST_ACC,
    LAST_GYR,
    LAST_MEAN,
    LONGEST,
    MOTION_ACC,
    NEVER,
    PERIOD,
    PUSH,
    PUSHED,
    RATE2,
    REPEATS,
    RUN,
    RUN_TIME,
    SHARE,
    SPAN,
    SPIN_LEVEL,
    STUCK,
    STUCK_COUNT,
    TURN_LEVEL,
    VARIED,
    VEL,
    N,
    Q,
)

# A jump that lasts longer than this many samples is believed: no check may lock the filter out.
_MAX_JUMPS = 2
# State of a jump that is none: the sensor was silent before.
_AFTER_GAP = _MAX_JUMPS + 2.0
# A change of rate this many times as large as any of the last seconds is a jump: noise and smooth motion
# stay far below, a blow is believed two samples later without loss.
_JUMP_RATIO = 4.0
# A believed jump is followed until rates have been plausible for this long (s).
_JUMP_QUIET = 0.1
# Jumps that go on for longer than this (s) are the motion: no check may lock the filter out.
_JUMP_AGE = 0.5
# Levels of motion are maxima that decay with this time constant (s): a few periods of most motions.
_MEMORY = 5.0
# The rate a body at rest may have taken up unseen: the hidden acceleration for this long (s).
_HIDDEN_TIME = 1.0
# Blocks over which the share of repeated readings is counted.
_SHARE_BLOCKS = 40.0
# No run of repeated readings is believed to be chance that happens once in as many runs.
_CHANCE = 1e-6
# Shares below this cannot be told from zero within that memory.
_LEAST_SHARE = 0.02
# A repeated reading is believed (a sensor that has no noise and stands still) once it has lasted for as many
# samples as varied ones came before, at most this many: no check may lock the filter out.
_MOST_VARIED = 2000.0
# Intervals longer than this many sampling periods hide samples.
_GAP_PERIODS = 2.5
_PERIOD_WEIGHT = 1.0 / 16.0
# What `follow_jump` finds.
PLAIN, HOLD, BACK, BELIEVED = range(4)


@njit(cache=True, nogil=True)
def begin_checks(state):
    """Set what a first start knows of the sensor: nothing, so any repetition may be chance."""
    state[VARIED] = 0.0
    for i in range(4):
        state[SHARE + i] = 1.0
        state[LONGEST + i] = NEVER


@njit(cache=True, nogil=True)
def end_jumps(state):
    """Follow no jump any more: what came before is too long ago."""
    state[JUMP + J_COUNT] = 0.0
    state[PUSH + J_COUNT] = 0.0
    state[DOUBT] = 0.0


@njit(cache=True, nogil=True)
def hidden_variance(state, par, time):
    """Return the variance (rad²) per axis of the angle turned unseen in `time` (s) by a held rate."""
    spin2 = max(state[SPIN_LEVEL], par[HIDDEN_ACC] ** 2)
    turn2 = max(state[TURN_LEVEL], (par[HIDDEN_ACC] * _HIDDEN_TIME) ** 2)
    t2 = time * time
    return t2 * min(0.25 * spin2 * t2, 2.0 * turn2)


@njit(cache=True, nogil=True)
def hidden_rate(state, par, time):
    """Return the variance ((rad/s)²) per axis of how much a rate held for `time` (s) may have changed."""
    spin2 = max(state[SPIN_LEVEL], par[HIDDEN_ACC] ** 2)
    turn2 = max(state[TURN_LEVEL], (par[HIDDEN_ACC] * _HIDDEN_TIME) ** 2)
    return min(spin2 * time * time, 2.0 * turn2)


@njit(cache=True, nogil=True)
def hidden_force(state, par, time):
    """Return the variance ((m/s²)²) per axis of how much a force held for `time` (s) may have changed.

    Gravity turns in the body, and the acceleration is another one.
    """
    turn2 = max(state[TURN_LEVEL], (par[HIDDEN_ACC] * _HIDDEN_TIME) ** 2)
    return state[MOTION_ACC] + GRAVITY_NORM**2 * min(turn2 * time * time, 1.0)


@njit(cache=True, nogil=True)
def unseen_time(state, at, i):
    """Return for how long (s) a reading was not measured: held by the jump at `at`, or the `i`th is stuck."""
    held = 0.0
    if state[at + J_COUNT] != 0.0 and state[at + J_HELD] <= _MAX_JUMPS:
        held = state[at + J_AGE]
    stuck = state[RUN_TIME + i] if state[RUN + i] >= state[LONGEST + i] else 0.0
    return max(held, stuck)


@njit(cache=True, nogil=True)
def rotation(state):
    """Return the rows of the rotation matrix, body to local level."""
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    return (
        (1.0 - 2.0 * (q2 * q2 + q3 * q3), 2.0 * (q1 * q2 - q0 * q3), 2.0 * (q1 * q3 + q0 * q2)),
        (2.0 * (q1 * q2 + q0 * q3), 1.0 - 2.0 * (q1 * q1 + q3 * q3), 2.0 * (q2 * q3 - q0 * q1)),
        (2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2)),
    )


@njit(cache=True, nogil=True)
def add_hidden(state, vx, vy, vz):
    """Add variances (rad²) about the body's axes to the covariance of the attitude."""
    cov = state[COV:].reshape(N, N)
    rows = rotation(state)
    for i in range(3):
        for j in range(3):
            cov[i, j] += (
                rows[i][0] * vx * rows[j][0] + rows[i][1] * vy * rows[j][1] + rows[i][2] * vz * rows[j][2]
            )


@njit(cache=True, nogil=True)
def body_turn(state, x, y, z):
    """Turn the attitude by the rotation vector (x, y, z) [rad] about the body's axes."""
    h = 0.5 * math.sqrt(x * x + y * y + z * z)
    c = math.cos(h)
    s = 0.5 * math.sin(h) / h if h > 1e-6 else 0.5
    x *= s
    y *= s
    z *= s
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    state[Q] = q0 * c - q1 * x - q2 * y - q3 * z
    state[Q + 1] = q0 * x + q1 * c + q2 * z - q3 * y
    state[Q + 2] = q0 * y - q1 * z + q2 * c + q3 * x
    state[Q + 3] = q0 * z + q1 * y - q2 * x + q3 * c


@njit(cache=True, nogil=True)
def is_gap(state, dt):
    """Whether `dt` (s) hides samples; follows the sampling period, so that a slower sensor is believed."""
    period = state[PERIOD]
    if period == 0.0:
        state[PERIOD] = dt
        return False
    gap = dt > _GAP_PERIODS * period
    state[PERIOD] += _PERIOD_WEIGHT * ((2.0 * _GAP_PERIODS * period if gap else dt) - period)
    return gap


@njit(cache=True, nogil=True)
def bridge_gap(state, par, dt, gx, gy, gz):
    """Add what a gap of `dt` (s) before the rate (gx, gy, gz) hides; the block was not measured meanwhile.

    A quarter of what a held rate hides, as of a first-order process between two known ends. The difference
    of the ends shows an angular acceleration of its own.
    """
    x, y, z = gx - state[LAST_GYR], gy - state[LAST_GYR + 1], gz - state[LAST_GYR + 2]
    state[SPIN_LEVEL] = max(state[SPIN_LEVEL], (x * x + y * y + z * z) / (dt * dt))
    hidden = 0.25 * hidden_variance(state, par, dt)
    add_hidden(state, hidden, hidden, hidden)
    state[STUCK] += dt
    state[BLIND] += dt
    # What comes first after a gap may be the fault that made it: a jump back soon says so.
    state[DOUBT] = 0.0
    for at, last in ((JUMP, LAST_GYR), (PUSH, LAST_ACC)):
        state[at : at + J_STEP] = 0.0
        state[at + J_COUNT] = 1.0
        state[at + J_HELD] = _AFTER_GAP
        state[at + J_VALUE : at + J_VALUE + 3] = state[last : last + 3]


@njit(cache=True, nogil=True)
def jump_limit(state, at, least, most, dt):
    """Return the largest change over `dt` (s) that is no jump; `least` and `most` are per second."""
    return min(max(_JUMP_RATIO * state[at + J_LEVEL], least * dt), most * dt)


@njit(cache=True, nogil=True)
def follow_jump(state, at, dt, limit, change, last, x, y, z):
    """Follow a reading (x, y, z) that has jumped from its `last` one; the record of the jump lies at `at`.

    Two samples are held. If the third is still away the jump is believed. If readings jump again soon after
    (back, or anywhere) the whole of it may have been a fault. Returns PLAIN, HOLD, BACK (it was a spike) or
    BELIEVED (now: what was held is to be made good), and the square that is to be doubted more than before.
    """
    if state[at + J_COUNT] == 0.0:
        state[at : at + J_STEP] = 0.0
        state[at + J_COUNT] = 1.0
        state[at + J_VALUE : at + J_VALUE + 3] = state[last : last + 3]
    believed = state[at + J_HELD] > _MAX_JUMPS
    state[at + J_QUIET] += dt
    state[at + J_AGE] += dt
    if change > limit:
        state[at + J_QUIET] = 0.0
        if believed:
            state[at + J_COUNT] += 1.0
    beyond = at + J_BEYOND
    if not believed:
        state[at + J_HELD] += 1.0
        if change <= limit:
            state[at + J_COUNT] = 0.0
            return BACK, 0.0
        if state[at + J_HELD] <= _MAX_JUMPS:
            state[beyond] += (x - state[at + J_VALUE]) * dt
            state[beyond + 1] += (y - state[at + J_VALUE + 1]) * dt
            state[beyond + 2] += (z - state[at + J_VALUE + 2]) * dt
            return HOLD, 0.0
        return BELIEVED, 0.0
    state[beyond] += (x - state[at + J_VALUE]) * dt
    state[beyond + 1] += (y - state[at + J_VALUE + 1]) * dt
    state[beyond + 2] += (z - state[at + J_VALUE + 2]) * dt
    square = state[beyond] ** 2 + state[beyond + 1] ** 2 + state[beyond + 2] ** 2
    doubt = max(0.0, square - state[at + J_ADDED])
    if state[at + J_QUIET] > _JUMP_QUIET:
        state[at + J_COUNT] = 0.0
        return PLAIN, 0.0
    if state[at + J_AGE] > _JUMP_AGE:
        state[at + J_STEP] = max(state[at + J_STEP], change)
    return PLAIN, doubt


@njit(cache=True, nogil=True)
def rate_jump(state, par, dt, limit, change, gx, gy, gz):
    """Follow a rate that has jumped; return whether to hold the last one.

    What held samples turned is made good when the jump is believed. While it may be a fault the output's
    covariance says so; once it is more likely than not (rates jumped again) that of the state does.
    """
    held = state[JUMP + J_HELD]
    code, doubt = follow_jump(state, JUMP, dt, limit, change, LAST_GYR, gx, gy, gz)
    state[DOUBT] = 0.0
    if code == BACK:
        hidden = hidden_variance(state, par, (held + 1.0) * dt)
        add_hidden(state, hidden, hidden, hidden)
    elif code == BELIEVED:
        beyond = JUMP + J_BEYOND
        body_turn(state, state[beyond], state[beyond + 1], state[beyond + 2])
        state[beyond] += (gx - state[JUMP + J_VALUE]) * dt
        state[beyond + 1] += (gy - state[JUMP + J_VALUE + 1]) * dt
        state[beyond + 2] += (gz - state[JUMP + J_VALUE + 2]) * dt
        state[DOUBT] = state[beyond] ** 2 + state[beyond + 1] ** 2 + state[beyond + 2] ** 2
    elif state[JUMP + J_COUNT] > 1.0:
        state[JUMP + J_ADDED] += doubt
        add_hidden(state, doubt, doubt, doubt)
    elif state[JUMP + J_HELD] < _AFTER_GAP:
        state[DOUBT] = doubt
    return code == HOLD


@njit(cache=True, nogil=True)
def force_jump(state, dt, limit, change, ax, ay, az):
    """Follow a specific force that has jumped; return whether to hold the last one.

    As for rates; what is made good and doubted is the speed.
    """
    code, doubt = follow_jump(state, PUSH, dt, limit, change, LAST_ACC, ax, ay, az)
    if code == BELIEVED or (
        code == PLAIN and (state[PUSH + J_HELD] < _AFTER_GAP or state[PUSH + J_COUNT] > 1.0)
    ):
        state[PUSHED] += 1.0
    if code == BELIEVED:
        beyond = PUSH + J_BEYOND
        rows = rotation(state)
        for i in range(2):
            speed = 0.0
            for j in range(3):
                speed += rows[i][j] * state[beyond + j]
            state[VEL + i] += speed
            state[FORCE_N + i] += speed
    elif state[PUSH + J_COUNT] > 1.0:
        cov = state[COV:].reshape(N, N)
        state[PUSH + J_ADDED] += doubt
        cov[6, 6] += doubt
        cov[7, 7] += doubt
    return code == HOLD


@njit(cache=True, nogil=True)
def repeat_step(state, par, dt, gx, gy, gz, ax, ay, az):
    """Count repeated readings of each axis of the gyro and of the force; add what a stuck axis hides."""
    same = ax == state[LAST_ACC] and ay == state[LAST_ACC + 1] and az == state[LAST_ACC + 2]
    equal = (gx == state[LAST_GYR], gy == state[LAST_GYR + 1], gz == state[LAST_GYR + 2], same)
    stuck = 0
    for i in range(4):
        if not equal[i]:
            state[RUN + i] = 0.0
            state[RUN_TIME + i] = 0.0
            continue
        state[RUN + i] += 1.0
        state[RUN_TIME + i] += dt
        if state[RUN + i] < state[LONGEST + i]:
            state[REPEATS + i] += 1.0
            continue
        if i == 3:
            state[DEAF] += dt
            state[PUSHED] += 1.0
            continue
        stuck += 1
        time = state[RUN_TIME + i]
        before = 0.0 if state[RUN + i] == state[LONGEST + i] else hidden_variance(state, par, time - dt)
        more = max(0.0, hidden_variance(state, par, time) - before)
        add_hidden(state, more * (i == 0), more * (i == 1), more * (i == 2))
    if stuck == 0 and state[DEAF] == 0.0:
        return
    state[STUCK] += dt
    if stuck == 3:
        state[BLIND] += dt
    state[STUCK_COUNT] += 1.0
    if state[STUCK_COUNT] > state[VARIED]:
        begin_checks(state)


@njit(cache=True, nogil=True)
def follow_readings(state):
    """At the end of a block: follow the levels of motion and the share of repeated readings."""
    span, count = state[SPAN], state[COUNT]
    spin2 = 0.0
    for i in range(3):
        mean = state[GYR_SUM + i] / count
        spin2 += (mean - state[LAST_MEAN + i]) ** 2
        state[LAST_MEAN + i] = mean
    if state[STUCK] > 0.0 or state[BLIND] > 0.0:
        return
    state[STUCK_COUNT] = 0.0
    keep = max(0.0, 1.0 - span / _MEMORY)
    for at in (JUMP, PUSH):
        state[at + J_LEVEL] = max(keep * state[at + J_LEVEL], state[at + J_STEP])
        state[at + J_STEP] = 0.0
    if state[JUMP + J_COUNT] != 0.0:
        return
    state[SPIN_LEVEL] = max(keep * state[SPIN_LEVEL], spin2 / (span * span))
    state[TURN_LEVEL] = max(keep * state[TURN_LEVEL], state[RATE2] / span)
    repeats = min(min(state[REPEATS], state[REPEATS + 1]), min(state[REPEATS + 2], state[REPEATS + 3]))
    state[VARIED] = min(state[VARIED] + count - repeats, _MOST_VARIED)
    for i in range(4):
        state[SHARE + i] += (state[REPEATS + i] / count - state[SHARE + i]) / _SHARE_BLOCKS
        share = min(max(state[SHARE + i], _LEAST_SHARE), 1.0 - 1e-3)
        state[LONGEST + i] = math.ceil(math.log(_CHANCE) / math.log(share))
