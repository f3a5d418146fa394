# SPDX-License-Identifier: Apache-2.0
"""Figures of kalman_core: agreement with filterpy, speed as a ratio to it, cost of event time, consistency.

Times are the least of several runs in this process; ratios are formed of runs that alternate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from agreement import largest_errors
from event_cost import late_cost, overhead
from filterpy.kalman import KalmanFilter

from bag_tools.bench import Options, Row
from kalman_core.consistency import anees, chi2_band, nees
from kalman_core.linear import filter_series, predict, update
from kalman_core.smoother import rts

PACKAGE = 'kalman_core'
DEFAULT_SEEDS = 50
# What the workspace asks of its two-state filter; larger matrices are reported without a bar.
TWO_STATE_BAR = 20.0


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the processor time that `work` takes."""
    start = time.process_time()
    work()
    return time.process_time() - start


def least_times(first: Callable[[], object], second: Callable[[], object], runs: int) -> tuple[float, float]:
    """Return the least time (s) of each, measured in turns, so that both meet the same load."""
    pairs = [(cpu_seconds(first), cpu_seconds(second)) for _ in range(runs)]
    return min(a for a, _ in pairs), min(b for _, b in pairs)


def chain(n: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return F, Q, H, R of a stable model of n states coupled as a chain, m of them measured."""
    F = 0.95 * np.eye(n) + np.diag(np.full(n - 1, 0.05), 1)
    return F, 0.01 * np.eye(n), np.eye(m, n), 0.1 * np.eye(m)


def filterpy_series(F, Q, H, R, z) -> tuple[KalmanFilter, np.ndarray, np.ndarray]:
    """Run filterpy over z; return it with its states and covariances."""
    n, m = F.shape[0], H.shape[0]
    peer = KalmanFilter(dim_x=n, dim_z=m)
    peer.x, peer.P, peer.F, peer.Q, peer.H, peer.R = np.zeros(n), np.eye(n), F, Q, H, R
    xs, Ps = np.empty((len(z), n)), np.empty((len(z), n, n))
    for k, row in enumerate(z):
        peer.predict()
        peer.update(row)
        xs[k], Ps[k] = peer.x, peer.P
    return peer, xs, Ps


def speed_rows(n: int, m: int, steps: int, runs: int) -> Iterator[Row]:
    """Yield how many times faster than filterpy the series, the streaming calls and the smoother are."""
    F, Q, H, R = chain(n, m)
    z = np.random.default_rng(0).standard_normal((steps, m))

    def batch():
        return filter_series(np.zeros(n), np.eye(n), z, F, Q, H, R)

    def streaming():
        x, P = np.zeros(n), np.eye(n)
        for row in z:
            predict(x, P, F, Q)
            update(x, P, row, H, R, np.inf)

    def peer_filter():
        return filterpy_series(F, Q, H, R, z)

    filtered = batch()
    streaming()
    peer, xs, Ps = peer_filter()
    rts(filtered, F, Q)
    for label, ours, theirs in (
        ('series', batch, peer_filter),
        ('one call a step', streaming, peer_filter),
        ('smoother', lambda: rts(filtered, F, Q), lambda: peer.rts_smoother(xs, Ps)),
    ):
        mine, peers = least_times(ours, theirs, runs)
        name = f'{label}, {n} states, {m} measured: times as fast as filterpy'
        bar = TWO_STATE_BAR if label == 'series' and n == 2 else None
        reference = {'µs a step': 1e6 * mine / steps, 'filterpy µs': 1e6 * peers / steps}
        yield Row(PACKAGE, name, peers / mine, '×', bar, 'higher', reference)


def consistency_row(seeds: int) -> Row:
    """Return how far the mean NEES of a matched filter over `seeds` runs is from its expectation."""
    n, m, steps = 4, 2, 100
    F, Q, H, R = chain(n, m)
    final = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x = rng.standard_normal(n)
        z = np.empty((steps, m))
        for k in range(steps):
            x = F @ x + 0.1 * rng.standard_normal(n)
            z[k] = H @ x + np.sqrt(0.1) * rng.standard_normal(m)
        filtered = filter_series(np.zeros(n), np.eye(n), z, F, Q, H, R)
        final.append(nees(filtered.x[-1] - x, filtered.P[-1])[0])
    half = (chi2_band(0.95, n, seeds)[1] - n) / n
    name = 'NEES of a matched filter: |mean / dof − 1| against its 95 % band'
    return Row(PACKAGE, name, abs(anees(final, n) - 1.0), '', half, seeds=seeds)


def measure(options: Options) -> Iterator[Row]:
    """Yield all rows of the package."""
    seeds = options.seeds or (5 if options.quick else DEFAULT_SEEDS)
    if options.still:
        for kernel, error in largest_errors(seeds).items():
            name = f'{kernel}: largest relative difference to filterpy'
            yield Row(PACKAGE, name, error, '', 1e-12, seeds=seeds)
        yield consistency_row(seeds)
    if not options.live:
        return
    steps, runs = (200, 2) if options.quick else (2000, 7)
    for n, m in ((2, 1), (6, 3), (15, 6)):
        yield from speed_rows(n, m, steps, runs)
    samples = 5_000 if options.quick else 50_000
    name = 'event-time buffer in order, 20-element state: time a sample'
    yield Row(PACKAGE, name, 1e6 * overhead(samples), 'µs', 3.0)
    name = 'event-time buffer, a sample 100 ms late at 500 Hz: time a sample'
    yield Row(PACKAGE, name, 1e6 * late_cost(samples // 50), 'µs')
