# SPDX-License-Identifier: Apache-2.0
"""Runs of the filter on simulated data against truth: errors, consistency, the paper's table, ablation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ins_gps.batch import run_batch
from ins_gps.channels import FAULT_GATE, GATE
from ins_gps.filter import NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.simulation import (
    DGPS,
    HG1700,
    PAPER_IMU,
    STANDALONE,
    Clock,
    ErrorBudget,
    ImuErrors,
    Run,
    Scenario,
)
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import displaced, error_of

START_SIGMAS = np.r_[[3.0] * 3, [0.3] * 3, np.radians([0.3, 0.3, 0.6])]  # m, m/s, rad
# The first seconds carry the start error, which no filter can remove before it has averaged.
SETTLED = 60.0  # s
SYSTEMS = ('ins', 'gps', 'loose', 'tight', 'proposed')
# Table 4 of paper 003: mean 3-D position error (m); for the INS the error at 500 s.
PRINTED = {'ins': 3718.0, 'gps': 99.52, 'loose': 65.66, 'tight': 34.52, 'proposed': 6.568}


def filter_params(budget: ErrorBudget, imu: ImuErrors = HG1700, **changes) -> FilterParams:
    """Return filter parameters that say of a simulation what is true of it; `changes` override."""
    if budget.white:
        code = {'code_noise': budget.total, 'code_slow': 0.0, 'code_slow_alone': 0.0, 'code_multipath': 0.0}
    else:
        code = {
            'code_noise': budget.receiver / math.sqrt(3.0),
            'code_slow': budget.slow,
            'code_slow_alone': budget.slow,
            'code_multipath': budget.multipath / math.sqrt(3.0),
        }
    values: dict[str, Any] = {
        'channels': 8,
        'gyro_noise': imu.gyro_noise,
        'accel_noise': imu.accel_noise,
        'gyro_bias_sigma': math.hypot(imu.gyro_bias, imu.gyro_offset),
        'accel_bias_sigma': math.hypot(imu.accel_bias, imu.accel_offset),
        'gyro_bias_walk': 0.0,
        'accel_bias_walk': 0.0,
        'carrier_noise': max(budget.carrier_noise, 1e-5),
        'carrier_walk': budget.carrier_walk,
        'doppler_noise': max(budget.doppler_noise, 1e-3),
        'multipath_time': budget.multipath_time,
        'elevation_weighting': False,
        'elevation_mask': -1.5,
        'alignment': 'given',
    }
    values.update(code)
    values.update(changes)
    return FilterParams(**values)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Errors (k, 9), covariances (k, 9, 9) and times (k,) s at the GNSS epochs of one run.

    fates: as in `History`.
    """

    times: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    navigation: NavigationFilter
    fates: list[np.ndarray]

    @property
    def position(self) -> np.ndarray:
        """3-D position error (k,) in m."""
        return np.linalg.norm(self.errors[:, :3], axis=1)

    @property
    def velocity(self) -> np.ndarray:
        """3-D velocity error (k,) in m/s."""
        return np.linalg.norm(self.errors[:, 3:6], axis=1)

    def after(self, start: float) -> np.ndarray:
        """Return the mask of epochs at or after `start` (s)."""
        return self.times >= start

    def nees(self, block: slice = slice(0, 9)) -> np.ndarray:
        """Return the normalised squared error (k,) of a block of the nine."""
        e = self.errors[:, block]
        return np.einsum(
            'ki,ki->k', e, np.linalg.solve(self.covariances[:, block, block], e[..., None])[..., 0]
        )

    def within(self, sigmas: float = 3.0) -> float:
        """Return the share of position components within so many σ."""
        spread = np.sqrt(np.einsum('kii->ki', self.covariances)[:, :3])
        return float(np.mean(np.abs(self.errors[:, :3]) <= sigmas * spread))


def evaluate(
    run: Run,
    params: FilterParams,
    seed: int,
    sigmas: np.ndarray = START_SIGMAS,
    *,
    exact: bool = False,
    gates: bool = True,
) -> Evaluation:
    """Run the filter on a simulated run from a start that is wrong by `sigmas` times a normal draw.

    With `exact` the start is right although the filter believes `sigmas`; without `gates` nothing is
    rejected.
    """
    navigation = NavigationFilter(params)
    if not gates:
        navigation.config[GATE] = navigation.config[FAULT_GATE] = math.inf
    start_wrong(navigation, run, seed, sigmas, exact=exact)
    history = run_batch(navigation, run.stamps[1:], run.rate, run.force, run.epochs)
    return compare(run, history, navigation)


def start_wrong(
    navigation: NavigationFilter, run: Run, seed: int, sigmas: np.ndarray, *, exact: bool = False
) -> None:
    """Start at a run's truth, wrong by `sigmas` (9,) times a normal draw (`exact`: by nothing)."""
    rng = np.random.default_rng([seed, 77])
    error = sigmas * (0.0 if exact else 1.0) * rng.standard_normal(9)
    clock = run.clock[0] + np.array([100.0, 3.0]) * rng.standard_normal(2)
    if navigation.params.mode != 'gps':
        start = displaced(run.truth[0], error)
        navigation.initialise(int(run.stamps[0]), start, sigmas, (clock[0], clock[1]), (100.0, 3.0))


def compare(run: Run, history, navigation: NavigationFilter) -> Evaluation:
    """Return the evaluation of a batch history against a run's truth."""
    index = np.searchsorted(run.stamps, history.stamps)
    index = np.minimum(index, len(run.stamps) - 1)
    errors = np.array([error_of(n, run.truth[i]) for n, i in zip(history.nav, index, strict=True)])
    times = (history.stamps - run.stamps[0]) * 1e-9
    return Evaluation(times, errors.reshape(-1, 9), history.covariance, navigation, history.fates)


def paper_scenario(**changes) -> Scenario:
    """Return the paper's scenario: its six satellites seen from 0°, 0°, five of them above the horizon."""
    base = Scenario(
        satellites='paper',
        origin=(0.0, 0.0, 100.0),
        imu=PAPER_IMU,
        clock=Clock(bias=5.0, drift=0.0, walk=0.03, drift_walk=0.0),
    )
    return replace(base, **changes)


def published_params(budget: ErrorBudget, mode: str) -> FilterParams:
    """Return the 10-state filter of the paper with noise that covers what it does not model."""
    return filter_params(
        budget,
        PAPER_IMU,
        mode=mode,
        states='published',
        # The sensors' offsets are not states: they are given to the process noise.
        accel_noise=0.05,
        gyro_noise=2e-4,
        clock_walk=1.0,
        published_rate_noise=0.1,
    )


def paper_systems(seed: int, duration: float = 500.0) -> dict[str, Evaluation]:
    """Return the five systems of the paper's table 4 on one seed.

    INS, GPS, loose and tight see the budget without DGPS and with SA, the proposed system the one with DGPS.
    All errors are white, as the printed rows show them to be.
    """
    exposed = replace(STANDALONE, selective_availability=100.0)
    plain = simulate(paper_scenario(budget=exposed, duration=duration), seed)
    corrected = simulate(paper_scenario(budget=DGPS, duration=duration), seed)
    modes = {'ins': 'ins', 'gps': 'gps', 'loose': 'loose', 'tight': 'tight_doppler'}
    # The table starts without error, but the filter is not told: its first fix could be as far off as GPS is.
    sigmas = np.r_[[100.0] * 3, [1.0] * 3, [0.01] * 3]
    out = {
        name: evaluate(plain, published_params(exposed, mode), seed, sigmas, exact=True)
        for name, mode in modes.items()
    }
    out['proposed'] = evaluate(corrected, published_params(DGPS, 'tight_tdcp'), seed, sigmas, exact=True)
    return out


def ablation(seed: int, duration: float = 500.0) -> dict[tuple[bool, bool, str, str], float]:
    """Return the mean 3-D error (m) for {SA} × {DGPS} × {code, Doppler, carrier} × {10, full states}.

    Errors are the correlated ones, so that each part shows what it really gives: constant per satellite
    cannot be averaged away.
    """
    out = {}
    exposed = replace(STANDALONE, white=False)
    budgets = {
        (False, False): exposed,
        (True, False): replace(exposed, selective_availability=100.0),
        (False, True): replace(DGPS, white=False),
    }
    for (sa, dgps), budget in budgets.items():
        run = simulate(paper_scenario(budget=budget, duration=duration), seed)
        for states in ('published', 'full'):
            for mode in ('tight_code', 'tight_doppler', 'tight_tdcp'):
                result = evaluate(run, _ablation_params(budget, mode, states), seed)
                settled = result.after(min(SETTLED, 0.5 * duration))
                out[sa, dgps, mode, states] = float(result.position[settled].mean())
                if dgps:
                    # The base sees the same dither: up to the age of the correction nothing of it is left.
                    out[True, True, mode, states] = out[sa, dgps, mode, states]
    return out


def _ablation_params(budget: ErrorBudget, mode: str, states: str) -> FilterParams:
    if states == 'published':
        return published_params(budget, mode)
    sa = budget.selective_availability / math.sqrt(3.0)
    params = filter_params(budget, PAPER_IMU, mode=mode)
    if sa == 0.0:
        return params
    # SA moves code and carrier alike: to the filter it is multipath of the code and a walk of the carrier.
    rate = sa / budget.availability_time
    # Its rate persists for the correlation time: the walk that spreads as far in that time.
    walk = rate * math.sqrt(2.0 * budget.availability_time)
    return replace(
        params,
        code_multipath=math.hypot(params.code_multipath, sa),
        multipath_time=budget.availability_time,
        carrier_walk=walk,
        doppler_noise=math.hypot(params.doppler_noise, walk),
    )
