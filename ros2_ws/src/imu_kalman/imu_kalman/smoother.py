# SPDX-License-Identifier: Apache-2.0
"""Forward-backward smoother: the attitude filter's own kernels, then Rauch, Tung and Striebel backwards.

The forward pass keeps, for each block, the covariance after the updates, the sums the transition is made of
and the correction the updates made. Backwards, with x the error state, P- and P+ the covariance before and
after the updates of a block, u its correction and phi its transition,

    d_k = C_k (u_{k+1} + d_{k+1}),  C_k = P+_k phi' (P-_{k+1})^-1,
    S_k = P+_k + C_k (S_{k+1} - P-_{k+1}) C_k',

d being what is still to be added to the filtered state. Within a block d moves linearly from the start,
where it is d_k, to the end before the update, where it is u_{k+1} + d_{k+1}. Nothing is carried back over a
restart. Memory: about 1 kB per block, 22 kB per second at the default block.

Source: Rauch, Tung and Striebel (1965); Crassidis and Junkins, "Optimal Estimation of Dynamic Systems"
(2011), 5.1 and 7.2, for its use on an error state.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from imu_kalman.attitude_batch import AttitudeArrays, feed_fields, feed_inertial, prepare
from imu_kalman.attitude_kernel import carried
from imu_kalman.attitude_layout import (
    BIAS,
    BROKEN,
    CORRECTION,
    COUNT,
    COV,
    DELAY_VAR,
    HEADING_VAR,
    LINK,
    LINKED,
    PHASE,
    PHI,
    PRIOR,
    RATE,
    RESTARTED,
    RIGID,
    ROT,
    SPAN,
    STARTED,
    STATE,
    VECTORS,
    WAITING,
    WORK,
    N,
    Q,
    pack,
)
from imu_kalman.attitude_linear import transition, turn, whole_turn
from imu_kalman.params import AttitudeParams

_PAIRS = N * (N + 1) // 2
# What one record holds: covariance before and after the updates (lower triangles), the correction, the
# transition's ingredients (span, integral of the rotation) and the bias after the updates.
_BEFORE = 0
_AFTER = _PAIRS
_CORRECTION = 2 * _PAIRS
_SUMS = _CORRECTION + N
_BIAS = _SUMS + 10
_LINK = _BIAS + 3
_RECORD = _LINK + 1
# Smoothed: correction to the filtered state, covariance of attitude (upper triangle).
_SMOOTHED = N + 6


@njit(cache=True, nogil=True)
def _pack_triangle(matrix, out):
    k = 0
    for i in range(N):
        for j in range(i + 1):
            out[k] = matrix[i, j]
            k += 1


@njit(cache=True, nogil=True)
def _unpack_triangle(packed, matrix):
    k = 0
    for i in range(N):
        for j in range(i + 1):
            matrix[i, j] = packed[k]
            matrix[j, i] = packed[k]
            k += 1


@njit(cache=True, nogil=True)
def _record(state, work, record):
    """Keep what the backward pass needs of a block that has just closed (or of a start)."""
    _pack_triangle(work[PRIOR], record[_BEFORE:_AFTER])
    _pack_triangle(state[COV:].reshape(N, N), record[_AFTER:_CORRECTION])
    record[_CORRECTION:_SUMS] = work[VECTORS, CORRECTION]
    phi = work[PHI]
    record[_SUMS] = phi[8, 6]
    for i in range(3):
        for j in range(3):
            record[_SUMS + 1 + 3 * i + j] = -phi[i, 3 + j]
    record[_BIAS:_LINK] = state[BIAS : BIAS + 3]
    record[_LINK] = work[VECTORS, LINK, 0]


@njit(cache=True, nogil=True)
def forward(state, par, data, records, attitude, place, part):
    """Run the filter and keep a record per start and per block.

    Fills attitude (n, 4) before it is carried forward, `place` (n,), the last record at each row (-1: not
    started), and `part` (n,), the time (s) since that record. Returns the number of records.
    """
    work = np.zeros((WORK, N, N))
    field = 0
    count = 0
    for i in range(data.gyr.shape[0]):
        if data.usable[i]:
            code = feed_inertial(state, par, work, data, i)
            started = code in (STARTED, RESTARTED)
            if started:
                work[VECTORS, LINK, 0] = BROKEN
            if started or (state[PHASE] != 0.0 and code != WAITING and state[COUNT] == 0.0):
                _record(state, work, records[count])
                count += 1
        for k in range(4):
            attitude[i, k] = state[Q + k]
        place[i] = count - 1 if state[PHASE] != 0.0 else -1
        part[i] = state[SPAN]
        field = feed_fields(state, par, data, field, data.field_end[i])
    return count


@njit(cache=True, nogil=True)
def _factor(matrix):
    """Replace the lower triangle of a symmetric matrix by its Cholesky factor; False if not definite."""
    for i in range(N):
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                matrix[i, i] = math.sqrt(s)
            else:
                matrix[i, j] = s / matrix[j, j]
    return True


@njit(cache=True, nogil=True)
def _solve(factor, b):
    """Solve ``(L L') x = b`` in place for the columns of `b` (N, N)."""
    for i in range(N):
        inverse = 1.0 / factor[i, i]
        for k in range(i):
            s = factor[i, k]
            for c in range(N):
                b[i, c] -= s * b[k, c]
        for c in range(N):
            b[i, c] *= inverse
    for i in range(N - 1, -1, -1):
        inverse = 1.0 / factor[i, i]
        for k in range(i + 1, N):
            s = factor[k, i]
            for c in range(N):
                b[i, c] -= s * b[k, c]
        for c in range(N):
            b[i, c] *= inverse


@njit(cache=True, nogil=True)
def _times_transition(phi, cov, out):
    """Fill ``out = phi cov``, skipping what is zero in phi."""
    for i in range(N):
        for c in range(N):
            out[i, c] = cov[i, c]
    for i in range(3):
        for k in range(3, 6):
            s = phi[i, k]
            for c in range(N):
                out[i, c] += s * cov[k, c]
    for i in range(6, N):
        for k in range(6):
            s = phi[i, k]
            for c in range(N):
                out[i, c] += s * cov[k, c]
    for i in range(8, N):
        s = phi[i, i - 2]
        for c in range(N):
            out[i, c] += s * cov[i - 2, c]


@njit(cache=True, nogil=True)
def backward(records, count, smoothed):
    """Fill `smoothed` (count, N + 6): correction to the filtered state and covariance of attitude."""
    sums = np.zeros(STATE)
    phi = np.empty((N, N))
    before = np.empty((N, N))
    after = np.empty((N, N))
    gain_t = np.empty((N, N))
    half = np.empty((N, N))
    cov = np.empty((N, N))
    _unpack_triangle(records[count - 1, _AFTER:_CORRECTION], cov)
    smoothed[count - 1, :N] = 0.0
    _attitude_triangle(cov, smoothed[count - 1, N:])
    for k in range(count - 2, -1, -1):
        record = records[k]
        following = records[k + 1]
        _unpack_triangle(record[_AFTER:_CORRECTION], after)
        _unpack_triangle(following[_BEFORE:_AFTER], before)
        if following[_LINK] == RIGID:
            _carry_back(following, smoothed[k + 1], smoothed[k])
            _attitude_triangle(cov, smoothed[k, N:])
            continue
        for i in range(N):
            for j in range(N):
                # The change of the covariance that is carried back, while `before` is not yet factored.
                cov[i, j] -= before[i, j]
        if following[_LINK] == BROKEN or not _factor(before):
            smoothed[k, :N] = 0.0
            cov[:] = after
        else:
            sums[SPAN] = following[_SUMS]
            for i in range(9):
                sums[ROT + i] = following[_SUMS + 1 + i]
            transition(sums, phi)
            _times_transition(phi, after, gain_t)
            _solve(before, gain_t)
            for i in range(N):
                s = 0.0
                for j in range(N):
                    s += gain_t[j, i] * (following[_CORRECTION + j] + smoothed[k + 1, j])
                smoothed[k, i] = s
            for i in range(N):
                half[i, :] = 0.0
                for j in range(N):
                    s = gain_t[j, i]
                    for c in range(N):
                        half[i, c] += s * cov[j, c]
            for i in range(N):
                for c in range(i + 1):
                    s = after[i, c]
                    for j in range(N):
                        s += half[i, j] * gain_t[j, c]
                    cov[i, c] = s
                    cov[c, i] = s
        _attitude_triangle(cov, smoothed[k, N:])


@njit(cache=True, nogil=True)
def _carry_back(following, later, earlier):
    """Carry a correction back over a block of the alignment, which turned the whole of local level.

    What is known later turns the past alike, and the bias found later turns it by its own integral.
    """
    earlier[:N] = 0.0
    turned = np.zeros(3)
    for i in range(3):
        earlier[3 + i] = following[_CORRECTION + 3 + i] + later[3 + i]
    for i in range(3):
        for j in range(3):
            turned[i] += following[_SUMS + 1 + 3 * i + j] * earlier[3 + j]
    state = np.zeros(STATE)
    state[Q] = 1.0
    turn(state, turned[0], turned[1], turned[2])
    turn(state, following[_CORRECTION], following[_CORRECTION + 1], following[_CORRECTION + 2])
    turn(state, later[0], later[1], later[2])
    whole_turn(state, np.array((1.0, 0.0, 0.0, 0.0)), earlier)


@njit(cache=True, nogil=True)
def _attitude_triangle(cov, out):
    k = 0
    for i in range(3):
        for j in range(i, 3):
            out[k] = cov[i, j]
            k += 1


@njit(cache=True, nogil=True)
def spread(par, data, records, count, smoothed, attitude, place, part, covariance, bias):
    """Correct every row by its place between two records; `attitude` is carried forward as the filter's.

    Fills `covariance` (n, 6) and `bias` (n, 3).
    """
    state = np.zeros(STATE)
    d = np.empty(_SMOOTHED)
    rate = np.zeros(3)
    for i in range(data.gyr.shape[0]):
        at = place[i]
        if at < 0:
            attitude[i] = np.nan
            continue
        share = 0.0
        if part[i] > 0.0 and at + 1 < count and records[at + 1, _LINK] == LINKED:
            share = part[i] / records[at + 1, _SUMS]
        for k in range(_SMOOTHED):
            d[k] = smoothed[at, k]
        if share > 0.0:
            for k in range(_SMOOTHED):
                end = smoothed[at + 1, k]
                if k < N:
                    end += records[at + 1, _CORRECTION + k]
                d[k] += share * (end - d[k])
        for k in range(4):
            state[Q + k] = attitude[i, k]
        turn(state, d[0], d[1], d[2])
        for k in range(3):
            bias[i, k] = records[at, _BIAS + k] + d[3 + k]
            if data.usable[i]:
                rate[k] = data.gyr[i, k]
            state[RATE + k] = rate[k] - bias[i, k]
        carried(state, par, attitude[i])
        lasting = par[DELAY_VAR] * (state[RATE] ** 2 + state[RATE + 1] ** 2 + state[RATE + 2] ** 2)
        for k in range(6):
            covariance[i, k] = d[N + k]
        covariance[i, 0] += lasting
        covariance[i, 3] += lasting
        covariance[i, 5] += lasting + par[HEADING_VAR]


def smooth(
    stamp: np.ndarray,
    gyr: np.ndarray,
    acc: np.ndarray,
    mag: np.ndarray | None = None,
    *,
    mag_stamp: np.ndarray | None = None,
    params: AttitudeParams | None = None,
) -> AttitudeArrays:
    """Estimate attitude at every inertial sample from the whole recording; arguments as `filter_batch`."""
    params = params if params is not None else AttitudeParams()
    par = pack(params)
    data = prepare(params, stamp, gyr, acc, mag, mag_stamp)
    n = len(data.gyr)
    out = AttitudeArrays(np.empty((n, 4)), np.full((n, 6), np.nan), np.full((n, 3), np.nan))
    if n == 0:
        return out
    # A block spans at least two thirds of its nominal length; a start adds a record.
    seconds = (data.sec[-1] - data.sec[0]) + (data.nanosec[-1] - data.nanosec[0]) * 1e-9
    most = min(n, int(1.5 * max(seconds, 0.0) / params.block) + 2)
    most += int(max(seconds, 0.0) / params.max_gap) + 1
    records = np.empty((most, _RECORD))
    place = np.empty(n, dtype=np.int64)
    part = np.empty(n)
    count = forward(np.zeros(STATE), par, data, records, out.orientation, place, part)
    if count == 0:
        out.orientation[:] = np.nan
        return out
    smoothed = np.empty((count, _SMOOTHED))
    backward(records, count, smoothed)
    spread(par, data, records, count, smoothed, out.orientation, place, part, out.covariance, out.bias)
    return out
