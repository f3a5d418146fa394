# SPDX-License-Identifier: Apache-2.0
"""Time of the filter against peers in the same run: ratios, never absolute times, are compared."""

from __future__ import annotations

import time

import numpy as np
from filterpy.kalman import KalmanFilter

from ins_gps.batch import run_batch
from ins_gps.evaluation import START_SIGMAS, filter_params
from ins_gps.filter import NavigationFilter
from ins_gps.simulation import DGPS, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.strapdown import mechanise_series


def _best(function, repeats: int = 3) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def measure_speed(duration: float) -> dict[str, float]:
    """Return times real time of the whole filter, and time per step of mechanisation and dense filter."""
    run = simulate(Scenario(trajectory='s_turns', duration=duration), 0)
    params = filter_params(DGPS)

    def whole():
        navigation = NavigationFilter(params)
        navigation.initialise(int(run.stamps[0]), run.truth[0], START_SIGMAS, run.clock[0])
        run_batch(navigation, run.stamps[1:], run.rate, run.force, run.epochs)

    whole()
    out = {'times real time': duration / _best(whole)}
    steps = len(run.rate)
    nav = run.truth[0].copy()
    mechanise_series(nav, run.rate[:10], run.force[:10], 0.01)
    out['mechanisation'] = _best(lambda: mechanise_series(nav, run.rate, run.force, 0.01)) / steps
    dense = KalmanFilter(dim_x=18, dim_z=6)
    dense.F = np.eye(18) + 1e-3 * np.ones((18, 18))
    dense.H = np.eye(6, 18)
    count = 500

    def dense_run():
        for k in range(count):
            dense.predict()
            if k % 100 == 0:
                dense.update(np.zeros(6))

    out['filterpy'] = _best(dense_run) / count
    out['own step'] = duration / out['times real time'] / steps
    out['pyins'] = _pyins(run)
    return out


def _pyins(run) -> float:
    """Return the time per step (s) of python-ins' mechanisation, NaN where it is not installed."""
    try:
        from pyins import sim, strapdown
    except ImportError:
        return float('nan')
    trajectory, imu = sim.generate_sine_velocity_motion(
        0.01, 20.0, [21, 105, 100], [10, 0, 0], 5, 30, sensor_type='increment'
    )

    def integrate():
        increments = strapdown.compute_increments_from_imu(imu, 'increment')
        strapdown.Integrator(trajectory.iloc[0]).integrate(increments)

    integrate()
    return _best(integrate) / len(imu)
