# SPDX-License-Identifier: Apache-2.0
"""A sweep of 200 runs on workers against the same one after the other: equal rows, and the speed-up."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from bag_tools.bench import Options, Row
from bag_tools.sweep_plan import Scoring, Source, Task, choices, plan
from bag_tools.sweep_run import Runner, complete, on_dask, serial
from bag_tools.sweep_store import Store
from bag_tools.sweep_task import Row as Result
from bag_tools.sweep_task import run_task

PACKAGE = 'workspace_harness'
_SEEDS, _QUICK_SEEDS = 50, 2
_NOISES = [0.01, 0.02, 0.05, 0.1]  # m/s²/√Hz
_WORKERS = 2


def _tasks(seeds: int) -> list[Task]:
    simulation = 'workspace_harness.simulations:imu_hand_held'
    sources = [Source(simulation=simulation, seed=seed) for seed in range(seeds)]
    sets = choices({'accel_noise': _NOISES})
    scoring = Scoring('imu/data', '/truth/orientation', after=5.0)
    return plan('imu_kalman', 'attitude_estimator', sources, sets, scoring, {})


def _timed(tasks: list[Task], folder: Path, run: Runner) -> tuple[float, list[Result]]:
    started = time.perf_counter()
    rows = complete(tasks, Store(folder), run)
    return time.perf_counter() - started, rows


def _warm(run: Runner, tasks: list[Task]) -> None:
    """Let every worker load its kernels: that is a matter of the first minute, not of the sweep."""
    for _ in run(tasks):
        pass


def _pooled(tasks: list[Task], workers: int) -> float:
    with ProcessPoolExecutor(workers, mp_context=get_context('spawn')) as pool:
        list(pool.map(run_task, tasks[: 2 * workers]))  # loads the kernels
        started = time.perf_counter()
        list(pool.map(run_task, tasks))
        return time.perf_counter() - started


def _ceiling(tasks: list[Task]) -> float:
    """Return what the machine allows: bare processes side by side over one of them.

    Two cores that share their units, as those of many virtual machines do, are not twice one.
    """
    return _pooled(tasks, 1) / _pooled(tasks, _WORKERS)


def measure(options: Options) -> Iterable[Row]:
    """Yield the number of rows that differ and the speed-up on two workers."""
    if not options.live:
        return
    tasks = _tasks(_QUICK_SEEDS if options.quick else _SEEDS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _warm(serial, tasks[:1])
        alone, expected = _timed(tasks, folder / 'serial', serial)
        with on_dask(workers=min(_WORKERS, os.cpu_count() or 1)) as (run, _):
            _warm(run, tasks[: 2 * _WORKERS])
            together, rows = _timed(tasks, folder / 'dask', run)
    ceiling = _ceiling(tasks[: 4 if options.quick else 60])
    differing = sum(a != b for a, b in zip(rows, expected, strict=True))
    yield Row(PACKAGE, f'sweep of {len(tasks)} runs: rows unlike the serial run', differing, 'rows', bar=0)
    yield Row(
        PACKAGE,
        f'sweep of {len(tasks)} runs: speed-up on {_WORKERS} workers',
        alone / together,
        '',
        bar=1.8,
        better='higher',
        reference={'of this machine': ceiling, 'serial [s]': alone},
    )
