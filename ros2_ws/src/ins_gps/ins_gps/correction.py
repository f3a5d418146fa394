# SPDX-License-Identifier: Apache-2.0
"""The joint measurement update with exclusion that all measurements of the filter go through.

Each candidate is judged by its *leave-one-out* innovation: the deviation from what prediction and all other
measurements of the epoch say, divided by its σ. With w = S⁻¹ν it is w_i/√(S⁻¹)_ii (Baarda's normalised
residual, with the prediction as further observations). So one wrong satellite is seen even where the
prediction alone is poor, for example while the clock drift is unknown.
Source: Teunissen, "Quality control in integrated navigation systems" (1990).
"""

import numpy as np
from numba import njit

from kalman_core.linear import cholesky

UNUSED = 0
ACCEPTED = 1
EXCLUDED = 2


@njit(cache=True, nogil=True)
def gain_columns(P, H, rows, count, out):
    """Fill out[:, :count] with ``P H[rows]ᵀ``; zeros of H are skipped."""
    n = P.shape[0]
    for c in range(count):
        i = rows[c]
        for r in range(n):
            out[r, c] = 0.0
        for k in range(n):
            h = H[i, k]
            if h != 0.0:
                for r in range(n):
                    out[r, c] += P[k, r] * h


@njit(cache=True, nogil=True)
def joint_update(P, H, nu, R, status, gate, dx, normalised, information):
    """Update P (n, n) and fill dx (n,) with the measurements whose status is ACCEPTED on entry.

    H: (m, n), nu: (m,) innovations, R: (m,) variances. status: (m,) in UNUSED or ACCEPTED; what fails the
    `gate` (on the square of the leave-one-out innovation) becomes EXCLUDED, worst first, until all fit.
    normalised: (m,) out, leave-one-out
    innovations in σ. information: (m, m) out, ``S⁻¹`` of what was used, zero elsewhere.
    Returns (NIS of what was used, number used); (0, 0) if nothing was.
    """
    n = P.shape[0]
    m = len(nu)
    dx[:] = 0.0
    information[:, :] = 0.0
    rows = np.empty(m, np.int64)
    columns = np.empty((n, m))
    while True:
        count = 0
        for i in range(m):
            if status[i] == ACCEPTED:
                rows[count] = i
                count += 1
        if count == 0:
            return 0.0, 0
        gain_columns(P, H, rows, count, columns)
        S = np.zeros((count, count))
        for c in range(count):
            i = rows[c]
            for k in range(n):
                h = H[i, k]
                if h != 0.0:
                    for d in range(count):
                        S[c, d] += h * columns[k, d]
        for c in range(count):
            S[c, c] += R[rows[c]]
            for d in range(c):
                mean = 0.5 * (S[c, d] + S[d, c])
                S[c, d] = mean
                S[d, c] = mean
        L = np.zeros((count, count))
        if not cholesky(S, L):
            for c in range(count):
                status[rows[c]] = EXCLUDED
            return 0.0, 0
        # Rows of X = L⁻¹; S⁻¹ = Xᵀ X.
        X = np.zeros((count, count))
        for c in range(count):
            X[c, c] = 1.0 / L[c, c]
            for d in range(c):
                total = 0.0
                for k in range(d, c):
                    total -= L[c, k] * X[k, d]
                X[c, d] = total / L[c, c]
        white = np.zeros(count)
        nis = 0.0
        for c in range(count):
            for d in range(c + 1):
                white[c] += X[c, d] * nu[rows[d]]
            nis += white[c] * white[c]
        worst, largest = -1, gate
        for c in range(count):
            w = 0.0
            inverse = 0.0
            for k in range(c, count):
                w += X[k, c] * white[k]
                inverse += X[k, c] * X[k, c]
            value = w / np.sqrt(inverse)
            normalised[rows[c]] = value
            if not value * value <= largest:
                worst, largest = c, value * value
        if worst < 0:
            break
        status[rows[worst]] = EXCLUDED
    for r in range(n):
        for c in range(count - 1, -1, -1):
            total = 0.0
            for k in range(c + 1):
                total += X[c, k] * columns[r, k]
            columns[r, c] = total  # columns are now P Hᵀ L⁻ᵀ: row c of X needs only entries up to c
            dx[r] += total * white[c]
    for r in range(n):
        for s in range(r, n):
            total = P[r, s]
            for c in range(count):
                total -= columns[r, c] * columns[s, c]
            P[r, s] = total
            P[s, r] = total
    for r in range(n):
        if P[r, r] < 0.0:
            P[r, r] = 0.0
    for c in range(count):
        for d in range(count):
            total = 0.0
            for k in range(max(c, d), count):
                total += X[k, c] * X[k, d]
            information[rows[c], rows[d]] = total
    return nis, count
