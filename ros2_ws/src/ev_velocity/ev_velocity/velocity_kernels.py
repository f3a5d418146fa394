# SPDX-License-Identifier: Apache-2.0
"""Prediction and measurement rows of the joint filter; the memory's layout is in `velocity_memory`.

The acceleration is a = (f − b)/(1 + k) with the specific force f along the car. A delayed speed is exact
through the integrated reading U(t) = ∫f dt: v(t − τ) = v(t) − (U(t) − U(t − τ) − b·τ)/(1 + k), linear in
v and b, and −a(t − τ) is its derivative by τ. The output is the filter's speed less what of its corrections
is still to be let out: it follows the acceleration unfiltered and never steps.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ev_velocity.velocity_memory import (
    BLEED,
    BLEED_STEP,
    BLEED_TIME,
    DIRECTION,
    FORCE,
    FORCE_TIME,
    INTEGRAL,
    MAX_GAP,
    OUT_ACCELERATION,
    OUT_ACCELERATION_VARIANCE,
    OUT_SPEED,
    OUT_SPEED_VARIANCE,
    Q_BIAS,
    Q_COAST,
    Q_DELAY,
    Q_GRADE,
    Q_SCALE,
    Q_SPEED,
    Q_WHEEL,
    RING,
    RING_HEAD,
    SLOTS,
    SURPRISE,
    TG,
    TIME,
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
from kalman_core.linear import correct_scalar

NS = 1e-9
# A delay (s) may be estimated this far below zero: some loggers stamp early.
DELAY_EARLY = 0.5
DELAY_MAX = 1.0
# Physical limits of the constants: beyond them the model means nothing.
GAIN_LIMIT = 0.5
SCALE_LIMIT = 0.3
SLIP_LIMIT = 0.05
# Rounding must not make a variance zero or negative.
LEAST_VARIANCE = 1e-14
# Ring entries are this far apart (ns): linear interpolation of ∫f dt errs by jerk·step²/8 < 1 mm/s.
RING_STEP = 1e7
# A correction beyond this (m/s) is a new start, not a correction: it goes out at once.
SNAP = 1.0
# The step (s) that the cap of the bleed refers to.
STEP = 0.002


@njit(cache=True, nogil=True)
def direction_of(m):
    """Return the sense (±1) of unsigned sensors: the gear's, forward while that is unknown.

    The estimate's own sign would not do: a moment's negative speed would turn every sensor against it.
    """
    return -1.0 if m[DIRECTION] < 0.0 else 1.0


@njit(cache=True, nogil=True)
def predict(m, constants, t):
    """Advance the filter to `t` (ns) under the specific force m[FORCE]; a no-op backwards.

    First-order discretisation of v' = (f − b)/(1 + k); the grade's part of b walks with the distance
    driven, and faster while the innovations are larger than their covariance says.
    """
    if m[TIME] < 0.0:
        m[TIME] = t
        return
    dt = (t - m[TIME]) * NS
    if dt <= 0.0:
        return
    x = m[X : X + N]
    cov = m[P : P + N * N].reshape(N, N)
    gain = 1.0 / (1.0 + x[K])
    # A reading older than MAX_GAP no longer says how the car accelerates: coast, and say so in Q.
    held = max(0.0, min(dt, constants[MAX_GAP] - (m[TIME] - m[FORCE_TIME]) * NS))
    if m[FORCE_TIME] < 0.0:
        held = 0.0
    a = (m[FORCE] - x[B]) * gain
    dv = held * a
    v = x[V] + 0.5 * dv
    direction = direction_of(m)
    ratio = direction * (1.0 + x[S] + x[C] * a * direction)
    x[V] += dv
    x[W] += dt * ratio * v
    x[D] += dt * v
    m[INTEGRAL] += m[FORCE] * held + x[B] * (dt - held)

    f_vb = -held * gain
    f_vk = -dv * gain
    f_wv = dt * ratio
    f_ws = dt * direction * v
    f_wc = dt * a * v
    # F = I + a few entries: rows, then columns, of W and D first since they use the old V.
    for j in range(N):
        cov[W, j] += f_wv * cov[V, j] + f_ws * cov[S, j] + f_wc * cov[C, j]
        cov[D, j] += dt * cov[V, j]
        cov[V, j] += f_vb * cov[B, j] + f_vk * cov[K, j]
    for j in range(N):
        cov[j, W] += f_wv * cov[j, V] + f_ws * cov[j, S] + f_wc * cov[j, C]
        cov[j, D] += dt * cov[j, V]
        cov[j, V] += f_vb * cov[j, B] + f_vk * cov[j, K]
    speed = abs(v)
    surprise = max(1.0, m[SURPRISE])
    cov[V, V] += constants[Q_SPEED] * held + constants[Q_COAST] * (dt - held)
    cov[B, B] += (constants[Q_BIAS] + constants[Q_GRADE] * speed * surprise * surprise) * dt
    cov[S, S] += constants[Q_SCALE] * speed * dt
    cov[TG, TG] += constants[Q_DELAY] * dt
    cov[TW, TW] += constants[Q_DELAY] * dt
    cov[W, W] += constants[Q_WHEEL] * speed * dt
    m[TIME] = t
    _remember(m)


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
def delayed_row(m, delay_index, h):
    """Fill `h` (N,) with the derivative of v(t − τ) and return v(t − τ); τ is the state `delay_index`."""
    x = m[X : X + N]
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
def correct(m, residual, h, r, gate):
    """Correct x and P with one scalar innovation, `h` (N,) its row and `r` its variance.

    Returns the normalised innovation squared; beyond `gate` nothing is changed. What the speed changes goes
    into the bleed.
    """
    before = m[X + V]
    _, nis = correct_scalar(m[X : X + N], m[P : P + N * N].reshape(N, N), residual, h, r, gate)
    _limit(m)
    m[BLEED] += m[X + V] - before
    return nis


@njit(cache=True, nogil=True)
def consider(m, residual, h, r, gate):
    """Correct like `correct`, but leave the wheel's scale as it is and its uncertainty counted.

    Without a GPS only the accelerometer's gain tells it, which is not good enough to weigh a wheel by
    (Schmidt's consider filter).
    """
    x = m[X : X + N]
    cov = m[P : P + N * N].reshape(N, N)
    ph = np.zeros(N)
    for i in range(N):
        for j in range(N):
            ph[i] += cov[i, j] * h[j]
    s = r
    for i in range(N):
        s += h[i] * ph[i]
    nis = residual * residual / s
    if not nis <= gate:
        return nis
    gain = ph / s
    gain[S] = 0.0
    before = x[V]
    for i in range(N):
        x[i] += gain[i] * residual
        for j in range(i, N):
            value = cov[i, j] - gain[i] * ph[j] - ph[i] * gain[j] + gain[i] * gain[j] * s
            cov[i, j] = value
            cov[j, i] = value
        cov[i, i] = max(cov[i, i], LEAST_VARIANCE)
    _limit(m)
    m[BLEED] += x[V] - before
    return nis


@njit(cache=True, nogil=True)
def _limit(m):
    """Keep the constants within what they can physically be."""
    x = m[X : X + N]
    x[K] = min(max(x[K], -GAIN_LIMIT), GAIN_LIMIT)
    x[S] = min(max(x[S], -SCALE_LIMIT), SCALE_LIMIT)
    x[C] = min(max(x[C], -SLIP_LIMIT), SLIP_LIMIT)
    x[TG] = min(max(x[TG], -DELAY_EARLY), DELAY_MAX)
    x[TW] = min(max(x[TW], -DELAY_EARLY), DELAY_MAX)


@njit(cache=True, nogil=True)
def force_step(m, constants, force, t):
    """Take the mean specific force (m/s²) of the interval that ends at `t` (ns) and fill the outputs."""
    before = m[TIME]
    m[FORCE] = force
    m[FORCE_TIME] = t
    predict(m, constants, t)
    let_out(m, constants, (t - before) * NS if before >= 0.0 else 0.0)


@njit(cache=True, nogil=True)
def let_out(m, constants, dt):
    """Let corrections out for `dt` (s) and fill the outputs of the memory."""
    dt = max(dt, 0.0)
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
    # The correction held back is a known error: its square belongs to the mean square.
    m[OUT_SPEED_VARIANCE] = m[P + V * N + V] + bleed * bleed
    m[OUT_ACCELERATION] = 0.0 if coasting else (m[FORCE] - m[X + B]) * gain
    m[OUT_ACCELERATION_VARIANCE] = m[P + B * N + B] + (
        constants[Q_COAST] if coasting else constants[Q_SPEED] / max(dt, STEP)
    )
