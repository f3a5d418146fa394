# SPDX-License-Identifier: Apache-2.0
"""Loose coupling with fixes whose errors last: what their states are worth against taking them as white."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ins_gps.estimator import InsGpsEstimator
from ins_gps.evaluation import evaluate, filter_params
from ins_gps.params import FilterParams
from ins_gps.samples import NavigationEstimate, PositionSample
from ins_gps.simulation import DGPS, MEMS, STANDALONE, ErrorBudget, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import displaced, error_of

_SCENARIO = Scenario(trajectory='s_turns', duration=300.0, imu_rate=20.0)
_SETTLED = 60.0  # s
_SIGMA = np.array([1.5, 1.5, 3.0])  # m NED, of a receiver's fix
_TIME = 60.0  # s


@dataclass(frozen=True, slots=True)
class Outcome:
    """Position after a minute: mean NEES (3 expected) and rms error (m)."""

    nees: float
    rms: float


def _outcome(nees: list[float], squares: list[float]) -> Outcome:
    return Outcome(float(np.mean(nees)), float(np.sqrt(np.mean(squares))))


def own_fixes(budget: ErrorBudget, white: bool, seeds: int) -> Outcome:
    """Return what loose coupling of raw observations makes of errors that last, or taken as `white`."""
    correlated = replace(budget, white=False)
    params = filter_params(correlated, mode='loose')
    if white:
        total = math.sqrt(params.code_noise**2 + params.code_slow**2 + params.code_multipath**2)
        params = replace(params, code_noise=total, code_slow=0.0, code_slow_alone=0.0, code_multipath=0.0)
    nees, squares = [], []
    for seed in range(seeds):
        result = evaluate(simulate(replace(_SCENARIO, budget=correlated), seed), params, seed)
        late = result.after(_SETTLED)
        nees.append(result.nees(slice(0, 3))[late].mean())
        squares.append(np.mean(result.position[late] ** 2))
    return _outcome(nees, squares)


def receiver_fixes(fix_time: float, seeds: int) -> Outcome:
    """Return what MEMS and a receiver give, whose positions err for a minute but for a white 10 %."""
    params = filter_params(DGPS, MEMS, mode='loose', alignment='velocity', fix_time=fix_time)
    nees, squares = [], []
    for seed in range(seeds):
        run = simulate(replace(_SCENARIO, imu_rate=50.0, imu=MEMS), seed)
        samples = list(_positions(run, np.random.default_rng(seed)))
        for estimate in _estimates(params, run, samples):
            index = int(np.searchsorted(run.stamps, estimate.stamp))
            error = error_of(np.r_[estimate.geodetic, estimate.velocity, estimate.q_nb], run.truth[index])[:3]
            nees.append(error @ np.linalg.solve(estimate.covariance[:3, :3], error))
            squares.append(error @ error)
    return _outcome(nees, squares)


def _positions(run, rng) -> Iterator[PositionSample]:
    """Yield a fix per second."""
    decay, white = math.exp(-1.0 / _TIME), 0.1
    lasting = rng.standard_normal(3)
    for i in range(0, len(run.stamps), 50):
        error = _SIGMA * (math.sqrt(1.0 - white) * lasting + math.sqrt(white) * rng.standard_normal(3))
        lasting = decay * lasting + math.sqrt(1.0 - decay**2) * rng.standard_normal(3)
        geodetic = displaced(run.truth[i], np.r_[error, np.zeros(6)])[:3]
        yield PositionSample(int(run.stamps[i]), geodetic, np.diag(_SIGMA**2))


def _estimates(params: FilterParams, run, samples) -> Iterator[NavigationEstimate]:
    """Yield an estimate per second once it is settled."""
    estimator = InsGpsEstimator(params)
    for sample in sorted([*run.imu_samples(), *samples], key=lambda s: s.stamp):
        position = type(sample) is PositionSample
        for out in (estimator.on_position(sample) if position else estimator.on_imu(sample)) or []:
            seconds = (out.stamp - run.stamps[0]) * 1e-9
            if type(out) is NavigationEstimate and seconds > _SETTLED and seconds % 1.0 < 0.01:
                yield out


BUDGETS = {'corrected': DGPS, 'alone': STANDALONE}
