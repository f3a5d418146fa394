# SPDX-License-Identifier: Apache-2.0
"""24 simulated hours per estimator: memory, time per sample, covariances; writes docs/results/soak.svg."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor

from matplotlib.figure import Figure
from workspace_harness.make_bags import root
from workspace_harness.soak import COURSES, Course, Soak, soak

from bag_tools.bench import Options, Row

PACKAGE = 'workspace_harness'
_HOURS, _QUICK_HOURS = 24.0, 0.2
_PARTS = 24
# What an allocator may keep back; one float64 leaked per second of 100 Hz input would be 70 MB in a day.
_GROWTH = 2.0  # MB
_SLOWDOWN = 1.1


def _curve(runs: list[Soak]) -> None:
    figure = Figure(figsize=(8.0, 6.0), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True)
    for run in runs:
        hours = [sum(p.hours for p in run.parts[: i + 1]) for i in range(len(run.parts))]
        above.plot(hours, [p.memory - run.parts[0].memory for p in run.parts], label=run.course.name)
        (line,) = below.plot(hours, [1e6 * p.seconds_per_sample for p in run.parts])
        fresh = [1e6 * p.fresh_seconds_per_sample for p in run.parts]
        below.plot(hours, fresh, ':', color=line.get_color())
    above.set_ylabel('memory since the first hour [MB]')
    above.legend(fontsize='x-small', ncols=2)
    below.set(xlabel='simulated time [h]', ylabel='processor time per message [µs]', yscale='log')
    below.set_title('dotted: a fresh estimator in the same minutes', fontsize='small')
    path = root() / 'docs' / 'results' / 'soak.svg'
    figure.savefig(path, metadata={'Date': None})


def measure(options: Options) -> Iterable[Row]:
    """Yield three rows per estimator."""
    hours = _QUICK_HOURS if options.quick else _HOURS
    runs = []
    # A process for each: memory that one estimator leaves behind is not the next one's growth.
    pool = ProcessPoolExecutor(
        os.cpu_count(), mp_context=multiprocessing.get_context('spawn'), max_tasks_per_child=1
    )
    with pool:
        waiting = [pool.submit(soak, course, hours, _PARTS) for course in COURSES]
        for course, future in zip(COURSES, waiting):
            runs.append(future.result())
            yield from _rows(course, runs[-1], hours)
    if not options.quick:
        _curve(runs)


def _rows(course: Course, run: Soak, hours: float) -> Iterable[Row]:
    name = f'{course.name}, {hours:g} h'
    yield Row(PACKAGE, f'{name}: growth of memory', run.growth, 'MB', bar=_GROWTH)
    first = 1e6 * run.parts[0].seconds_per_sample
    yield Row(
        PACKAGE,
        f'{name}: time per message over that of a fresh one, last third over first',
        run.slowdown,
        '',
        bar=_SLOWDOWN,
        reference={'first hour [µs]': first, 'messages': float(run.samples)},
    )
    yield Row(PACKAGE, f'{name}: outputs with a bad covariance', run.bad, 'outputs', bar=0)
