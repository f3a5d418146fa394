# SPDX-License-Identifier: Apache-2.0
"""What a sweep runs: tasks from bags or simulator seeds and a choice of parameters. Pure; no Dask here."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bag_tools.bag import SUFFIXES, BagError
from bag_tools.rosargs import load_yaml

_SEEDS = re.compile(r'(\d+):(\d+)')


@dataclass(frozen=True, slots=True)
class Source:
    """Where a run's messages come from: a bag, or `simulation` ('module:function') called with `seed`.

    The function takes (seed, path) and writes one bag, truth included. `version` is size and time of change
    of a bag: a bag that was replaced is run again.
    """

    bag: str = ''
    simulation: str = ''
    seed: int | None = None
    version: str = ''


@dataclass(frozen=True, slots=True)
class Scoring:
    """What a run is scored on, as ``ros2 run bag_tools score`` has it; no truth: only NIS and counts."""

    estimate: str = ''
    truth: str = ''
    field: str | None = None
    truth_field: str | None = None
    after: float = 0.0
    where: str | None = None
    solve: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Task:
    """One run of one estimator: everything that decides its result, and nothing else."""

    package: str
    estimator: str
    source: Source
    scoring: Scoring
    params: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Name of the run: a hash of all that decides its result."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Range:
    """A parameter between two bounds, evenly or (`log`) evenly in its logarithm."""

    name: str
    low: float
    high: float
    log: bool = False

    def at(self, share: float) -> float:
        """Return the value at `share` (0 … 1) of the range."""
        if self.log:
            return float(math.exp(math.log(self.low) + share * (math.log(self.high) - math.log(self.low))))
        return self.low + share * (self.high - self.low)


def _named(text: str, expected: str) -> tuple[str, str]:
    name, mark, value = text.partition('=')
    if not mark or not name or not value:
        raise BagError(f"'{text}' is malformed; expected {expected}")
    return name, value


def parse_grid(texts: Sequence[str]) -> dict[str, list[Any]]:
    """Return the values by parameter name of ``name=a,b,c`` texts; YAML lists and numbers alike."""
    grid = {}
    for text in texts:
        name, values = _named(text, 'name=value,value,…')
        try:
            grid[name] = list(load_yaml(f'[{values}]'))
        except yaml.YAMLError:
            raise BagError(f"'{text}' is malformed; expected name=value,value,…") from None
    return grid


def parse_range(text: str) -> Range:
    """Return the range of ``name=low:high`` or ``name=low:high:log``."""
    name, bounds = _named(text, 'name=low:high[:log]')
    parts = bounds.split(':')
    try:
        low, high = float(parts[0]), float(parts[1])
    except (ValueError, IndexError):
        raise BagError(f"'{text}' is malformed; expected name=low:high[:log]") from None
    log = parts[2:] == ['log']
    if (parts[2:] and not log) or not low < high or (log and low <= 0.0) or not math.isfinite(high - low):
        raise BagError(f"'{text}': expected low < high, both finite, and above 0 with :log")
    return Range(name, low, high, log)


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of ``first:end`` (end exclusive) or ``a,b,c``."""
    match = _SEEDS.fullmatch(text)
    try:
        seeds = list(range(int(match[1]), int(match[2]))) if match else [int(s) for s in text.split(',')]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0:
        raise BagError(f"seeds '{text}' are malformed; expected first:end or a,b,c")
    return seeds


def parse_dof(texts: Sequence[str]) -> dict[str, int]:
    """Return degrees of freedom by sensor of ``topic=n`` texts."""
    dof = {}
    for text in texts:
        name, number = _named(text, 'topic=degrees of freedom')
        if not number.isdigit() or int(number) < 1:
            raise BagError(f"'{text}' is malformed; expected topic=degrees of freedom")
        dof[name] = int(number)
    return dof


def find_bags(paths: Sequence[str]) -> list[Source]:
    """Return bags: files, rosbag2 folders, and all of both below any other folder (an archive)."""
    found: list[Path] = []
    for text in paths:
        path = Path(text)
        if not path.exists():
            raise BagError(f'{path}: no such bag or folder')
        inside = [path] if path.is_file() or (path / 'metadata.yaml').exists() else sorted(_below(path))
        if not inside:
            raise BagError(f'{path}: holds no bag')
        found += inside
    return [Source(bag=str(bag), version=_version(bag)) for bag in dict.fromkeys(found)]


def _below(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.is_dir():
            if path.suffix == '.partial':
                continue
            if (path / 'metadata.yaml').exists():
                yield path
            else:
                yield from _below(path)
        elif path.suffix in SUFFIXES:
            yield path


def _version(bag: Path) -> str:
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    stats = [f.stat() for f in files if f.is_file()]
    return ' '.join(f'{s.st_size}:{s.st_mtime_ns}' for s in stats)


def choices(
    grid: dict[str, list[Any]], ranges: Sequence[Range] = (), samples: int = 0, seed: int = 0
) -> list[dict[str, Any]]:
    """Return parameter sets: the product of `grid`, and for each `samples` random draws from `ranges`."""
    sets = [dict(zip(grid, values)) for values in itertools.product(*grid.values())]
    if not ranges:
        return sets
    rng = np.random.default_rng(seed)
    draws = [{r.name: r.at(float(rng.random())) for r in ranges} for _ in range(samples)]
    return [{**fixed, **draw} for fixed in sets for draw in draws]


def plan(
    package: str,
    estimator: str,
    sources: Sequence[Source],
    sets: Sequence[dict[str, Any]],
    scoring: Scoring,
    fixed: dict[str, Any],
) -> list[Task]:
    """Return one task per source and parameter set; `fixed` parameters apply to all."""
    return [Task(package, estimator, s, scoring, {**fixed, **chosen}) for s in sources for chosen in sets]
