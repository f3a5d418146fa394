# SPDX-License-Identifier: Apache-2.0
"""Scenarios by parameters, and truth in the form of an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ins_gps.params import SimulatorParams
from ins_gps.samples import NavigationEstimate
from ins_gps.simulation import (
    DGPS,
    HG1700,
    MEMS,
    NOISELESS,
    PAPER_IMU,
    PERFECT,
    STANDALONE,
    Outage,
    Run,
    Scenario,
)
from kalman_core.earth import ecef_from_geodetic, enu_from_ecef

_BUDGETS = {'dgps': DGPS, 'standalone': STANDALONE, 'noiseless': NOISELESS}
_IMUS = {'hg1700': HG1700, 'paper': PAPER_IMU, 'mems': MEMS, 'perfect': PERFECT}


def scenario_of(params: SimulatorParams, start: int) -> Scenario:
    """Return the scenario that a simulator's parameters describe, starting at `start` (ns)."""
    budget = replace(
        _BUDGETS[params.budget], white=params.white, selective_availability=params.selective_availability
    )
    outages: tuple[Outage, ...] = ()
    if params.outage_end > params.outage_start:
        outages = (Outage(params.outage_start, params.outage_end, params.outage_left),)
    base = Scenario(
        trajectory=params.trajectory,
        satellites=params.satellites,
        duration=params.duration,
        imu_rate=params.imu_rate,
        gnss_rate=params.gnss_rate,
        imu=_IMUS[params.imu],
        budget=budget,
        outages=outages,
    )
    if params.satellites == 'paper':
        # Its orbits belong to one second of the week: stamps keep that time.
        return replace(base, origin=(0.0, 0.0, 100.0))
    return replace(base, start=start)


def restamped(run: Run, start: int) -> Run:
    """Return the run with all stamps moved so that it begins at `start` (ns)."""
    shift = start - int(run.stamps[0])
    epochs = [epoch._replace(stamp=epoch.stamp + shift) for epoch in run.epochs]
    return replace(run, stamps=run.stamps + shift, epochs=epochs)


def truth_estimate(run: Run, index: int) -> NavigationEstimate:
    """Return the truth at IMU stamp `index` as an estimate without error, origin at the start."""
    nav, origin = run.truth[index], run.truth[0, :3]
    enu = enu_from_ecef(ecef_from_geodetic(nav[0], nav[1], nav[2]), origin[0], origin[1], origin[2])
    rate = run.true_rate[max(index - 1, 0)]
    return NavigationEstimate(
        int(run.stamps[index]), nav[:3], origin, enu, nav[3:6], nav[6:10], rate, np.zeros((9, 9))
    )
