# SPDX-License-Identifier: Apache-2.0
"""Linear Kalman filter kernels: prediction, gated correction in Joseph form, batch filter.

All kernels work in place on ``x`` (n,) and ``P`` (n, n), symmetric. Zeros in ``F`` and ``H`` are skipped,
so sparse models cost what their entries cost. The covariance is always formed as a congruence of the old
one plus a positive semi-definite term (``A P Aᵀ + Q``), both halves averaged: it stays symmetric to the last
bit, and positive semi-definite as long as double precision can tell R from H P Hᵀ (ratios down to 1e-12).

A correction is skipped, and says so by its NIS, when the NIS exceeds `gate`, is not finite, or S is not
positive definite (NIS is then NaN): the sample was used exactly if ``nis <= gate`` and NIS is finite.

Sources: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
5.2; Bucy and Joseph (1968) for the covariance update; Bierman (1977) for sequential scalar updates.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def symmetrize(P):
    """Replace P (n, n) by ½(P + Pᵀ) in place."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i + 1, n):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean


@njit(cache=True, nogil=True)
def cholesky(S, L):
    """Write the lower Cholesky factor of S (m, m) into L; return False if S is not positive definite."""
    m = S.shape[0]
    for i in range(m):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not (total > 0.0 and total < np.inf):
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
                L[j, i] = 0.0
    return True


@njit(cache=True, nogil=True)
def cholesky_solve(L, B):
    """Replace B (m, k) by ``(L Lᵀ)⁻¹ B`` in place; a zero on the diagonal of L drops that component."""
    m = L.shape[0]
    columns = B.shape[1]
    for i in range(m):
        inverse = 1.0 / L[i, i] if L[i, i] != 0.0 else 0.0
        for j in range(i):
            factor = L[i, j]
            if factor != 0.0:
                for c in range(columns):
                    B[i, c] -= factor * B[j, c]
        for c in range(columns):
            B[i, c] *= inverse
    for i in range(m - 1, -1, -1):
        inverse = 1.0 / L[i, i] if L[i, i] != 0.0 else 0.0
        for j in range(i + 1, m):
            factor = L[j, i]
            if factor != 0.0:
                for c in range(columns):
                    B[i, c] -= factor * B[j, c]
        for c in range(columns):
            B[i, c] *= inverse


@njit(cache=True, nogil=True)
def propagate_covariance(P, F, Q):
    """Replace P (n, n) by ``F P Fᵀ + Q`` in place; P and Q are taken as symmetric (Q: its upper half)."""
    n = P.shape[0]
    product = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    product[i, j] += f * P[k, j]
    # P is symmetric, so (F P)ᵀ = P Fᵀ: transposed, the second product also runs along rows.
    for i in range(n):
        for j in range(i + 1, n):
            product[i, j], product[j, i] = product[j, i], product[i, j]
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.0
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    P[i, j] += f * product[k, j]
    # The mean of both halves, not one of them mirrored: the rounding of the first product enters one half
    # more than the other, and mirroring lets it grow until P is indefinite.
    for i in range(n):
        P[i, i] += Q[i, i]
        for j in range(i + 1, n):
            mean = 0.5 * (P[i, j] + P[j, i]) + Q[i, j]
            P[i, j] = mean
            P[j, i] = mean


@njit(cache=True, nogil=True)
def predict(x, P, F, Q):
    """Advance in place: ``x = F x``, ``P = F P Fᵀ + Q``. Inputs (control) are added to x by the caller."""
    n = x.size
    moved = np.zeros(n)
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                moved[i] += f * x[k]
    for i in range(n):  # an element-wise copy compiles in a tenth of the time of a slice's
        x[i] = moved[i]
    propagate_covariance(P, F, Q)


@njit(cache=True, nogil=True)
def innovation_covariance(P, H, R):
    """Return ``S = H P Hᵀ + R`` (m, m)."""
    return _project(P, H, R)[1]


@njit(cache=True, nogil=True)
def _project(P, H, R):
    """Return ``H P`` (m, n) and ``S = H P Hᵀ + R`` (m, m), S symmetric."""
    m, n = H.shape
    HP = np.zeros((m, n))
    for i in range(m):
        for k in range(n):
            h = H[i, k]
            if h != 0.0:
                for j in range(n):
                    HP[i, j] += h * P[k, j]
    S = np.empty((m, m))
    for i in range(m):
        for j in range(i, m):
            total = R[i, j]
            for k in range(n):
                h = H[j, k]
                if h != 0.0:
                    total += HP[i, k] * h
            S[i, j] = total
            S[j, i] = total
    return HP, S


@njit(cache=True, nogil=True)
def normalized_square(innovation, S):
    """Return the NIS ``νᵀ S⁻¹ ν`` of an innovation (m,), or NaN if S (m, m) is not positive definite."""
    m = innovation.size
    L = np.zeros((m, m))
    if not cholesky(S, L):
        return np.nan
    return _whitened_square(innovation, L)


@njit(cache=True, nogil=True)
def _whitened_square(innovation, L):
    m = innovation.size
    white = np.empty(m)
    total = 0.0
    for i in range(m):
        value = innovation[i]
        for k in range(i):
            value -= L[i, k] * white[k]
        white[i] = value / L[i, i]
        total += white[i] * white[i]
    return total


@njit(cache=True, nogil=True)
def correct(x, P, innovation, H, R, gate=np.inf):
    """Correct x and P in place with an innovation (m,) already formed (extended and error-state filters).

    H (m, n) is the measurement's Jacobian, R (m, m) its noise covariance, `gate` the largest NIS that is
    used. Returns (S, nis).
    """
    n = x.size
    m = innovation.size
    gain_t, S = _project(P, H, R)
    L = np.zeros((m, m))
    if not cholesky(S, L):
        return S, np.nan
    nis = _whitened_square(innovation, L)
    if not (nis <= gate and nis < np.inf):
        return S, nis
    cholesky_solve(L, gain_t)  # Kᵀ = S⁻¹ H P
    A = np.eye(n)
    added = np.zeros((n, n))
    for i in range(m):
        for a in range(n):
            k = gain_t[i, a]
            x[a] += k * innovation[i]
            if k != 0.0:
                for b in range(n):
                    A[a, b] -= k * H[i, b]
    for i in range(m):
        for j in range(m):
            r = R[i, j]
            if r != 0.0:
                for a in range(n):
                    for b in range(a, n):
                        added[a, b] += gain_t[i, a] * r * gain_t[j, b]
    propagate_covariance(P, A, added)
    return S, nis


@njit(cache=True, nogil=True)
def update(x, P, z, H, R, gate=np.inf):
    """Correct x and P in place with a linear measurement ``z = H x + noise`` (m,).

    Returns (innovation, S, nis); see `correct`.
    """
    m, n = H.shape
    innovation = np.empty(m)
    for i in range(m):
        total = z[i]
        for k in range(n):
            total -= H[i, k] * x[k]
        innovation[i] = total
    S, nis = correct(x, P, innovation, H, R, gate)
    return innovation, S, nis


@njit(cache=True, nogil=True)
def correct_scalar(x, P, innovation, h, r, gate=np.inf):
    """Correct x and P in place with one scalar innovation; h (n,) is its Jacobian, r its variance.

    Returns (s, nis): the innovation's variance and its normalised square.
    """
    n = x.size
    gain = np.zeros(n)
    for k in range(n):
        if h[k] != 0.0:
            for j in range(n):
                gain[j] += h[k] * P[k, j]
    s = r
    for k in range(n):
        s += h[k] * gain[k]
    if not (s > 0.0 and s < np.inf):
        return s, np.nan
    nis = innovation * innovation / s
    if not (nis <= gate and nis < np.inf):
        return s, nis
    A = np.eye(n)
    added = np.empty((n, n))
    for a in range(n):
        gain[a] /= s
        x[a] += gain[a] * innovation
        for b in range(n):
            A[a, b] -= gain[a] * h[b]
    for a in range(n):
        for b in range(a, n):
            added[a, b] = gain[a] * r * gain[b]
    propagate_covariance(P, A, added)
    return s, nis


@njit(cache=True, nogil=True)
def update_scalar(x, P, z, h, r, gate=np.inf):
    """Correct x and P in place with one scalar measurement ``z = h·x + noise``.

    Returns (innovation, s, nis); see `correct_scalar`.
    """
    innovation = z
    for k in range(x.size):
        innovation -= h[k] * x[k]
    s, nis = correct_scalar(x, P, innovation, h, r, gate)
    return innovation, s, nis


@njit(cache=True, nogil=True)
def correct_sequential(x, P, innovation, H, variances, gate=np.inf):
    """Correct x and P in place with uncorrelated innovations (m,), one component after the other.

    Equal to `correct` with ``R = diag(variances)`` but needs no factorisation, and `gate` (1 degree of
    freedom) judges each component alone. Returns (sequential innovations, their variances, their NIS),
    each (m,); the NIS of used components add up to that of the vector.
    """
    m, n = H.shape
    start = x.copy()
    used = np.empty(m)
    s = np.empty(m)
    nis = np.empty(m)
    for i in range(m):
        # The innovation was formed at the state before the first component moved it.
        value = innovation[i]
        for k in range(n):
            value -= H[i, k] * (x[k] - start[k])
        used[i] = value
        s[i], nis[i] = correct_scalar(x, P, value, H[i], variances[i], gate)
    return used, s, nis


class Filtered(NamedTuple):
    """A filtered series of N steps: predicted and corrected moments, innovations, their S and NIS."""

    x_predicted: np.ndarray
    x: np.ndarray
    P: np.ndarray
    innovation: np.ndarray
    S: np.ndarray
    nis: np.ndarray


def filter_series(x0, P0, z, F, Q, H, R, gate=math.inf):
    """Filter a series: per step predict, then update with the row of z (N, m); return `Filtered`.

    F and Q are (n, n), or (N, n, n) where entry k leads *to* step k. A row of z with a NaN is a missing
    measurement. `x0` and `P0` are the state before the first prediction.
    """
    z = np.ascontiguousarray(z, dtype=np.float64)
    x = np.array(x0, dtype=np.float64)
    P = np.array(P0, dtype=np.float64)
    H = np.ascontiguousarray(H, dtype=np.float64)
    R = np.ascontiguousarray(R, dtype=np.float64)
    return Filtered(*_filter_series(x, P, z, stack(F), stack(Q), H, R, gate))


def stack(matrices) -> np.ndarray:
    """Return (n, n) or (N, n, n) as a contiguous 3-d array; one matrix stands for all steps."""
    matrices = np.ascontiguousarray(matrices, dtype=np.float64)
    return matrices[np.newaxis] if matrices.ndim == 2 else matrices


@njit(cache=True, nogil=True)
def _filter_series(x, P, z, F, Q, H, R, gate):
    steps, m = z.shape
    n = x.size
    x_predicted = np.empty((steps, n))
    xs = np.empty((steps, n))
    Ps = np.empty((steps, n, n))
    innovations = np.empty((steps, m))
    Ss = np.empty((steps, m, m))
    nis = np.empty(steps)
    for k in range(steps):
        predict(x, P, F[k if F.shape[0] > 1 else 0], Q[k if Q.shape[0] > 1 else 0])
        for i in range(n):
            x_predicted[k, i] = x[i]
        innovation, S, nis[k] = update(x, P, z[k], H, R, gate)
        for i in range(m):
            innovations[k, i] = innovation[i]
            for j in range(m):
                Ss[k, i, j] = S[i, j]
        for i in range(n):
            xs[k, i] = x[i]
            for j in range(n):
                Ps[k, i, j] = P[i, j]
    return x_predicted, xs, Ps, innovations, Ss, nis
