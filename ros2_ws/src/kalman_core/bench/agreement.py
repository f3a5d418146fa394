# SPDX-License-Identifier: Apache-2.0
"""Largest relative differences of the kernels to filterpy over random models."""

from __future__ import annotations

import numpy as np
from filterpy.common import van_loan_discretization
from filterpy.kalman import KalmanFilter

from kalman_core.error_state import discretise
from kalman_core.linear import correct_sequential, filter_series, predict, update, update_scalar
from kalman_core.smoother import rts


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a random covariance (n, n) whose eigenvalues span two decades."""
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return basis @ np.diag(10.0 ** rng.uniform(-1.0, 1.0, n)) @ basis.T


def difference(actual, expected) -> float:
    """Return the largest difference, relative to the largest entry of `expected` (or to 1 below that)."""
    return float(np.max(np.abs(actual - expected)) / max(1.0, np.max(np.abs(expected))))


def largest_errors(seeds: int) -> dict[str, float]:
    """Return, by kernel, the largest difference over `seeds` random models."""
    worst: dict[str, float] = {}
    for seed in range(seeds):
        for name, error in one_model(np.random.default_rng(seed)).items():
            worst[name] = max(error, worst.get(name, 0.0))
    return worst


def one_model(rng: np.random.Generator) -> dict[str, float]:
    """Return, by kernel, the difference to filterpy on one random model."""
    n, m = 6, 3
    F = rng.standard_normal((n, n))
    F *= 0.95 / np.max(np.abs(np.linalg.eigvals(F)))
    Q, P, R = covariance(rng, n), covariance(rng, n), np.diag(rng.uniform(0.1, 1.0, m))
    H, x, z = rng.standard_normal((m, n)), rng.standard_normal(n), rng.standard_normal((40, m))
    peer = KalmanFilter(dim_x=n, dim_z=m)
    peer.x, peer.P, peer.F, peer.Q, peer.H, peer.R = x.copy(), P.copy(), F, Q, H, R
    errors = {}

    def compare(name, x1, P1, x2, P2):
        errors[name] = max(errors.get(name, 0.0), difference(x1, x2), difference(P1, P2))

    x1, P1 = x.copy(), P.copy()
    predict(x1, P1, F, Q)
    peer.predict()
    compare('prediction', x1, P1, peer.x, peer.P)
    before = x1.copy(), P1.copy()
    peer.update(z[0])
    update(x1, P1, z[0], H, R, np.inf)
    compare('vector update', x1, P1, peer.x, peer.P)
    x1, P1 = before[0].copy(), before[1].copy()
    correct_sequential(x1, P1, z[0] - H @ x1, H, np.diag(R).copy(), np.inf)
    compare('sequential update', x1, P1, peer.x, peer.P)
    x1, P1 = before[0].copy(), before[1].copy()
    for i in range(m):
        update_scalar(x1, P1, z[0, i], H[i], R[i, i], np.inf)
    compare('scalar updates', x1, P1, peer.x, peer.P)

    filtered = filter_series(x, P, z, F, Q, H, R)
    peer.x, peer.P = x.copy(), P.copy()
    for k in range(len(z)):
        peer.predict()
        peer.update(z[k])
        compare('series', filtered.x[k], filtered.P[k], peer.x, peer.P)
    smoothed = rts(filtered, F, Q)
    xs, Ps, _, _ = peer.rts_smoother(filtered.x, filtered.P)
    compare('smoother', smoothed.x, smoothed.P, xs, Ps)
    G = rng.standard_normal((n, 2))
    Phi, Qd = discretise(F, G @ G.T, 0.1)
    expected = van_loan_discretization(F, G, 0.1)
    compare('discretisation', Phi, Qd, *expected)
    return errors
