# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools sweep``: many runs of an estimator, over parameters, bags and simulator seeds."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools import rosargs
from bag_tools.align import CONSTANTS
from bag_tools.bag import BagError
from bag_tools.cli import Progress, guarded
from bag_tools.registry import find_ports
from bag_tools.score import SOLVE_HELP
from bag_tools.sweep_plan import (
    Scoring,
    Source,
    Task,
    choices,
    find_bags,
    parse_dof,
    parse_grid,
    parse_range,
    parse_seeds,
    plan,
)
from bag_tools.sweep_run import Runner, complete, on_dask, serial
from bag_tools.sweep_store import Store
from bag_tools.sweep_task import Row, objective, simulation
from bag_tools.sweep_tune import tune
from kalman_core.parameters import build

# Sets with the smallest objective that are printed.
_SHOWN = 10


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog='sweep',
        description='Run an estimator over parameters, bags and simulator seeds; on all cores by default.',
        epilog='Fixed parameters follow --ros-args: -p name:=value, --params-file f.yaml. A sweep that was '
        'stopped goes on when the same command is given again.',
    )
    p.add_argument('package', help='package of the estimator, for example imu_kalman')
    p.add_argument('estimator', help='its name, for example attitude_estimator')
    p.add_argument('out', type=Path, help='folder of the results (results.parquet)')
    source = p.add_mutually_exclusive_group(required=True)
    source.add_argument('--bags', nargs='+', metavar='BAG', help='bags, or folders with bags below them')
    source.add_argument(
        '--simulate', metavar='MODULE:FUNCTION', help='function (seed, path) that writes a bag'
    )
    p.add_argument('--seeds', default='0:10', help='seeds of --simulate: first:end or a,b,c (default 0:10)')
    p.add_argument(
        '--grid', nargs='+', default=[], metavar='NAME=A,B', help='values; all combinations are run'
    )
    p.add_argument(
        '--random', nargs='+', default=[], metavar='NAME=LOW:HIGH[:log]', help='ranges to draw from'
    )
    p.add_argument('--samples', type=int, default=20, help='random parameter sets (default 20)')
    p.add_argument('--random-seed', type=int, default=0, help='seed of --random and --optimise')
    p.add_argument('--estimate', default='', help='estimate topic to score')
    p.add_argument('--truth', default='', help='truth topic of the bag; without one only NIS and counts')
    p.add_argument('--field', help='field path in the estimate')
    p.add_argument('--truth-field', help='field path in the truth')
    p.add_argument('--after', type=float, default=0.0, help='s after the first truth from which to score')
    p.add_argument('--where', help='Bool topic: score only while it is true')
    p.add_argument('--solve', nargs='+', choices=CONSTANTS, default=(), metavar='CONSTANT', help=SOLVE_HELP)
    p.add_argument('--objective', choices=('rmse', 'nis'), help='rank parameter sets by this')
    p.add_argument('--component', default='norm', help='error component of rmse, for example inclination')
    p.add_argument(
        '--dof', nargs='+', default=[], metavar='TOPIC=N', help='sensors of nis: degrees of freedom'
    )
    p.add_argument(
        '--optimise', nargs='+', default=[], metavar='NAME=LOW:HIGH[:log]', help='tune within these'
    )
    p.add_argument('--evaluations', type=int, default=100, help='parameter sets that tuning may try (100)')
    p.add_argument('--scheduler', default='', metavar='ADDRESS', help='Dask scheduler, tcp://host:port')
    p.add_argument('--workers', type=int, default=0, help='processes on this machine (default: all cores)')
    p.add_argument('--serial', action='store_true', help='one run after the other, in this process')
    return p


def _check(o: argparse.Namespace, fixed: dict[str, Any]) -> None:
    """Raise what can be known to be wrong before the first run."""
    ports = find_ports(o.package, o.estimator)
    build(ports.params, fixed)
    names = {r.name for r in map(parse_range, [*o.random, *o.optimise])} | set(parse_grid(o.grid))
    known = {field.name for field in dataclasses.fields(ports.params)}
    if unknown := sorted(names - known):
        raise BagError(f"unknown parameter '{unknown[0]}'; known: {', '.join(sorted(known))}")
    if bool(o.truth) != bool(o.estimate):
        raise BagError('--truth and --estimate go together')
    if o.objective == 'rmse' and not o.truth:
        raise BagError('--objective rmse needs --truth and --estimate')
    if o.objective == 'nis' and not o.dof:
        raise BagError('--objective nis needs --dof topic=degrees of freedom of each sensor')
    if o.optimise and not o.objective:
        raise BagError('--optimise needs --objective')
    if o.optimise and (o.grid or o.random):
        raise BagError('--optimise chooses the parameters itself: leave out --grid and --random')
    if min(o.samples, o.evaluations) < 1 or o.workers < 0:
        raise BagError('--samples and --evaluations are 1 or more, --workers 0 or more')
    if importlib.util.find_spec('pyarrow') is None:
        raise BagError('results are Parquet: the package pyarrow is missing; ./ws sweep installs it')


def _sources(o: argparse.Namespace) -> list[Source]:
    if o.bags:
        return find_bags(o.bags)
    simulation(o.simulate)
    return [Source(simulation=o.simulate, seed=seed) for seed in parse_seeds(o.seeds)]


@contextmanager
def _runner(o: argparse.Namespace) -> Iterator[Runner]:
    if o.serial:
        yield serial
        return
    with on_dask(o.scheduler, o.workers) as (run, _):
        yield run


def _mean(rows: Sequence[Row], o: argparse.Namespace) -> float:
    dof = parse_dof(o.dof)
    return float(np.mean([objective(row, o.objective, o.component, dof) for row in rows]))


def _optimise(
    o: argparse.Namespace, sources: list[Source], scoring: Scoring, fixed: dict, store: Store, run: Runner
) -> list[Task]:
    """Tune, print the result and return every task that was run."""
    tasks: list[Task] = []

    def evaluate(sets: list[dict[str, Any]]) -> list[float]:
        wanted = plan(o.package, o.estimator, sources, sets, scoring, fixed)
        tasks.extend(wanted)
        rows = complete(wanted, store, run)
        # plan() goes through the sources, and for each through the sets.
        values = [_mean(rows[k :: len(sets)], o) for k in range(len(sets))]
        print(f'{len({t.key for t in tasks})} runs, best of this generation {min(values):.4g}', flush=True)
        return values

    tuned = tune([parse_range(t) for t in o.optimise], evaluate, o.evaluations, o.random_seed)
    print(f'{o.objective}: {tuned.before:.4g} as given, {tuned.value:.4g} tuned')
    for name, value in tuned.params.items():
        print(f'-p {name}:={value:.6g}')
    return list({task.key: task for task in tasks}.values())


def _ranking(o: argparse.Namespace, tasks: list[Task], rows: list[Row], swept: set[str]) -> str:
    by_set: dict[tuple, list[Row]] = {}
    for task, row in zip(tasks, rows):
        chosen = tuple((n, str(v)) for n, v in task.params.items() if n in swept)
        by_set.setdefault(chosen, []).append(row)
    ranked = sorted((_mean(group, o), chosen) for chosen, group in by_set.items())
    lines = [f'{o.objective:>12}  parameters']
    for value, chosen in ranked[:_SHOWN]:
        lines.append(f'{value:12.4g}  ' + ' '.join(f'{n}={v}' for n, v in chosen))
    return '\n'.join(lines)


def run(argv: list[str]) -> int:
    """Sweep as the command line says; 1 when a run failed."""
    own, ros = rosargs.split(argv)
    o = _parser().parse_args(own)
    arguments = rosargs.parse(ros)
    fixed = rosargs.estimator_parameters(arguments, arguments.node or o.estimator)
    _check(o, fixed)
    sources = _sources(o)
    scoring = Scoring(o.estimate, o.truth, o.field, o.truth_field, o.after, o.where, tuple(o.solve))
    store = Store(o.out)
    with _runner(o) as runner:
        if o.optimise:
            tasks = _optimise(o, sources, scoring, fixed, store, runner)
        else:
            grid = parse_grid(o.grid)
            ranges = [parse_range(t) for t in o.random]
            sets = choices(grid, ranges, o.samples, o.random_seed)
            tasks = plan(o.package, o.estimator, sources, sets, scoring, fixed)
            with Progress('sweep', len(tasks)) as progress:
                rows = complete(tasks, store, runner, progress.update)
            if o.objective:
                print(_ranking(o, tasks, rows, {*grid, *(r.name for r in ranges)}))
    failed = [row for task in tasks if (row := store.get(task)) and row['error']]
    for text in dict.fromkeys(row['error'] for row in failed):
        print(f'sweep: {text}', file=sys.stderr)
    print(f'{len(tasks)} runs, {len(failed)} failed: {store.write_table(tasks)}')
    return 1 if failed else 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('sweep', run, argv)


if __name__ == '__main__':
    sys.exit(main())
