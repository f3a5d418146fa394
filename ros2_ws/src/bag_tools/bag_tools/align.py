# SPDX-License-Identifier: Apache-2.0
"""Constants that lie between an estimate and the truth of another device: mounting, heading, lag.

    truth(t) = Rz(heading) ⊗ estimate(t + lag) ⊗ mounting

Two devices on one body are seldom mounted alike, need not agree on north, and stamp by their own clocks. What
is solved here from both is no longer part of the error.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from bag_tools.bag import BagError
from bag_tools.errors import (
    DELAY_SPAN,
    at,
    delay,
    euler_angles,
    quat_conjugate,
    quat_multiply,
    rotation_matrices,
)
from bag_tools.series import Array, Series

MOUNTING, HEADING, LAG = 'mounting', 'heading', 'lag'
CONSTANTS = (MOUNTING, HEADING, LAG)

Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]

# The lag is searched on at most so many samples: a correlation costs samples times shifts.
_LAG_SAMPLES = 20_000
# A search that solves the rotation anew for each lag is dearer.
_SEARCH_SAMPLES = 4_000
# Coarse search: a quarter of a period of the fastest motion (5 Hz) that a body of some kilograms makes.
_SEARCH_STEP = 0.05  # s
_SEARCH_TOLERANCE = 1e-4  # s
# Below this the errors of the tilt itself, some tenths of a degree, turn the mounting about the vertical.
_LEAST_TILT = np.radians(2.0)
_FEWEST = 8  # samples


@dataclass(frozen=True, slots=True)
class Solved:
    """What was solved; None for what was not asked for.

    mounting: wxyz, the truth's body axes in those of the estimate. heading: rad, anticlockwise from the
    estimate to the truth. lag: s, positive when the estimate is late.
    """

    mounting: tuple[float, float, float, float] | None = None
    heading: float | None = None
    lag: float | None = None

    def __str__(self) -> str:
        parts = []
        if self.mounting is not None:
            roll, pitch, yaw = np.degrees(euler_angles(np.array([self.mounting]))[0])
            numbers = ', '.join(f'{v:.4g}' for v in self.mounting)
            parts.append(f'mounting roll {roll:.2f}°, pitch {pitch:.2f}°, yaw {yaw:.2f}° (wxyz {numbers})')
        if self.heading is not None:
            parts.append(f'heading {np.degrees(self.heading):.2f}°')
        if self.lag is not None:
            parts.append(f'lag {self.lag * 1e3:.1f} ms')
        return ', '.join(parts)


def correlated_lag(estimate: Series, truth: Series, counts: Callable[[Stamps], Mask]) -> float | None:
    """Return the lag (s) of best correlation over the longest stretch both cover; None without motion."""
    start = max(estimate.stamps[0], truth.stamps[0])
    stop = min(estimate.stamps[-1], truth.stamps[-1])
    if len(estimate.stamps) < _FEWEST or len(truth.stamps) < _FEWEST or stop <= start:
        return None
    step = float(max(np.median(np.diff(estimate.stamps)), np.median(np.diff(truth.stamps)), 1.0))
    step = max(step, (stop - start) / _LAG_SAMPLES)
    grid = np.arange(start, stop, step).astype(np.int64)
    a, known_a = at(estimate, grid)
    b, known_b = at(truth, grid)
    known = known_a & known_b & counts(grid)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(np.int8)))
    if not len(edges):
        return None
    runs = edges.reshape(-1, 2)
    begin, end = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return delay(a[begin:end], b[begin:end], step * 1e-9, estimate.kind)


def solve(estimate: Series, truth: Series, what: Collection[str], counts: Callable[[Stamps], Mask]) -> Solved:
    """Solve the constants named in `what` over the stamps (ns) for which `counts` says so.

    The mounting turns the upward directions of the truth into those of the estimate with the least squared
    error (Wahba's problem, as scipy solves it): an estimate without a magnetometer, whose heading drifts, has
    one as well. The heading is the mean of what is left about the vertical. Both concern orientations; of
    other quantities only the lag is solved. Raises BagError when the motion does not tell.
    """
    if estimate.kind == 'orientation' and MOUNTING in what:
        _check_tilt(truth, counts)
    turns = estimate.kind == 'orientation' and bool({MOUNTING, HEADING} & set(what))
    lag = None
    if LAG in what:
        lag = (
            _searched_lag(estimate, truth, what, counts) if turns else correlated_lag(estimate, truth, counts)
        )
        if lag is None:
            raise BagError(
                f'{estimate.role}: too little moves to solve the lag, or it is beyond {DELAY_SPAN:g} s'
            )
    if not turns:
        return Solved(lag=lag)
    mine, reference = _pairs(estimate, truth, lag or 0.0, counts)
    if len(mine) < _FEWEST:
        raise BagError(f'{estimate.role}: no sample of the estimate lies where truth is known')
    mounting = heading = None
    if MOUNTING in what:
        rotation, _ = Rotation.align_vectors(_up(mine), _up(reference))
        solved = np.roll(rotation.as_quat(canonical=True), 1)
        mine = quat_multiply(mine, np.broadcast_to(solved, mine.shape))
        mounting = (float(solved[0]), float(solved[1]), float(solved[2]), float(solved[3]))
    if HEADING in what:
        heading = _mean_heading(mine, reference)
    return Solved(mounting, heading, lag)


def aligned(estimate: Series, solved: Solved, frame: str = 'world') -> Series:
    """Return the estimate on the clock and in the axes of the truth; its covariance (of `frame`) too."""
    if solved.lag is not None:
        estimate = replace(estimate, stamps=estimate.stamps - round(solved.lag * 1e9))
    values, covariance = estimate.values, estimate.covariance
    if solved.mounting is not None:
        mounting = np.broadcast_to(np.array(solved.mounting), values.shape)
        values = quat_multiply(values, mounting)
        if covariance is not None and frame == 'body':
            turn = Rotation.from_quat(np.roll(solved.mounting, -1)).inv().as_matrix()
            covariance = turn @ covariance @ turn.T
    if solved.heading is not None:
        half = 0.5 * solved.heading
        values = quat_multiply(np.broadcast_to([np.cos(half), 0.0, 0.0, np.sin(half)], values.shape), values)
        if covariance is not None and frame == 'world':
            turn = Rotation.from_rotvec([0.0, 0.0, solved.heading]).as_matrix()
            covariance = turn @ covariance @ turn.T
    return replace(estimate, values=values, covariance=covariance)


def _check_tilt(truth: Series, counts: Callable[[Stamps], Mask]) -> None:
    """Raise BagError where the body stays too level for its mounting about the vertical to show."""
    up = _up(truth.values[counts(truth.stamps)])
    # The second singular value is the spread about the mean direction, along the axis that tilts most.
    tilt = np.linalg.svd(up, compute_uv=False)[1] / np.sqrt(len(up)) if len(up) >= _FEWEST else 0.0
    if tilt < _LEAST_TILT:
        raise BagError(
            f'{truth.role}: the truth tilts by {np.degrees(tilt):.2g}° (RMS), '
            f'at least {np.degrees(_LEAST_TILT):g}° are needed to solve the mounting'
        )


def _pairs(
    estimate: Series, truth: Series, lag: float, counts: Callable[[Stamps], Mask]
) -> tuple[Array, Array]:
    """Return what both say at the same moments, with the estimate late by `lag` (s)."""
    stamps = estimate.stamps - round(lag * 1e9)
    reference, known = at(truth, stamps)
    known &= counts(stamps)
    return estimate.values[known], reference[known]


def _up(q: Array) -> Array:
    """Return the upward directions (n, 3) in body axes of (n, 4) wxyz attitudes."""
    return rotation_matrices(q)[:, 2]


def _mean_heading(estimate: Array, truth: Array) -> float:
    w, _, _, z = quat_multiply(truth, quat_conjugate(estimate)).T
    # Twice the angle of (w, z) does not depend on the sign of the quaternion.
    return float(np.angle(np.mean((w + 1j * z) ** 2)))


def _misfit(estimate: Array, truth: Array, what: Collection[str]) -> float:
    """Return the mean squared error (chords, no unit) that the best rotation leaves."""
    if MOUNTING in what:
        _, left = Rotation.align_vectors(_up(estimate), _up(truth))
        return float(left) ** 2 / len(estimate)
    half = 0.5 * _mean_heading(estimate, truth)
    turn = np.broadcast_to([np.cos(half), 0.0, 0.0, np.sin(half)], estimate.shape)
    return float(np.mean(1.0 - np.sum(quat_multiply(turn, estimate) * truth, axis=1) ** 2))


def _searched_lag(
    estimate: Series, truth: Series, what: Collection[str], counts: Callable[[Stamps], Mask]
) -> float | None:
    """Return the lag (s) with which the best rotation leaves least; None at the end of the span."""
    every = -(-len(estimate.stamps) // _SEARCH_SAMPLES)
    thin = replace(
        estimate, stamps=estimate.stamps[::every], values=estimate.values[::every], covariance=None
    )

    def misfit(lag: float) -> float:
        mine, reference = _pairs(thin, truth, lag, counts)
        return _misfit(mine, reference, what) if len(mine) >= _FEWEST else np.inf

    steps = round(DELAY_SPAN / _SEARCH_STEP)
    grid = _SEARCH_STEP * np.arange(-steps, steps + 1)
    found = np.array([misfit(lag) for lag in grid])
    best = int(np.argmin(found))
    if best in (0, len(grid) - 1) or not np.isfinite(found[best]):
        return None
    around = (grid[best - 1], grid[best + 1])
    return float(
        minimize_scalar(misfit, bounds=around, method='bounded', options={'xatol': _SEARCH_TOLERANCE}).x
    )
