# SPDX-License-Identifier: Apache-2.0
"""One run of a sweep: from a task to one row of plain numbers. Runs in a worker as well as here."""

from __future__ import annotations

import importlib
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagError, resolve
from bag_tools.offline import OfflineResult, offline
from bag_tools.registry import find_ports
from bag_tools.score import Comparison, Subject, read_window, score
from bag_tools.sweep_plan import Scoring, Source, Task
from kalman_core.parameters import ParameterError

Row = dict[str, Any]


def simulation(name: str) -> Callable[[int, Path], None]:
    """Return the function 'module:function' that writes a bag from a seed; raise BagError."""
    module, _, function = name.partition(':')
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError):
        raise BagError(f"simulation '{name}' is not there; expected module:function(seed, path)") from None


def _bag_of(source: Source, folder: Path) -> Path:
    if source.bag:
        return Path(source.bag)
    assert source.seed is not None
    path = folder / 'in.mcap'
    simulation(source.simulation)(source.seed, path)
    return path


def _scores(comparisons: list[Comparison]) -> Row:
    row: Row = {}
    for comparison in comparisons:
        result = comparison.score
        for c in result.components:
            row[f'rmse.{result.role}.{c.name}'] = c.rmse
            row[f'max.{result.role}.{c.name}'] = c.max
            if c.nees is not None:
                row[f'nees_per_dof.{result.role}.{c.name}'] = c.nees
    return row


def _health(result: OfflineResult) -> Row:
    row: Row = {'restarts': result.tally.restart_count}
    for name, sensor in sorted(result.tally.sensors.items()):
        row[f'accepted.{name}'] = sensor.accepted
        row[f'rejected.{name}'] = sum(sensor.rejected.values())
    for name, health in sorted(result.health.items()):
        row[f'nis.{name}'] = float(np.mean(health.nis))
    return row


def _scored(scoring: Scoring, bag: Path, out: Path) -> Row:
    where = Subject(bag, scoring.where) if scoring.where else None
    return _scores(
        score(
            Subject(out, resolve(scoring.estimate), scoring.field),
            Subject(bag, resolve(scoring.truth), scoring.truth_field),
            read_window(scoring.after, math.inf, where),
            constants=scoring.solve,
        )
    )


def run_task(task: Task) -> Row:
    """Run `task`; the row is a function of the task alone. What the user can mend stands in `error`."""
    row: Row = {
        'key': task.key,
        'package': task.package,
        'estimator': task.estimator,
        'bag': task.source.bag,
        'simulation': task.source.simulation,
        'seed': task.source.seed,
        **{f'param.{name}': value for name, value in task.params.items()},
        'error': '',
    }
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            bag = _bag_of(task.source, folder)
            result = offline(find_ports(task.package, task.estimator), task.params, bag, folder / 'out.mcap')
            row['outputs'] = sum(result.outputs.values())
            row |= _health(result)
            if task.scoring.truth:
                row |= _scored(task.scoring, bag, folder / 'out.mcap')
    except (BagError, ParameterError) as error:
        row['error'] = ' '.join(str(error).split())
    return row


def objective(row: Row, kind: str, component: str, dof: dict[str, int]) -> float:
    """Return what tuning makes small; inf for a run that failed.

    ``rmse``: that of `component`, in its unit. ``nis``: the root mean square over the sensors in `dof` of
    ln(NIS / degrees of freedom), which is 0 when every innovation is as large as the filter says
    (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 5.4.2).
    """
    if row['error']:
        return math.inf
    if kind == 'rmse':
        found = [v for k, v in row.items() if k.startswith('rmse.') and k.endswith(f'.{component}')]
        if not found:
            known = sorted({k.rsplit('.', 1)[1] for k in row if k.startswith('rmse.')})
            raise BagError(f"no error component '{component}'; the score has: {', '.join(known) or 'none'}")
        return float(found[0])
    logs = []
    for sensor, degrees in dof.items():
        nis = row.get(f'nis.{sensor}')
        if nis is None:
            known = sorted(k.removeprefix('nis.') for k in row if k.startswith('nis.'))
            raise BagError(f"no NIS of '{sensor}'; the estimator reports: {', '.join(known) or 'none'}")
        logs.append(math.log(max(nis, 1e-12) / degrees))
    return float(np.sqrt(np.mean(np.square(logs))))
