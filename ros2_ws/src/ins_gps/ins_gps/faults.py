# SPDX-License-Identifier: Apache-2.0
"""Slow errors in one satellite's code: found by all innovations together, taken back from the state.

A gate on single innovations lets a slow error pass until it is large, and what passed stays in the state.
Here each channel has at most one hypothesis, "this code drifts since `C_ONSET`". It starts where a cumulated
sum of the leave-one-out innovations leaves zero. For a drift of 1 m/s the filter keeps what it has done to
the estimate (the signature f, which goes through every prediction and update) and to the innovations (ρ):

    score d = Σ ρᵀ S⁻¹ ν,  information c = Σ ρᵀ S⁻¹ ρ,  drift = d/c,  statistic d²/c (chi-square, 1 dof)

Past the threshold the effect ``f d/c`` is taken out of the estimate, its uncertainty ``f fᵀ/c`` goes into
the covariance, and the code is barred until it has agreed with the others for a while.
Source: Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps
in linear systems" (1976); Page, "Continuous inspection schemes" (1954) for the cumulated sum.
"""

import math

import numpy as np
from numba import njit

from ins_gps.correction import ACCEPTED, EXCLUDED, UNUSED, gain_columns
from ins_gps.layout import (
    ATT,
    C_AGREED,
    C_BARRED,
    C_INFORMATION,
    C_KEY,
    C_MINUS,
    C_ONSET,
    C_PLUS,
    C_SCORE,
    C_SIGN,
    CHANNEL_WIDTH,
    CLK,
    CLONE,
    CLONE_CLK,
    HEAD,
    NSEC,
    POS,
    SEC,
)
from ins_gps.prediction import covariance_of, inject, signatures_of

# σ taken off each normalised innovation before it is summed: half a drift of one σ, Page's choice.
_ALLOWANCE = 0.5
# A hypothesis older than this (s) says nothing of a drift that started since: it starts anew.
_OLDEST = 60.0
# A barred code comes back after it has agreed for this long (s) within this many squared σ.
_PROBATION = 30.0
_AGREEMENT = 9.0
# A code that fails the gate on its own needs less of the sum to be taken for one that drifted: 1 %, 1 dof.
_CONFIRMED = 6.63
# Codes that must remain: without one to spare nothing tells which satellite is wrong.
_LEAST_CODES = 4


@njit(cache=True, nogil=True)
def spread_signatures(state, channels, H, nu, R, status, information, acts_on, noise, white):
    """Take all open hypotheses through a measurement update that `joint_update` has just made.

    H: (m, n), nu: (m,), R: (m,), status: (m,) and information: (m, m) of that update; acts_on: (m,) channel
    whose drift is in row i itself, or −1; noise: (m,) index of an error that is replaced by the row's own
    noise of variance `white` (m²), or −1.
    """
    F = signatures_of(state, channels)
    m, n = H.shape
    now = state[SEC] + 1e-9 * state[NSEC]
    rows = np.empty(m, np.int64)
    count = 0
    for i in range(m):
        if status[i] == ACCEPTED:
            rows[count] = i
            count += 1
    if count == 0:
        return
    gain = np.zeros((0, 0))
    rho = np.empty(count)
    for a in range(channels):
        at = HEAD + a * CHANNEL_WIDTH
        if state[at + C_ONSET] == 0.0:
            continue
        if len(gain) == 0:
            # K = P⁺ Hᵀ R⁻¹
            gain = np.empty((n, count))
            gain_columns(covariance_of(state, channels), H, rows, count, gain)
            for c in range(count):
                for r in range(n):
                    gain[r, c] /= R[rows[c]]
        for c in range(count):
            i = rows[c]
            rho[c] = now - state[at + C_ONSET] if acts_on[i] == a else 0.0
            for k in range(n):
                h = H[i, k]
                if h != 0.0:
                    rho[c] -= h * F[a, k]
        for c in range(count):
            whitened = 0.0
            for d in range(count):
                whitened += information[rows[c], rows[d]] * rho[d]
            state[at + C_SCORE] += whitened * nu[rows[c]]
            state[at + C_INFORMATION] += whitened * rho[c]
            if noise[rows[c]] < 0:
                continue
            F[a, noise[rows[c]]] = white * whitened
        for c in range(count):
            kept = noise[rows[c]]
            value = F[a, kept] if kept >= 0 else 0.0
            for r in range(n):
                F[a, r] += gain[r, c] * rho[c]
            if kept >= 0:
                F[a, kept] = value


@njit(cache=True, nogil=True)
def clone_signatures(state, channels, lever_n):
    """Let the clone of antenna and clock have the signature of what it is now a copy of."""
    F = signatures_of(state, channels)
    for a in range(channels):
        if state[HEAD + a * CHANNEL_WIDTH + C_ONSET] == 0.0:
            continue
        f = F[a]
        f[CLONE] = f[POS] - lever_n[1] * f[ATT + 2] + lever_n[2] * f[ATT + 1]
        f[CLONE + 1] = f[POS + 1] - lever_n[2] * f[ATT] + lever_n[0] * f[ATT + 2]
        f[CLONE + 2] = f[POS + 2] - lever_n[0] * f[ATT + 1] + lever_n[1] * f[ATT]
        f[CLONE_CLK] = f[CLK]


@njit(cache=True, nogil=True)
def close_hypothesis(state, channels, channel):
    """Forget what was suspected of a channel."""
    at = HEAD + channel * CHANNEL_WIDTH
    for k in (C_PLUS, C_MINUS, C_ONSET, C_SCORE, C_INFORMATION):
        state[at + k] = 0.0
    signatures_of(state, channels)[channel, :] = 0.0


@njit(cache=True, nogil=True)
def open_hypotheses(state, channels, use, status, normalised, since):
    """Cumulate the normalised innovations of this epoch's codes; open or close hypotheses."""
    now = state[SEC] + 1e-9 * state[NSEC]
    for i in range(len(use)):
        if status[i] != ACCEPTED:
            continue
        at = HEAD + use[i] * CHANNEL_WIDTH
        state[at + C_PLUS] = max(0.0, state[at + C_PLUS] + normalised[i] - _ALLOWANCE)
        state[at + C_MINUS] = max(0.0, state[at + C_MINUS] - normalised[i] - _ALLOWANCE)
        plus, minus, onset = state[at + C_PLUS], state[at + C_MINUS], state[at + C_ONSET]
        own = plus if state[at + C_SIGN] > 0.0 else minus
        if onset > 0.0 and (own == 0.0 or now - onset > _OLDEST):
            signatures_of(state, channels)[use[i], :] = 0.0
            onset = 0.0
        if onset == 0.0:
            state[at + C_SCORE] = state[at + C_INFORMATION] = 0.0
            state[at + C_SIGN] = 1.0 if plus >= minus else -1.0
            if plus + minus > 0.0:
                # Before the first epoch that looks like it.
                onset = now - (since if since > 0.0 else 1.0)
            state[at + C_ONSET] = onset


@njit(cache=True, nogil=True)
def take_out_drift(state, channels, gate, used, use, status):
    """Decide on the hypotheses after an epoch with `used` codes; return the barred channel or −1.

    use: (m,) channels of the epoch's rows; status: (m,) what the update made of their codes.
    """
    if used <= _LEAST_CODES:
        return -1
    failed = np.zeros(channels, np.bool_)
    for i in range(len(use)):
        if use[i] >= 0 and status[i] == EXCLUDED:
            failed[use[i]] = True
    worst, largest = -1, 1.0
    for a in range(channels):
        at = HEAD + a * CHANNEL_WIDTH
        if state[at + C_KEY] == 0.0 or state[at + C_ONSET] == 0.0 or not state[at + C_INFORMATION] > 0.0:
            continue
        value = state[at + C_SCORE] ** 2 / state[at + C_INFORMATION]
        value /= min(gate, _CONFIRMED) if failed[a] else gate
        if value > largest:
            worst, largest = a, value
    if worst < 0:
        return -1
    at = HEAD + worst * CHANNEL_WIDTH
    P = covariance_of(state, channels)
    n = P.shape[0]
    f = signatures_of(state, channels)[worst].copy()
    information = state[at + C_INFORMATION]
    inject(state, channels, -state[at + C_SCORE] / information * f)
    for r in range(n):
        for c in range(r, n):
            P[r, c] += f[r] * f[c] / information
            P[c, r] = P[r, c]
    # The same error was in the innovations that the others were judged by.
    for a in range(channels):
        close_hypothesis(state, channels, a)
    state[at + C_BARRED], state[at + C_AGREED] = 1.0, 0.0
    return worst


@njit(cache=True, nogil=True)
def admit_again(state, channels, H, nu, R, dx, use, status, since):
    """Let barred codes back that have agreed for long enough with what all others say."""
    P = covariance_of(state, channels)
    n = P.shape[0]
    for i in range(len(use)):
        if use[i] < 0 or status[i] != UNUSED or not math.isfinite(nu[i]):
            continue
        at = HEAD + use[i] * CHANNEL_WIDTH
        if state[at + C_BARRED] == 0.0:
            continue
        left, variance = nu[i], R[i]
        for r in range(n):
            h = H[i, r]
            if h != 0.0:
                left -= h * dx[r]
                for c in range(n):
                    variance += h * P[r, c] * H[i, c]
        state[at + C_AGREED] = state[at + C_AGREED] + since if left * left < _AGREEMENT * variance else 0.0
        if state[at + C_AGREED] >= _PROBATION:
            state[at + C_BARRED] = state[at + C_AGREED] = 0.0
