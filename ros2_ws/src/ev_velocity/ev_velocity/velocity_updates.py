# SPDX-License-Identifier: Apache-2.0
"""Measurements of the joint filter: GPS speed, encoder counts, wheel speed, standstill; with their gates.

Every gate is a chi-square gate with one degree of freedom, except that of the counts: a tooth has no tails.
No refusal lasts for ever: after LOCKOUT a sensor is believed again. GPS and wheel refused on the same side
by about as much are believed at once, since then the acceleration is wrong (a ramp, a knocked sensor).
"""

from __future__ import annotations

import math

from numba import njit

from ev_velocity.velocity_bank import (
    SPEED_LIMIT,
    clone,
    combine,
    correct,
    covariance_of,
    forget,
    place,
    state_of,
)
from ev_velocity.velocity_kernels import NS, delayed_row, direction_of, force_at, predict
from ev_velocity.velocity_memory import (
    COUNT,
    COUNT_SENSE,
    COUNT_TIME,
    GAIN,
    GATE,
    GPS_ACCEPTED,
    GPS_DELAY_VARIANCE,
    GPS_LEAPT,
    GPS_REFUSED_SINCE,
    LOCKOUT,
    MODELS,
    MOVED_TIME,
    NIS,
    P0_SCALE,
    P0_SLIP,
    PENDING,
    PENDING_COUNT,
    PENDING_SPEED,
    PW,
    REFUSED,
    REOPENED,
    SKIPPED,
    SLIP,
    SPEED_DELAY_VARIANCE,
    SPEED_TIME,
    STARTED,
    STILL_SPEED,
    STILL_TIME,
    STILL_VARIANCE,
    TEETH,
    TG,
    TIME,
    TOOTH,
    TS,
    TURNED_SINCE,
    TW,
    USED,
    WEIGHTS,
    WHEEL_ACCEPTED,
    WHEEL_CORRELATION,
    WHEEL_REFUSED_SINCE,
    WHEEL_RESIDUAL,
    WHEEL_SPEED,
    WHEEL_TIME,
    B,
    C,
    N,
    P,
    S,
    V,
    W,
    X,
)

# A GPS speed below so many σ is rectified noise: it says nothing of size or sign.
RECTIFIED = 3.0
# A wheel sample younger than this (ns) can bear witness; the slowest usual source has 1 Hz.
FRESH = 1.5e9
# Wheels that agree with the filter make the GPS wait so many times longer.
VOUCHED = 3.0
# Without a GPS the wheel waits this share of the lock-out time: 4 s of 10, longer than a slip lasts.
ALONE = 0.4
# A GPS that drifts out of the gate with no wheel to vouch against it waits this share of the lock-out time:
# that is a wrong acceleration. One that leaps beyond so many gates is multipath until it has lasted.
DRIFT = 0.15
LEAP = 4.0
# Time (s) within which a wrong acceleration has built up the residual that shows it.
SINCE = 0.5
# Time (s) over which the wheel's residual is averaged: one count at 10 Hz is good for 0.2 m/s only.
WHEEL_AVERAGE = 0.5
# Smallest mean residual (m/s) of the wheel that says something.
WHEEL_SAYS = 0.1
# Below this speed (m/s) ABS sensors and OBD may read zero on a moving car.
BLIND_SPEED = 1.5
# Below this speed (m/s) a slip ratio means nothing.
SLIP_SPEED = 0.3
NO_GATE = math.inf
NOT_COMPARED = -1.0


@njit(cache=True, nogil=True)
def _anchor(m, constants, distance):
    """Take the wheel's distance (m) as measured: what it rolled since the last sample says nothing."""
    m[PENDING] = 0.0
    place(m, W, distance)
    forget(m, W, tooth_variance(constants))
    combine(m)


@njit(cache=True, nogil=True)
def _refused_too_long(m, since, limit):
    """Start or continue a run of refusals; True when it has lasted `limit` (ns)."""
    if m[since] < 0.0:
        m[since] = m[TIME]
    return m[TIME] - m[since] > limit


@njit(cache=True, nogil=True)
def _doubt(m, since, residual):
    """Return the variance that a sample's residual adds while its sensor is refused, since m[since].

    The first sample that passes the gate again may still hold part of the fault: the less it fits, the less
    it counts. The next decides.
    """
    return residual * residual if m[since] >= 0.0 else 0.0


@njit(cache=True, nogil=True)
def _recent(m, index):
    """Whether the time m[index] is set and not older than FRESH."""
    return m[index] >= 0.0 and m[TIME] - m[index] < FRESH


@njit(cache=True, nogil=True)
def _judge_wheel(m, constants, accepted):
    """Keep the books of the wheel sensor and return what was done.

    Refused for LOCKOUT beside a GPS that agrees, its scale is learned anew. Without a GPS the filter has no
    one to agree with: it gives in as soon as a slip would be over, and with it the speed and the bias.
    """
    if accepted:
        m[WHEEL_REFUSED_SINCE] = -1.0
        m[WHEEL_ACCEPTED] = m[TIME]
        return USED
    vouched = _recent(m, GPS_ACCEPTED)
    if not _refused_too_long(m, WHEEL_REFUSED_SINCE, constants[LOCKOUT] * (1.0 if vouched else ALONE)):
        return REFUSED
    if vouched:
        _reopen_scale(m, constants)
    else:
        _reopen_speed(m, m[WHEEL_RESIDUAL], SINCE)
    m[WHEEL_REFUSED_SINCE] = -1.0
    return REOPENED


@njit(cache=True, nogil=True)
def _reopen_speed(m, residual, time):
    """Let speed and bias be as wrong as a `residual` (m/s) that has grown over `time` (s) says."""
    forget(m, V, residual * residual)
    for j in range(MODELS):
        covariance_of(m, j)[B, B] += residual * residual / (time * time)
    combine(m)


@njit(cache=True, nogil=True)
def _reopen_scale(m, constants):
    forget(m, S, constants[P0_SCALE])
    forget(m, C, constants[P0_SLIP])
    combine(m)


@njit(cache=True, nogil=True)
def _follow_wheel(m, residual, dt):
    """Follow the wheel's mean residual (m/s), refused or not."""
    m[WHEEL_RESIDUAL] += min(dt / WHEEL_AVERAGE, 1.0) * (residual - m[WHEEL_RESIDUAL])


@njit(cache=True, nogil=True)
def tooth_variance(constants):
    """Return the variance (m²) of a count: uniform over one tooth."""
    return constants[TOOTH] * constants[TOOTH] / 12.0


@njit(cache=True, nogil=True)
def slip_ratio(wheel, speed):
    """Return (v_wheel − v)/max(|v_wheel|, |v|); 0 below SLIP_SPEED, where the ratio means nothing."""
    larger = max(abs(wheel), abs(speed))
    return (wheel - speed) / larger if larger > SLIP_SPEED else 0.0


@njit(cache=True, nogil=True)
def _bend(m, delay_index):
    """Return the variance (m/s)² of a delayed speed that its row, a straight line in the delay, leaves out.

    It is ½·(v''·σ²)², the second-order term of the Gaussian filter (Athans, Wishner and Bertolini 1968),
    with the change of acceleration between σ before and after.
    """
    variance = m[P + delay_index * N + delay_index]
    sigma = math.sqrt(variance)
    at = m[TIME] - m[X + delay_index] / NS
    _, later = force_at(m, at + sigma / NS)
    _, earlier = force_at(m, at - sigma / NS)
    change = (later - earlier) * m[GAIN]
    return 0.125 * change * change * variance


@njit(cache=True, nogil=True)
def gps_step(m, constants, speed, variance, t, rows):
    """Correct with the GPS speed (m/s, not negative, variance in (m/s)²) stamped `t` (ns).

    `rows` (MODELS, N + 1) is scratch. Returns what was done.
    """
    m[NIS] = NOT_COMPARED
    predict(m, constants, t)
    signed = direction_of(m) * speed
    predicted = 0.0
    for j in range(MODELS):
        then = delayed_row(m, state_of(m, j), TG, rows[j, :N])
        rows[j, N] = signed - then
        predicted += m[WEIGHTS + j] * then
    floor = RECTIFIED * math.sqrt(variance)
    variance += _bend(m, TG)
    if speed < floor and abs(predicted) < floor:
        m[GPS_REFUSED_SINCE] = -1.0
        return SKIPPED
    residual = signed - predicted
    doubt = _doubt(m, GPS_REFUSED_SINCE, residual)
    m[NIS] = correct(m, rows, variance, constants[GATE], False, doubt)
    if m[NIS] <= constants[GATE]:
        m[GPS_REFUSED_SINCE] = -1.0
        m[GPS_ACCEPTED] = t
        return USED
    vouched = _recent(m, WHEEL_ACCEPTED)
    against = m[WHEEL_RESIDUAL] if _recent(m, WHEEL_TIME) else 0.0
    agree = abs(against) > WHEEL_SAYS and 0.5 < against / residual < 2.0
    if m[GPS_REFUSED_SINCE] < 0.0:
        m[GPS_LEAPT] = 1.0 if m[NIS] > LEAP * constants[GATE] else 0.0
    share = VOUCHED if vouched else (1.0 if m[GPS_LEAPT] > 0.0 else DRIFT)
    limit = constants[LOCKOUT] * share
    if not (agree or _refused_too_long(m, GPS_REFUSED_SINCE, limit)):
        return REFUSED
    time = SINCE
    if vouched:
        _reopen_scale(m, constants)
        # Beside a wheel the acceleration cannot have been wrong by more, or the wheel would not have vouched.
        time = max(time, (m[TIME] - m[GPS_REFUSED_SINCE]) * NS) if m[GPS_REFUSED_SINCE] >= 0.0 else time
    if not agree:
        forget(m, TG, constants[GPS_DELAY_VARIANCE])
    _reopen_speed(m, residual, time)
    correct(m, rows, variance, NO_GATE, False, 0.0)
    m[GPS_REFUSED_SINCE] = -1.0
    return REOPENED


@njit(cache=True, nogil=True)
def _correct_by_wheel(m, constants, rows, r, gate, doubt):
    """Correct with a wheel sensor; its scale is learned only beside a GPS.

    Without one only the accelerometer's gain tells it, which is not good enough to weigh a wheel by.
    """
    alone = m[GPS_ACCEPTED] < 0.0 or m[TIME] - m[GPS_ACCEPTED] >= constants[LOCKOUT]
    return correct(m, rows, r, gate, alone, doubt)


@njit(cache=True, nogil=True)
def _stand(m, constants, rows):
    """Correct with speed zero. A contradiction starts the wait for standstill anew."""
    rows[:] = 0.0
    for j in range(MODELS):
        rows[j, V] = 1.0
        rows[j, N] = -state_of(m, j)[V]
    m[SLIP] = 0.0
    m[PENDING] = 0.0
    m[WHEEL_RESIDUAL] = 0.0
    m[NIS] = _correct_by_wheel(m, constants, rows, constants[STILL_VARIANCE], constants[GATE], 0.0)
    if m[NIS] <= constants[GATE]:
        m[WHEEL_ACCEPTED] = m[TIME]
        m[WHEEL_REFUSED_SINCE] = -1.0
        return USED
    m[MOVED_TIME] = m[TIME]
    return SKIPPED


@njit(cache=True, nogil=True)
def _use_pending(m, constants, rows):
    """Use the count that was waiting for the next one."""
    if m[PENDING] > 0.0:
        rows[:] = 0.0
        for j in range(MODELS):
            x = state_of(m, j)
            rows[j, PW] = 1.0
            rows[j, TW] = -m[PENDING_SPEED]
            rows[j, N] = m[PENDING_COUNT] - (x[PW] - m[PENDING_SPEED] * x[TW])
        _correct_by_wheel(m, constants, rows, tooth_variance(constants), NO_GATE, 0.0)
        m[PENDING] = 0.0


@njit(cache=True, nogil=True)
def count_step(m, constants, count, t, rows):
    """Take the cumulative encoder count at `t` (ns); the one before is used if this one confirms it.

    Waiting keeps the first count of a slip out, which is still within the gate. A count is refused when it
    is further from the prediction than half a tooth and the prediction's own uncertainty allow; the wheel's
    distance is then anchored anew. Up or down, counts are distance in the sense of the gear: some go down in
    reverse. Those that turn within a gear (the car rolls back, the counter began anew) are anchored, unless
    they go on so. Returns what was done.
    """
    m[NIS] = NOT_COMPARED
    predict(m, constants, t)
    dt = (t - m[COUNT_TIME]) * NS
    first = m[COUNT_TIME] < 0.0
    change = 0.0 if first else count - m[COUNT]
    steps = abs(change)
    turned = change * m[COUNT_SENSE] < 0.0
    if not turned and steps > 0.0:
        m[TURNED_SINCE] = -1.0
    anew = m[COUNT_SENSE] == 0.0 or (
        turned and _refused_too_long(m, TURNED_SINCE, constants[LOCKOUT] * ALONE)
    )
    if anew and 0.0 < steps * constants[TOOTH] < SPEED_LIMIT * dt:
        m[COUNT_SENSE] = math.copysign(1.0, change)
        m[TURNED_SINCE] = -1.0
    m[COUNT] = count
    m[COUNT_TIME] = t
    m[WHEEL_TIME] = t
    if first or turned or dt <= 0.0:
        _anchor(m, constants, m[TEETH] * constants[TOOTH])
        m[MOVED_TIME] = t
        m[SLIP] = 0.0
        return STARTED
    m[TEETH] += steps
    z = m[TEETH] * constants[TOOTH]
    if steps != 0.0:
        m[MOVED_TIME] = t
    elif t - m[MOVED_TIME] > constants[STILL_TIME] and abs(m[X + V]) < constants[STILL_SPEED]:
        return _stand(m, constants, rows)
    rolled = steps * constants[TOOTH] / dt
    m[WHEEL_SPEED] = direction_of(m) * rolled / (1.0 + m[X + S])
    m[SLIP] = slip_ratio(m[WHEEL_SPEED], m[X + V])
    residual = z - (m[X + W] - rolled * m[X + TW])
    cov = m[P : P + N * N].reshape(N, N)
    variance = cov[W, W] - 2.0 * rolled * cov[W, TW] + rolled * rolled * cov[TW, TW]
    _follow_wheel(m, direction_of(m) * residual / dt, dt)
    m[NIS] = residual * residual / (variance + tooth_variance(constants))
    accepted = abs(residual) <= 0.5 * constants[TOOTH] + math.sqrt(constants[GATE] * variance)
    slipped = m[WHEEL_REFUSED_SINCE] >= 0.0
    done = _judge_wheel(m, constants, accepted)
    if done != USED or slipped:
        # The first count after a slip may hold its last part: only what follows it is believed.
        _anchor(m, constants, z + rolled * m[X + TW])
        return done
    _use_pending(m, constants, rows)
    # No new tooth only says that the wheel is less than a tooth further, which the gate has checked.
    if steps == 0.0:
        return SKIPPED
    m[PENDING] = 1.0
    m[PENDING_COUNT] = z
    m[PENDING_SPEED] = rolled
    clone(m, W, PW)
    return USED


@njit(cache=True, nogil=True)
def speed_step(m, constants, speed, variance, t, rows):
    """Correct with a speed signal of the wheels (m/s, not negative, variance in (m/s)²) at `t` (ns).

    OBD and ABS give such signals. The noise stays the same for WHEEL_CORRELATION, so that a faster signal
    counts for less per sample. A zero is standstill or nothing: below some speed they all read 0.
    Returns what was done.
    """
    m[NIS] = NOT_COMPARED
    predict(m, constants, t)
    dt = t - m[SPEED_TIME]
    x = m[X : X + N]
    if m[SPEED_TIME] < 0.0:
        m[MOVED_TIME] = t
    elif dt <= 0.0:
        return SKIPPED
    m[SPEED_TIME] = t
    m[WHEEL_TIME] = t
    m[WHEEL_SPEED] = direction_of(m) * speed / (1.0 + x[S])
    if speed != 0.0:
        m[MOVED_TIME] = t
    elif abs(x[V]) < constants[STILL_SPEED]:
        m[SLIP] = 0.0
        return _stand(m, constants, rows) if t - m[MOVED_TIME] > constants[STILL_TIME] else SKIPPED
    elif abs(x[V]) < BLIND_SPEED:
        return SKIPPED
    sign = direction_of(m)
    residual = 0.0
    predicted = 0.0
    for j in range(MODELS):
        state = state_of(m, j)
        h = rows[j, :N]
        then = delayed_row(m, state, TS, h)
        a = -h[TS]
        ratio = 1.0 + state[S] + state[C] * a * sign
        h *= ratio
        h[S] = then
        h[C] = a * then * sign
        rows[j, N] = sign * speed - ratio * then
        residual += m[WEIGHTS + j] * rows[j, N]
        predicted += m[WEIGHTS + j] * then
    r = variance * max(1.0, constants[WHEEL_CORRELATION] / dt) + _bend(m, TS)
    doubt = _doubt(m, WHEEL_REFUSED_SINCE, residual)
    m[NIS] = _correct_by_wheel(m, constants, rows, r, constants[GATE], doubt)
    _follow_wheel(m, residual, dt * NS)
    m[SLIP] = slip_ratio(m[WHEEL_SPEED], predicted)
    done = _judge_wheel(m, constants, m[NIS] <= constants[GATE])
    if done == REOPENED:
        forget(m, TS, constants[SPEED_DELAY_VARIANCE])
        combine(m)
        # What even a reopened scale cannot explain is no wheel speed of this car.
        _correct_by_wheel(m, constants, rows, r, constants[GATE], 0.0)
    return done
