# SPDX-License-Identifier: Apache-2.0
"""Measurements of the joint filter: GPS speed, encoder counts, wheel speed, standstill; with their gates.

Every gate is a chi-square gate with one degree of freedom, except that of the counts: a tooth has no tails.
No refusal lasts for ever: after LOCKOUT a sensor is believed again. GPS and wheel refused on the same side
by about as much are believed at once, since then the acceleration is wrong (a ramp, a knocked sensor).
"""

from __future__ import annotations

import math

from numba import njit

from ev_velocity.velocity_kernels import (
    NS,
    consider,
    correct,
    delayed_row,
    direction_of,
    predict,
)
from ev_velocity.velocity_memory import (
    COUNT,
    COUNT_TIME,
    GATE,
    GPS_ACCEPTED,
    GPS_REFUSED_SINCE,
    LOCKOUT,
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
    SPEED_DELAY,
    SPEED_DELAY_VARIANCE,
    SPEED_TIME,
    STARTED,
    STILL_SPEED,
    STILL_TIME,
    STILL_VARIANCE,
    SURPRISE,
    SURPRISE_TIME,
    TG,
    TIME,
    TOOTH,
    TW,
    USED,
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

# Time constant (s) of the mean normalised innovation squared, the most that one sample may weigh in it
# (a sensor of 1 Hz), and the most that one may say.
SURPRISE_TIME_CONSTANT = 20.0
SURPRISE_WEIGHT = 0.05
SURPRISE_LIMIT = 16.0
# A GPS speed below so many σ is rectified noise: it says nothing of size or sign.
RECTIFIED = 3.0
# A wheel sample younger than this (ns) can bear witness; the slowest usual source has 1 Hz.
FRESH = 1.5e9
# Wheels that agree with the filter make the GPS wait so many times longer.
VOUCHED = 3.0
# Without a GPS the wheel waits this share of the lock-out time: 4 s of 10, longer than a slip lasts.
ALONE = 0.4
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


@njit(cache=True, nogil=True)
def _forget(m, index, variance):
    """Give state `index` the variance and no correlation."""
    cov = m[P : P + N * N].reshape(N, N)
    for i in range(N):
        cov[index, i] = 0.0
        cov[i, index] = 0.0
    cov[index, index] = variance


@njit(cache=True, nogil=True)
def _anchor(m, constants, distance):
    """Take the wheel's distance (m) as measured: what it rolled since the last sample says nothing."""
    m[PENDING] = 0.0
    m[X + W] = distance
    _forget(m, W, tooth_variance(constants))


@njit(cache=True, nogil=True)
def _clone(m):
    """Set PW = W, with its covariances."""
    cov = m[P : P + N * N].reshape(N, N)
    m[X + PW] = m[X + W]
    for i in range(N):
        cov[PW, i] = cov[W, i]
    for i in range(N):
        cov[i, PW] = cov[i, W]


@njit(cache=True, nogil=True)
def _refused_too_long(m, since, limit):
    """Start or continue a run of refusals; True when it has lasted `limit` (ns)."""
    if m[since] < 0.0:
        m[since] = m[TIME]
    return m[TIME] - m[since] > limit


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
        _reopen_speed(m, m[WHEEL_RESIDUAL])
    m[WHEEL_REFUSED_SINCE] = -1.0
    return REOPENED


@njit(cache=True, nogil=True)
def _reopen_speed(m, residual):
    """Let speed and bias be as wrong as `residual` (m/s) says."""
    _forget(m, V, residual * residual)
    m[P + B * N + B] += residual * residual / (SINCE * SINCE)


@njit(cache=True, nogil=True)
def _reopen_scale(m, constants):
    _forget(m, S, constants[P0_SCALE])
    _forget(m, C, constants[P0_SLIP])


@njit(cache=True, nogil=True)
def _follow_wheel(m, residual, dt):
    """Follow the wheel's mean residual (m/s), refused or not."""
    m[WHEEL_RESIDUAL] += min(dt / WHEEL_AVERAGE, 1.0) * (residual - m[WHEEL_RESIDUAL])


@njit(cache=True, nogil=True)
def _surprised(m, nis):
    elapsed = (m[TIME] - m[SURPRISE_TIME]) * NS
    m[SURPRISE_TIME] = m[TIME]
    weight = min(elapsed / SURPRISE_TIME_CONSTANT, SURPRISE_WEIGHT)
    m[SURPRISE] += weight * (min(nis, SURPRISE_LIMIT) - m[SURPRISE])


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
def gps_step(m, constants, speed, variance, t, h):
    """Correct with the GPS speed (m/s, not negative, variance in (m/s)²) stamped `t` (ns).

    `h` (N,) is scratch. Returns what was done.
    """
    predict(m, constants, t)
    predicted = delayed_row(m, TG, h)
    floor = RECTIFIED * math.sqrt(variance)
    if speed < floor and abs(predicted) < floor:
        m[GPS_REFUSED_SINCE] = -1.0
        return SKIPPED
    residual = direction_of(m) * speed - predicted
    m[NIS] = correct(m, residual, h, variance, constants[GATE])
    _surprised(m, m[NIS])
    if m[NIS] <= constants[GATE]:
        m[GPS_REFUSED_SINCE] = -1.0
        m[GPS_ACCEPTED] = t
        return USED
    vouched = _recent(m, WHEEL_ACCEPTED)
    against = m[WHEEL_RESIDUAL] if _recent(m, WHEEL_TIME) else 0.0
    agree = abs(against) > WHEEL_SAYS and 0.5 < against / residual < 2.0
    limit = constants[LOCKOUT] * (VOUCHED if vouched else 1.0)
    if not (agree or _refused_too_long(m, GPS_REFUSED_SINCE, limit)):
        return REFUSED
    if vouched:
        _reopen_scale(m, constants)
    _reopen_speed(m, residual)
    correct(m, residual, h, variance, NO_GATE)
    m[GPS_REFUSED_SINCE] = -1.0
    return REOPENED


@njit(cache=True, nogil=True)
def _correct_by_wheel(m, constants, residual, h, r, gate):
    """Correct with a wheel sensor; it is learned anew only beside a GPS."""
    if m[GPS_ACCEPTED] >= 0.0 and m[TIME] - m[GPS_ACCEPTED] < constants[LOCKOUT]:
        return correct(m, residual, h, r, gate)
    return consider(m, residual, h, r, gate)


@njit(cache=True, nogil=True)
def _stand(m, constants, h):
    """Correct with speed zero. A contradiction starts the wait for standstill anew."""
    h[:] = 0.0
    h[V] = 1.0
    m[SLIP] = 0.0
    m[PENDING] = 0.0
    m[WHEEL_RESIDUAL] = 0.0
    m[NIS] = _correct_by_wheel(m, constants, -m[X + V], h, constants[STILL_VARIANCE], constants[GATE])
    if m[NIS] <= constants[GATE]:
        m[WHEEL_ACCEPTED] = m[TIME]
        m[WHEEL_REFUSED_SINCE] = -1.0
        return USED
    m[MOVED_TIME] = m[TIME]
    return SKIPPED


@njit(cache=True, nogil=True)
def _use_pending(m, constants, h):
    """Use the count that was waiting for the next one."""
    if m[PENDING] > 0.0:
        h[:] = 0.0
        h[PW] = 1.0
        h[TW] = -m[PENDING_SPEED]
        residual = m[PENDING_COUNT] - (m[X + PW] - m[PENDING_SPEED] * m[X + TW])
        _correct_by_wheel(m, constants, residual, h, tooth_variance(constants), NO_GATE)
        m[PENDING] = 0.0


@njit(cache=True, nogil=True)
def _variance_along(m, h):
    """Return h·P·hᵀ."""
    cov = m[P : P + N * N].reshape(N, N)
    total = 0.0
    for i in range(N):
        if h[i] != 0.0:
            for j in range(N):
                total += h[i] * cov[i, j] * h[j]
    return total


@njit(cache=True, nogil=True)
def count_step(m, constants, count, t, h):
    """Take the cumulative encoder count at `t` (ns); the one before is used if this one confirms it.

    Waiting keeps the first count of a slip out, which is still within the gate. A count is refused when it
    is further from the prediction than half a tooth and the prediction's own uncertainty allow; the wheel's
    distance is then anchored anew. Returns what was done.
    """
    predict(m, constants, t)
    z = count * constants[TOOTH]
    steps = count - m[COUNT]
    dt = (t - m[COUNT_TIME]) * NS
    first = m[COUNT_TIME] < 0.0
    m[COUNT] = count
    m[COUNT_TIME] = t
    m[WHEEL_TIME] = t
    if first or steps < 0.0 or dt <= 0.0:
        _anchor(m, constants, z)
        m[MOVED_TIME] = t
        m[SLIP] = 0.0
        return STARTED
    if steps != 0.0:
        m[MOVED_TIME] = t
    elif t - m[MOVED_TIME] > constants[STILL_TIME] and abs(m[X + V]) < constants[STILL_SPEED]:
        return _stand(m, constants, h)
    rolled = steps * constants[TOOTH] / dt
    m[WHEEL_SPEED] = direction_of(m) * rolled / (1.0 + m[X + S])
    m[SLIP] = slip_ratio(m[WHEEL_SPEED], m[X + V])
    h[:] = 0.0
    h[W] = 1.0
    h[TW] = -rolled
    residual = z - (m[X + W] - rolled * m[X + TW])
    variance = _variance_along(m, h)
    _follow_wheel(m, direction_of(m) * residual / dt, dt)
    m[NIS] = residual * residual / (variance + tooth_variance(constants))
    accepted = abs(residual) <= 0.5 * constants[TOOTH] + math.sqrt(constants[GATE] * variance)
    slipped = m[WHEEL_REFUSED_SINCE] >= 0.0
    done = _judge_wheel(m, constants, accepted)
    if done != USED or slipped:
        # The first count after a slip may hold its last part: only what follows it is believed.
        _anchor(m, constants, z + rolled * m[X + TW])
        return done
    _use_pending(m, constants, h)
    # No new tooth only says that the wheel is less than a tooth further, which the gate has checked.
    if steps == 0.0:
        return SKIPPED
    m[PENDING] = 1.0
    m[PENDING_COUNT] = z
    m[PENDING_SPEED] = rolled
    _clone(m)
    return USED


@njit(cache=True, nogil=True)
def speed_step(m, constants, speed, variance, t, h):
    """Correct with a speed signal of the wheels (m/s, not negative, variance in (m/s)²) at `t` (ns).

    OBD and ABS give such signals. The noise stays the same for WHEEL_CORRELATION, so that a faster signal
    counts for less per sample. A zero is standstill or nothing: below some speed they all read 0.
    Returns what was done.
    """
    predict(m, constants, t)
    dt = t - m[SPEED_TIME]
    x = m[X : X + N]
    if m[SPEED_TIME] < 0.0:
        x[TW] = constants[SPEED_DELAY]
        _forget(m, TW, constants[SPEED_DELAY_VARIANCE])
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
        return _stand(m, constants, h) if t - m[MOVED_TIME] > constants[STILL_TIME] else SKIPPED
    elif abs(x[V]) < BLIND_SPEED:
        return SKIPPED
    then = delayed_row(m, TW, h)
    sign = direction_of(m)
    a = -h[TW]
    ratio = 1.0 + x[S] + x[C] * a * sign
    for i in range(N):
        h[i] *= ratio
    h[S] = then
    h[C] = a * then * sign
    residual = sign * speed - ratio * then
    r = variance * max(1.0, constants[WHEEL_CORRELATION] / dt)
    m[NIS] = _correct_by_wheel(m, constants, residual, h, r, constants[GATE])
    _follow_wheel(m, residual, dt * NS)
    m[SLIP] = slip_ratio(m[WHEEL_SPEED], then)
    _surprised(m, m[NIS])
    done = _judge_wheel(m, constants, m[NIS] <= constants[GATE])
    if done == REOPENED:
        _correct_by_wheel(m, constants, residual, h, r, NO_GATE)
    return done
