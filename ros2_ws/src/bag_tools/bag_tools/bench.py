# SPDX-License-Identifier: Apache-2.0
"""The benchmark: measured figures against their bars, with what peers reach in the same run.

``./ws bench [PACKAGE …] [--seeds N] [--quick]`` runs ``measure(options)`` of each package's
``bench/bench.py``, prints its rows as they come and merges them into ``docs/results/bench.json``.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import math
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RESULTS = Path('docs', 'results', 'bench.json')
# Where a smoke run goes: its figures must not end up in published tables.
QUICK_RESULTS = Path('out', 'bench_quick.json')
# Digits of a stored value: more would only be noise of the machine.
_SIGNIFICANT = 6
# How the file of a benchmark over the whole graph ends.
_CAMPAIGN = '_bench.py'


@dataclass(frozen=True, slots=True)
class Options:
    """How much to measure: `seeds` overrides the number of seeds, `quick` asks for a smoke run.

    `live` false leaves out what runs processes against the clock and so needs an idle machine, `still` false
    leaves out all else.
    """

    seeds: int | None = None
    quick: bool = False
    live: bool = True
    still: bool = True


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `bar` is None for one reported without a bar, `unit` empty for a ratio or a count."""

    package: str
    name: str
    value: float
    unit: str
    bar: float | None = None
    better: str = 'lower'
    reference: dict[str, float] = field(default_factory=dict)
    seeds: int | None = None

    @property
    def passed(self) -> bool:
        """Whether the bar is met; a value that is not finite never is."""
        if not math.isfinite(self.value):
            return False
        if self.bar is None:
            return True
        return bool(self.value <= self.bar if self.better == 'lower' else self.value >= self.bar)


class BenchError(Exception):
    """The benchmark cannot run as asked; the message says what was expected."""


def project_root(start: Path | None = None) -> Path:
    """Return the root of the project: ``$WS_ROOT``, or the first folder upwards that holds the file `ws`.

    Raises BenchError when there is none.
    """
    named = os.environ.get('WS_ROOT')
    if named:
        return Path(named)
    here = (start or Path.cwd()).resolve()
    for folder in (here, *here.parents):
        if (folder / 'ws').is_file() and (folder / 'ros2_ws').is_dir():
            return folder
    raise BenchError(f'{here} is not inside the project (no folder upwards holds the file ws); set WS_ROOT')


def bench_file(root: Path, package: str) -> Path:
    """Return where `package`, or the campaign of that name over the whole graph, keeps its benchmark."""
    campaign = root / 'test' / 'bench' / f'{package}{_CAMPAIGN}'
    return campaign if campaign.is_file() else root / 'ros2_ws' / 'src' / package / 'bench' / 'bench.py'


def campaigns(root: Path) -> list[str]:
    """Return the names of the benchmarks over the whole graph: they run only when they are named."""
    return sorted(p.name.removesuffix(_CAMPAIGN) for p in (root / 'test' / 'bench').glob(f'*{_CAMPAIGN}'))


def choose_packages(root: Path, asked: list[str]) -> tuple[list[str], list[str]]:
    """Return (what to measure, packages without a benchmark); all packages when nothing is asked for.

    Raises BenchError for a package that does not exist.
    """
    source = root / 'ros2_ws' / 'src'
    known = sorted(path.parent.name for path in source.glob('*/package.xml'))
    named = [*known, *campaigns(root)]
    for package in asked:
        if package not in named:
            raise BenchError(f"unknown package '{package}'; known: {', '.join(named)}")
    chosen = asked or known
    there = [package for package in chosen if bench_file(root, package).is_file()]
    return there, [package for package in chosen if package not in there]


@contextmanager
def _loaded(path: Path) -> Iterator[Callable[[Options], Iterable[Row]]]:
    """Import a benchmark file with the modules beside it; forget them all afterwards.

    Packages may well use the same name for a module beside their bench.py.
    """
    before = set(sys.modules)
    sys.path.insert(0, str(path.parent))
    try:
        spec = importlib.util.spec_from_file_location(f'{path.parent.parent.name}_bench', path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        yield module.measure
    finally:
        sys.path.remove(str(path.parent))
        for name in set(sys.modules) - before:
            origin = getattr(sys.modules[name], '__file__', None)
            if origin and Path(origin).is_relative_to(path.parent):
                del sys.modules[name]


def machine() -> str:
    """Describe processor and software (never the host's name): figures mean nothing without."""
    model = platform.machine()
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
        model = next(line.split(':', 1)[1].strip() for line in lines if line.startswith('model name'))
    except (OSError, StopIteration):
        pass
    return f'{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}'


def _stored(value: float) -> float | None:
    """Return `value` as JSON can hold it: rounded, null when it is not finite."""
    return float(f'{value:.{_SIGNIFICANT}g}') if math.isfinite(value) else None


def record(row: Row, seconds: float, date: str, where: str) -> dict[str, Any]:
    """Return the object that bench.json holds for `row`."""
    return {
        'package': row.package,
        'name': row.name,
        'value': _stored(row.value),
        'unit': row.unit,
        'bar': row.bar,
        'better': row.better,
        'pass': row.passed,
        'reference': {peer: _stored(value) for peer, value in row.reference.items()},
        'seeds': row.seeds,
        'seconds': round(seconds, 1),
        'date': date,
        'machine': where,
    }


def load_records(path: Path) -> list[dict[str, Any]]:
    """Return the records of a results file, none if it is missing; raise BenchError if it holds others."""
    if not path.exists():
        return []
    try:
        records = json.loads(path.read_text(encoding='utf-8'))
        for entry in records:
            entry['package'], entry['name']
    except (ValueError, TypeError, KeyError) as error:
        raise BenchError(f'{path}: not a list of benchmark records ({error})') from None
    return records


def merge(
    old: list[dict[str, Any]], new: list[dict[str, Any]], prune: Iterable[str] = ()
) -> list[dict[str, Any]]:
    """Return `old` with rows of the same package and name replaced, packages in order of the alphabet.

    Within a package new rows follow old ones. Rows of packages in `prune` that are not in `new` go.
    """
    merged = {(entry['package'], entry['name']): entry for entry in old if entry['package'] not in set(prune)}
    merged.update({(entry['package'], entry['name']): entry for entry in new})
    return sorted(merged.values(), key=lambda entry: entry['package'])


def store(path: Path, records: list[dict[str, Any]]) -> None:
    """Write the records in one step: a reader never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix('.tmp')
    text = json.dumps(records, indent=2, ensure_ascii=False, allow_nan=False)
    temporary.write_text(text + '\n', encoding='utf-8')
    temporary.replace(path)


def keep(rows: Iterable[Row], seconds: float) -> None:
    """Store rows that another command than `./ws bench` has measured in `seconds` altogether."""
    path = project_root() / RESULTS
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    store(path, merge(load_records(path), [record(row, seconds, date, machine()) for row in rows]))


def line(row: Row, seconds: float) -> str:
    """Return one aligned line of the progress table."""
    sign = '≤' if row.better == 'lower' else '≥'
    bar = '' if row.bar is None else f'{sign} {row.bar:g}'
    mark = '' if row.bar is None and row.passed else ('met' if row.passed else 'MISSED')
    peers = '  '.join(f'{peer} {value:.4g}' for peer, value in row.reference.items())
    text = f'{row.name:<68} {row.value:>11.4g} {row.unit:<9} {bar:>10}  {mark:<6} {seconds:7.1f} s  {peers}'
    return text.rstrip()


def measure_package(root: Path, package: str, options: Options) -> Iterator[tuple[Row, float]]:
    """Yield (row, seconds it took) of one package as they are measured."""
    with _loaded(bench_file(root, package)) as measure:
        start = time.monotonic()
        for row in measure(options):
            now = time.monotonic()
            yield row, now - start
            start = now


def _run(root: Path, packages: list[str], options: Options, prune: bool) -> tuple[list[Row], bool]:
    """Measure, print and store; return the rows and whether every package ran to its end."""
    path = root / (QUICK_RESULTS if options.quick else RESULTS)
    load_records(path)  # a file that cannot be merged into is found before, not after, an hour of work
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    where = machine()
    rows: list[Row] = []
    whole = True
    for package in packages:
        print(f'\n{package}', flush=True)
        records: list[dict[str, Any]] = []
        finished = False
        try:
            for row, seconds in measure_package(root, package, options):
                print(line(row, seconds), flush=True)
                rows.append(row)
                records.append(record(row, seconds, date, where))
            finished = True
        except Exception:
            traceback.print_exc()
            print(f'{package}: the benchmark stopped after {len(records)} rows', file=sys.stderr)
            whole = False
        finally:
            pruned = (package,) if prune and finished else ()
            store(path, merge(load_records(path), records, pruned))
    missed = sum(not row.passed for row in rows)
    print(f'\n{len(rows)} figures, {missed} below their bar; stored in {path.relative_to(root)}')
    return rows, whole


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks; 0 when all ran (`--strict`: and met their bars), 1 when not, 2 on wrong usage."""
    parser = argparse.ArgumentParser(prog='./ws bench', description='Measure figures against their bars.')
    parser.add_argument('packages', nargs='*', metavar='PACKAGE', help='default: all that have a benchmark')
    parser.add_argument('--seeds', type=int, help='number of seeds instead of that of the bars')
    parser.add_argument('--quick', action='store_true', help=f'smoke run, stored in {QUICK_RESULTS} only')
    clocked = parser.add_mutually_exclusive_group()
    clocked.add_argument('--no-live', action='store_true', help='leave out rows that need an idle machine')
    clocked.add_argument('--only-live', action='store_true', help='measure those rows only')
    parser.add_argument('--strict', action='store_true', help='exit code 1 when a bar is missed')
    parser.add_argument(
        '--prune', action='store_true', help='drop stored rows that are not measured any more'
    )
    asked = parser.parse_args(arguments)
    try:
        if asked.seeds is not None and asked.seeds < 1:
            raise BenchError(f'--seeds is {asked.seeds}, expected 1 or more')
        if asked.prune and (asked.no_live or asked.only_live):
            raise BenchError('--prune needs all rows to be measured: leave out --no-live and --only-live')
        root = project_root()
        packages, without = choose_packages(root, asked.packages)
        for package in without:
            print(f'{package} has no bench/bench.py', file=sys.stderr)
        options = Options(asked.seeds, asked.quick, live=not asked.no_live, still=not asked.only_live)
        rows, whole = _run(root, packages, options, asked.prune)
    except BenchError as error:
        print(f'bench: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('\nbench: interrupted; the rows so far are stored', file=sys.stderr)
        return 130
    missed = asked.strict and not all(row.passed for row in rows)
    return 0 if whole and not missed else 1


if __name__ == '__main__':
    # Benchmarks import Row from bag_tools.bench, not from __main__: run that module's main.
    from bag_tools.bench import main as run

    sys.exit(run())
