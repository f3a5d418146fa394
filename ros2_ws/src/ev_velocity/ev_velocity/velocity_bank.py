# SPDX-License-Identifier: Apache-2.0
"""A bank of filters that differ in how fast the road's grade walks, and the estimate they make together.

Nobody tells how hilly a road is, and no single walk is honest on a plain and on a ramp. The filters are
mixed as an interacting multiple model (Blom and Bar-Shalom 1988) whose transitions go with the distance
driven, and weighted by the likelihood of what is measured. Gates look at the mixture.

`rows` (MODELS, N + 1) is what a measurement gives: by filter its row and, last, its residual.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ev_velocity.velocity_memory import (
    BANK,
    BLEED,
    FILTER,
    GAIN,
    GAIN_BIAS,
    MIXED_AT,
    MODELS,
    PRIOR,
    TG,
    TS,
    TW,
    WEIGHTS,
    B,
    C,
    D,
    K,
    N,
    P,
    S,
    V,
    X,
)

# The filters' grade noise in units of the parameter: from a plain to the foot of a ramp.
SPREAD = (0.25, 1.0, 4.0, 16.0)
# A stretch of road of one kind (m), and the distance (m) between two mixings.
STRETCH = 500.0
MIXING = 1.0
# A filter that was wrong for long can still come back.
LEAST_WEIGHT = 1e-6
# Physical limits: beyond them the model means nothing. A bias of 5 m/s² is a mounting or a road at 30°.
SPEED_LIMIT = 150.0
BIAS_LIMIT = 5.0
GAIN_LIMIT = 0.5
SCALE_LIMIT = 0.3
SLIP_LIMIT = 0.05
# A delay (s) may be estimated this far below zero: some loggers stamp early.
DELAY_EARLY = 0.5
DELAY_MAX = 1.0
# Rounding must not make a variance zero or negative.
LEAST_VARIANCE = 1e-14


@njit(cache=True, nogil=True)
def state_of(m, j):
    """Return the state (N,) of filter `j`, a view."""
    start = BANK + j * FILTER
    return m[start : start + N]


@njit(cache=True, nogil=True)
def covariance_of(m, j):
    """Return the covariance (N, N) of filter `j`, a view."""
    start = BANK + j * FILTER + N
    return m[start : start + N * N].reshape(N, N)


@njit(cache=True, nogil=True)
def combine(m):
    """Make the estimate from the bank: mean and covariance of the mixture."""
    x = m[X : X + N]
    cov = m[P : P + N * N].reshape(N, N)
    x[:] = 0.0
    cov[:] = 0.0
    m[GAIN] = 0.0
    m[GAIN_BIAS] = 0.0
    for j in range(MODELS):
        weight = m[WEIGHTS + j]
        state = state_of(m, j)
        for i in range(N):
            x[i] += weight * state[i]
        gain = weight / (1.0 + state[K])
        m[GAIN] += gain
        m[GAIN_BIAS] += gain * state[B]
    for j in range(MODELS):
        weight = m[WEIGHTS + j]
        state = state_of(m, j)
        own = covariance_of(m, j)
        for i in range(N):
            off = state[i] - x[i]
            for k in range(i, N):
                cov[i, k] += weight * (own[i, k] + off * (state[k] - x[k]))
    for i in range(N):
        for k in range(i + 1, N):
            cov[k, i] = cov[i, k]


@njit(cache=True, nogil=True)
def mix(m):
    """Let the road have changed its kind over the distance driven since the last call, once per MIXING."""
    distance = abs(m[X + D] - m[MIXED_AT])
    if distance < MIXING:
        return
    m[MIXED_AT] = m[X + D]
    stay = math.exp(-distance / STRETCH)
    old = m[BANK:WEIGHTS].copy()
    weights = m[WEIGHTS : WEIGHTS + MODELS].copy()
    for j in range(MODELS):
        x = state_of(m, j)
        cov = covariance_of(m, j)
        change = (1.0 - stay) * PRIOR[j]
        total = change + stay * weights[j]
        x[:] = 0.0
        cov[:] = 0.0
        for i in range(MODELS):
            share = (change + (stay if i == j else 0.0)) * weights[i] / total
            for k in range(N):
                x[k] += share * old[i * FILTER + k]
        for i in range(MODELS):
            share = (change + (stay if i == j else 0.0)) * weights[i] / total
            start = i * FILTER
            for a in range(N):
                off = share * (old[start + a] - x[a])
                for b in range(N):
                    cov[a, b] += share * old[start + N + a * N + b] + off * (old[start + b] - x[b])
        m[WEIGHTS + j] = total


@njit(cache=True, nogil=True)
def _update(x, cov, h, residual, ph, s, keep_scale):
    """Correct one filter with a scalar innovation of variance `s`; `ph` (N,) is P·hᵀ.

    The covariance is that of any gain, so that a gain set to zero leaves what it does not learn counted.
    """
    gain = ph / s
    if keep_scale:
        gain[S] = 0.0
    for i in range(N):
        x[i] += gain[i] * residual
        for j in range(i, N):
            value = cov[i, j] - gain[i] * ph[j] - ph[i] * gain[j] + gain[i] * gain[j] * s
            cov[i, j] = value
            cov[j, i] = value
        cov[i, i] = max(cov[i, i], LEAST_VARIANCE)
    x[V] = min(max(x[V], -SPEED_LIMIT), SPEED_LIMIT)
    x[B] = min(max(x[B], -BIAS_LIMIT), BIAS_LIMIT)
    x[K] = min(max(x[K], -GAIN_LIMIT), GAIN_LIMIT)
    x[S] = min(max(x[S], -SCALE_LIMIT), SCALE_LIMIT)
    x[C] = min(max(x[C], -SLIP_LIMIT), SLIP_LIMIT)
    x[TG] = min(max(x[TG], -DELAY_EARLY), DELAY_MAX)
    x[TW] = min(max(x[TW], -DELAY_EARLY), DELAY_MAX)
    x[TS] = min(max(x[TS], -DELAY_EARLY), DELAY_MAX)


@njit(cache=True, nogil=True)
def correct(m, rows, r, gate, keep_scale, doubt):
    """Correct the bank with one scalar measurement of variance `r`.

    With `keep_scale` the wheel's scale is considered, not learned (Schmidt); `doubt` is variance that counts
    once the gate is passed. Returns the normalised innovation squared of the mixture; beyond `gate` nothing
    is changed. What the speed changes goes into the bleed.
    """
    ph = np.zeros((MODELS, N))
    s = np.full(MODELS, r)
    mean = 0.0
    for j in range(MODELS):
        cov = covariance_of(m, j)
        for k in range(N):
            if rows[j, k] != 0.0:
                for i in range(N):
                    ph[j, i] += rows[j, k] * cov[k, i]
        for k in range(N):
            s[j] += rows[j, k] * ph[j, k]
        mean += m[WEIGHTS + j] * rows[j, N]
    variance = 0.0
    for j in range(MODELS):
        variance += m[WEIGHTS + j] * (s[j] + (rows[j, N] - mean) ** 2)
    nis = mean * mean / variance if variance > 0.0 else math.nan
    if not (nis <= gate and nis < math.inf):
        return nis
    before = m[X + V]
    likelihood = np.empty(MODELS)
    for j in range(MODELS):
        s[j] += doubt
        likelihood[j] = -0.5 * (math.log(s[j]) + rows[j, N] ** 2 / s[j])
    most = likelihood.max()
    total = 0.0
    for j in range(MODELS):
        weight = max(m[WEIGHTS + j] * math.exp(likelihood[j] - most), LEAST_WEIGHT)
        m[WEIGHTS + j] = weight
        total += weight
        _update(state_of(m, j), covariance_of(m, j), rows[j, :N], rows[j, N], ph[j], s[j], keep_scale)
    for j in range(MODELS):
        m[WEIGHTS + j] /= total
    combine(m)
    m[BLEED] += m[X + V] - before
    return nis


@njit(cache=True, nogil=True)
def forget(m, index, variance):
    """Give state `index` the variance and no correlation, in the whole bank; `combine` is the caller's."""
    for j in range(MODELS):
        cov = covariance_of(m, j)
        cov[index, :] = 0.0
        cov[:, index] = 0.0
        cov[index, index] = variance


@njit(cache=True, nogil=True)
def place(m, index, value):
    """Set state `index` in the whole bank; `combine` is the caller's."""
    for j in range(MODELS):
        state_of(m, j)[index] = value


@njit(cache=True, nogil=True)
def clone(m, source, copy):
    """Make state `copy` that of `source`, with its covariances, in the whole bank."""
    for j in range(MODELS):
        x = state_of(m, j)
        cov = covariance_of(m, j)
        x[copy] = x[source]
        cov[copy, :] = cov[source, :]
        cov[:, copy] = cov[:, source]
    combine(m)
