# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from bag_tools.bag import BagWriter, zeroed
from ins_gps import codec
from ins_gps.evaluation import paper_scenario
from ins_gps.scenarios import truth_estimate
from ins_gps.simulation import DGPS, HG1700, NANOSECONDS, Clock, Fault, Outage, Run, Scenario
from ins_gps.simulation_gnss import simulate

_IMU, _GNSS, _TRUTH = '/imu/data_raw', '/gnss/observations', '/truth/odometry'
_TRUTH_EVERY = 10  # IMU samples; score interpolates
START = 1_767_225_600 * NANOSECONDS  # 2026-01-01


def write_run(path: Path, run: Run, delays: dict[int, int] | None = None) -> None:
    """Write a simulated run into a bag (mcap, zstd); `delays` (ns) of GNSS epochs by their index."""
    records: list[tuple[int, int, Any]] = [(s.stamp, 0, s) for s in run.imu_samples()]
    records += [
        (epoch.stamp + (delays or {}).get(index, 0), 1, epoch) for index, epoch in enumerate(run.epochs)
    ]
    for index in range(0, len(run.stamps), _TRUTH_EVERY):
        records.append((int(run.stamps[index]), 2, truth_estimate(run, index)))
    records.sort(key=lambda record: record[:2])
    imu, cloud, odometry = zeroed(codec.IMU), zeroed(codec.CLOUD), zeroed(codec.ODOMETRY)
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        bag.add(_IMU, codec.IMU)
        bag.add(_GNSS, codec.CLOUD)
        bag.add(_TRUTH, codec.ODOMETRY)
        for time, kind, sample in records:
            if kind == 0:
                codec.encode_imu(sample, imu)
                bag.write(_IMU, time, imu)
            elif kind == 1:
                codec.encode_observations(sample, cloud)
                bag.write(_GNSS, time, cloud)
            else:
                codec.encode_odometry(sample, odometry)
                bag.write(_TRUTH, time, odometry)


def _paper(path: Path) -> None:
    # The paper's satellites and budget with DGPS, a tenth of its IMU rate, half of its length.
    scenario = paper_scenario(
        duration=250.0,
        imu_rate=20.0,
        imu=HG1700,
        budget=replace(DGPS, white=True),
        clock=Clock(),
        trajectory='constant',
    )
    write_run(path, simulate(scenario, 7))


_TURNS = Scenario(trajectory='s_turns', duration=120.0, imu_rate=50.0, start=START)


def _outage(path: Path) -> None:
    budget = replace(DGPS, white=False)
    write_run(path, simulate(replace(_TURNS, budget=budget, outages=(Outage(70.0, 90.0, 2),)), 11))


def _faults(path: Path) -> None:
    """A jump, a ramp and cycle slips, and epochs that arrive up to 0.4 s late and out of order."""
    faults = (
        Fault('jump', 2, 40.0, 20.0, 55.0),
        Fault('ramp', 4, 70.0, 1.0, 90.0),
        Fault('slip', 1, 95.0, 1.0),
        Fault('slip', 3, 105.0, -2.0),
    )
    run = simulate(replace(_TURNS, faults=faults, imu_rate=25.0), 12)
    delays = {k: round((0.1 + 0.3 * abs(math.sin(k))) * NANOSECONDS) for k in range(20, 110)}
    write_run(path, run, delays)


FIXTURES: dict[str, Callable[[Path], None]] = {
    'gnss_paper': _paper,
    'gnss_outage': _outage,
    'gnss_faults': _faults,
}
