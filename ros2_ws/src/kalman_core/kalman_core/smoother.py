# SPDX-License-Identifier: Apache-2.0
"""Rauch-Tung-Striebel smoothing: one step for any (also error-state) filter, and linear series.

The covariance is formed as a sum of positive semi-definite terms instead of the usual difference
``P + C (Pˢ - P⁻) Cᵀ``, which loses definiteness where the smoother gains most.

Sources: Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems" (1965); the
Joseph-like covariance follows by inserting ``P⁻ = F P Fᵀ + Q``.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from kalman_core.linear import Filtered, cholesky_solve, propagate_covariance, stack

# A pivot of P⁻ this small against its own diagonal entry is rounding: that direction is known exactly.
_PIVOT_FLOOR = 1e-14


@njit(cache=True, nogil=True)
def _semidefinite_cholesky(S, L):
    """Write a lower factor of the positive semi-definite S (n, n) into L (given as zeros).

    Columns of vanishing pivots stay zero, which `cholesky_solve` takes for directions to drop.
    """
    n = S.shape[0]
    for j in range(n):
        pivot = S[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > _PIVOT_FLOOR * S[j, j]:
            continue
        L[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]


@njit(cache=True, nogil=True)
def smoother_step(P, F, Q, dx_next, P_next):
    """Smooth the filtered covariance P (n, n) of step k, given the smoothed step k + 1.

    `F` and `Q` lead from k to k + 1, `dx_next` (n,) is smoothed minus *predicted* state at k + 1 (on a
    manifold: the error between the two) and `P_next` its smoothed covariance. Returns (dx, P_smoothed)
    with dx (n,) to be added to (injected into) the filtered state of step k.
    """
    n = P.shape[0]
    predicted = P.copy()
    propagate_covariance(predicted, F, Q)
    L = np.zeros((n, n))
    _semidefinite_cholesky(predicted, L)
    gain_t = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    gain_t[i, j] += f * P[k, j]
    cholesky_solve(L, gain_t)  # Cᵀ = (P⁻)⁻¹ F P
    dx = np.zeros(n)
    gain = np.empty((n, n))
    A = np.eye(n)
    total = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            gain[j, i] = gain_t[i, j]
            dx[j] += gain_t[i, j] * dx_next[i]
            total[i, j] = P_next[i, j] + Q[i, j]
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    A[j, k] -= gain_t[i, j] * f
    propagate_covariance(total, gain, np.zeros((n, n)))
    smoothed = P.copy()
    propagate_covariance(smoothed, A, total)
    return dx, smoothed


class Smoothed(NamedTuple):
    """Smoothed states (N, n) and their covariances (N, n, n)."""

    x: np.ndarray
    P: np.ndarray


def rts(filtered: Filtered, F, Q) -> Smoothed:
    """Smooth a filtered series backwards; F and Q as given to `filter_series`.

    Entry k of (N, n, n) stacks leads *to* step k. The predicted states in `filtered` carry control inputs
    and nonlinear predictions, so an extended filter is smoothed with the Jacobians it used.
    """
    x = np.array(filtered.x, dtype=np.float64)
    P = np.array(filtered.P, dtype=np.float64)
    _rts(x, P, np.ascontiguousarray(filtered.x_predicted), stack(F), stack(Q))
    return Smoothed(x, P)


@njit(cache=True, nogil=True)
def _rts(x, P, x_predicted, F, Q):
    for k in range(x.shape[0] - 2, -1, -1):
        step_F = F[k + 1 if F.shape[0] > 1 else 0]
        step_Q = Q[k + 1 if Q.shape[0] > 1 else 0]
        dx, smoothed = smoother_step(P[k], step_F, step_Q, x[k + 1] - x_predicted[k + 1], P[k + 1])
        for i in range(x.shape[1]):
            x[k, i] += dx[i]
            for j in range(x.shape[1]):
                P[k, i, j] = smoothed[i, j]
