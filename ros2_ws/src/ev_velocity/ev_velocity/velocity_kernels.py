# SPDX-License-Identifier: Apache-2.0
"""Prediction and measurement rows of the joint filter; the memory's layout is in `velocity_memory`.

The acceleration is a = (f − b)/(1 + k) with the specific force f along the car. A delayed speed is exact
through the integrated reading U(t) = ∫f dt: v(t − τ) = v(t) − (U(t) − U(t − τ) − b·τ)/(1 + k), linear in
v and b, and −a(t − τ) is its derivative by τ. The output is the filter's speed less what of its corrections
is still to be let out: it follows the acceleration unfiltered and never steps.
"""

from __future__ import annotations

from numba import njit

from ev_velocity.velocity_bank import LEAST_VARIANCE, SPREAD, combine, covariance_of, mix, state_of
from ev_velocity.velocity_memory import (
    ACCELERATION_PERIOD,
    ACCELERATION_TIME,
    BLEED,
    BLEED_STEP,
    BLEED_TIME,
    BLOCK_TIME,
    COUNT_SENSE,
    DIRECTION,
    FORCE,
    FORCE_TIME,
    GAIN,
    GAIN_BIAS,
    HELD,
    INTEGRAL,
    JERK,
    MAX_GAP,
    MODELS,
    OUT_ACCELERATION,
    OUT_ACCELERATION_VARIANCE,
    OUT_SPEED,
    OUT_SPEED_VARIANCE,
    OUT_TIME,
    PUSH,
    Q_BIAS,
    Q_COAST,
    Q_DELAY,
    Q_GRADE,
    Q_SCALE,
    Q_SPEED,
    Q_WHEEL,
    RING,
    RING_HEAD,
    ROAD_TIME,
    ROUGH,
    SLOTS,
    TG,
    TIME,
    TS,
    TW,
    B,
    C,
    D,
    K,
    N,
    P,
    S,
    V,
    W,
    X,
)

NS = 1e-9
# Ring entries are this far apart (ns): linear interpolation of ∫f dt errs by jerk·step²/8 < 1 mm/s.
RING_STEP = 1e7
# The bank is brought up to date once in this time (ns), and whenever something is measured.
BLOCK = 2e7
# Slow outputs (ns); an accelerometer that jitters by less must not halve their rate.
ROAD_PERIOD = 2e7
CONSTANTS_PERIOD = 1e9
JITTER = 5e5
ACCELERATION_DUE, ROAD_DUE, CONSTANTS_DUE = 1, 2, 4
# A correction beyond this (m/s) is a new start, not a correction: it goes out at once.
SNAP = 1.0
# The step (s) that the cap of the bleed refers to.
STEP = 0.002


@njit(cache=True, nogil=True)
def direction_of(m):
    """Return the sense (±1) of unsigned sensors: that of the last gear that had one, forward before.

    The estimate's own sign would not do: a moment's negative speed would turn every sensor against it.
    """
    return -1.0 if m[DIRECTION] < 0.0 else 1.0


@njit(cache=True, nogil=True)
def advance(m, constants, t):
    """Advance the estimate's speed and distance to `t` (ns) under m[FORCE]; a no-op backwards.

    The bank follows in blocks: between two of them its filters move by ∫f dt and their own constants alone.
    """
    if m[TIME] < 0.0:
        m[TIME] = t
        m[BLOCK_TIME] = t
        return
    dt = (t - m[TIME]) * NS
    if dt <= 0.0:
        return
    # A reading older than MAX_GAP no longer says how the car accelerates: coast, and say so in Q.
    held = max(0.0, min(dt, constants[MAX_GAP] - (m[TIME] - m[FORCE_TIME]) * NS))
    if m[FORCE_TIME] < 0.0:
        held = 0.0
    push = m[FORCE] * held
    dv = push * m[GAIN] - held * m[GAIN_BIAS]
    m[X + D] += dt * (m[X + V] + 0.5 * dv)
    m[X + V] += dv
    m[PUSH] += push
    m[HELD] += held
    # A jerk of j between two readings, h apart, is an error of j·h²/2: nothing at 500 Hz, much at 10 Hz.
    m[ROUGH] += (0.5 * constants[JERK] * held * held) ** 2
    m[INTEGRAL] += push + m[X + B] * (dt - held)
    m[TIME] = t
    _remember(m)
    if t - m[BLOCK_TIME] >= BLOCK:
        _propagate(m, constants)


@njit(cache=True, nogil=True)
def predict(m, constants, t):
    """Advance estimate and bank to `t` (ns), as a measurement needs it; a no-op backwards."""
    advance(m, constants, t)
    if m[TIME] > m[BLOCK_TIME]:
        _propagate(m, constants)


@njit(cache=True, nogil=True)
def gear_step(m, constants, direction, t):
    """Take the sense of travel (1, −1, or 0 for no news) that the gear selects at `t` (ns)."""
    # The distance rolled before the change belongs to the sense before it.
    predict(m, constants, t)
    if direction != 0.0 and direction != m[DIRECTION]:
        m[DIRECTION] = direction
        m[COUNT_SENSE] = 0.0


@njit(cache=True, nogil=True)
def _propagate(m, constants):
    """Bring every filter of the bank to m[TIME]: v' = (f − b)/(1 + k), grade as a walk with distance."""
    dt = (m[TIME] - m[BLOCK_TIME]) * NS
    held = m[HELD]
    direction = direction_of(m)
    for k in range(MODELS):
        x = state_of(m, k)
        cov = covariance_of(m, k)
        gain = 1.0 / (1.0 + x[K])
        dv = (m[PUSH] - x[B] * held) * gain
        v = x[V] + 0.5 * dv
        a = dv / dt
        ratio = direction * (1.0 + x[S] + x[C] * a * direction)
        x[V] += dv
        x[W] += dt * ratio * v
        x[D] += dt * v
        f_vb = -held * gain
        f_vk = -dv * gain
        f_wv = dt * ratio
        f_ws = dt * direction * v
        f_wc = dt * a * v
        # F = I + a few entries: rows, then columns, of W and D first since they use the old V.
        for j in range(N):
            gained = f_vb * cov[B, j] + f_vk * cov[K, j]
            mean = cov[V, j] + 0.5 * gained
            cov[W, j] += f_wv * mean + f_ws * cov[S, j] + f_wc * cov[C, j]
            cov[D, j] += dt * mean
            cov[V, j] += gained
        for j in range(N):
            gained = f_vb * cov[j, B] + f_vk * cov[j, K]
            mean = cov[j, V] + 0.5 * gained
            cov[j, W] += f_wv * mean + f_ws * cov[j, S] + f_wc * cov[j, C]
            cov[j, D] += dt * mean
            cov[j, V] += gained
        speed = abs(v)
        cov[V, V] += constants[Q_SPEED] * held + m[ROUGH] + constants[Q_COAST] * (dt - held)
        cov[B, B] += (constants[Q_BIAS] + constants[Q_GRADE] * SPREAD[k] ** 2 * speed) * dt
        cov[S, S] += constants[Q_SCALE] * speed * dt
        cov[TG, TG] += constants[Q_DELAY] * dt
        cov[TW, TW] += constants[Q_DELAY] * dt
        cov[TS, TS] += constants[Q_DELAY] * dt
        cov[W, W] += constants[Q_WHEEL] * speed * dt
    m[PUSH] = 0.0
    m[HELD] = 0.0
    m[ROUGH] = 0.0
    m[BLOCK_TIME] = m[TIME]
    mix(m)
    combine(m)


@njit(cache=True, nogil=True)
def _remember(m):
    """Put (time, U) into the ring once per RING_STEP."""
    head = int(m[RING_HEAD])
    last = m[RING + 2 * ((head - 1) % SLOTS)]
    if last < 0.0 or m[TIME] - last >= RING_STEP:
        m[RING + 2 * head] = m[TIME]
        m[RING + 2 * head + 1] = m[INTEGRAL]
        m[RING_HEAD] = (head + 1) % SLOTS


@njit(cache=True, nogil=True)
def force_at(m, t):
    """Return (U(t), f(t)) by linear interpolation in the ring; `t` in ns."""
    newer_t = m[TIME]
    newer_u = m[INTEGRAL]
    if t > newer_t:
        return newer_u + m[FORCE] * (t - newer_t) * NS, m[FORCE]
    head = int(m[RING_HEAD])
    for i in range(SLOTS):
        slot = RING + 2 * ((head - 1 - i) % SLOTS)
        older_t = m[slot]
        if older_t < 0.0:
            break
        older_u = m[slot + 1]
        if t >= older_t and newer_t > older_t:
            slope = (newer_u - older_u) / (newer_t - older_t)
            return newer_u - slope * (newer_t - t), slope / NS
        if newer_t > older_t:
            newer_t, newer_u = older_t, older_u
    # Before the ring: the car is taken to have had no acceleration.
    return newer_u - m[X + B] * (newer_t - t) * NS, m[X + B]


@njit(cache=True, nogil=True)
def delayed_row(m, x, delay_index, h):
    """Fill `h` with the derivative of v(t − τ) by the state `x` (N,) and return v(t − τ); τ is its delay."""
    tau = x[delay_index]
    then, force = force_at(m, m[TIME] - tau / NS)
    gain = 1.0 / (1.0 + x[K])
    moved = m[INTEGRAL] - then - x[B] * tau
    h[:] = 0.0
    h[V] = 1.0
    h[B] = tau * gain
    h[K] = moved * gain * gain
    h[delay_index] = -(force - x[B]) * gain
    return x[V] - moved * gain


@njit(cache=True, nogil=True)
def force_step(m, constants, force, t):
    """Take the mean specific force (m/s²) of the interval that ends at `t` (ns); see `report`."""
    if m[FORCE_TIME] < 0.0 or (t - m[FORCE_TIME]) * NS > constants[MAX_GAP]:
        # One reading says nothing of the silence before it.
        advance(m, constants, t)
    m[FORCE] = force
    m[FORCE_TIME] = t
    advance(m, constants, t)
    let_out(m, constants, (t - m[OUT_TIME]) * NS if m[OUT_TIME] >= 0.0 else 0.0)
    return report(m, constants, t)


@njit(cache=True, nogil=True)
def report(m, constants, t):
    """Return speed, variance, acceleration, variance, and which slow outputs are due at `t` (ns)."""
    due = 0
    if t - m[ACCELERATION_TIME] >= constants[ACCELERATION_PERIOD] - JITTER:
        m[ACCELERATION_TIME] = t
        due += ACCELERATION_DUE
    if t - m[ROAD_TIME] >= ROAD_PERIOD - JITTER:
        due += ROAD_DUE
        if t // CONSTANTS_PERIOD != m[ROAD_TIME] // CONSTANTS_PERIOD:
            due += CONSTANTS_DUE
        m[ROAD_TIME] = t
    return m[OUT_SPEED], m[OUT_SPEED_VARIANCE], m[OUT_ACCELERATION], m[OUT_ACCELERATION_VARIANCE], due


@njit(cache=True, nogil=True)
def let_out(m, constants, dt):
    """Let corrections out for `dt` (s), the time since the last output, and fill those of the memory."""
    dt = max(dt, 0.0)
    m[OUT_TIME] = m[TIME]
    bleed = m[BLEED]
    if abs(bleed) > SNAP:
        bleed = 0.0
    # The cap is per step of 2 ms; slower accelerometers may let out more at a time.
    cap = constants[BLEED_STEP] * max(1.0, dt / STEP)
    part = bleed * min(1.0, dt / constants[BLEED_TIME])
    bleed -= min(max(part, -cap), cap)
    m[BLEED] = bleed
    gain = 1.0 / (1.0 + m[X + K])
    coasting = (m[TIME] - m[FORCE_TIME]) * NS > constants[MAX_GAP]
    m[OUT_SPEED] = m[X + V] - bleed
    # Since the last block the variance has grown; the correction held back is a known error.
    pushed = m[HELD] * gain
    coasted = (m[TIME] - m[BLOCK_TIME]) * NS - m[HELD]
    grown = constants[Q_SPEED] * m[HELD] + m[ROUGH] + constants[Q_COAST] * coasted
    crossed = pushed * (pushed * m[P + B * N + B] - 2.0 * m[P + V * N + B])
    m[OUT_SPEED_VARIANCE] = max(m[P + V * N + V] + crossed, LEAST_VARIANCE) + grown + bleed * bleed
    m[OUT_ACCELERATION] = 0.0 if coasting else (m[FORCE] - m[X + B]) * gain
    m[OUT_ACCELERATION_VARIANCE] = m[P + B * N + B] + (
        constants[Q_COAST] if coasting else constants[Q_SPEED] / max(dt, STEP)
    )
