# SPDX-License-Identifier: Apache-2.0
"""`./ws run`: every bag through its live graph, one table, one report.

For each bag the estimators run as processes of their own in one graph, in lock-step with player and
recorder; what they publish is compared bit by bit with the offline runner and scored against truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bag_tools.bag import BagError
from bag_tools.catalogue import Entry
from bag_tools.headline import suffix
from bag_tools.offline import OfflineResult
from bag_tools.score import Comparison, Subject, read_window, score
from node_core.testing import probe
from workspace_harness.domain import own_domain
from workspace_harness.graph import Graph, Watch, replay_rates, without_lockstep
from workspace_harness.make_bags import root
from workspace_harness.replay import ReplayError, cut, differences, live, offline_all
from workspace_harness.report import write
from workspace_harness.systems import (
    LIVE_SECONDS,
    Job,
    choose,
    fixtures,
    recordings,
    space,
)


@dataclass(frozen=True)
class Result:
    """One estimator on one bag: its score, and where it differed between graph and offline runner."""

    job: Job
    entry: Entry
    comparison: Comparison
    offline: OfflineResult
    differences: list[str]
    seconds: float


class Clock:
    """Where the time of a run goes (s), by kind of work."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()

    @contextmanager
    def __call__(self, work: str) -> Iterator[None]:
        """Count the time of the block as `work`."""
        started = time.monotonic()
        try:
            yield
        finally:
            self.spent[work] += time.monotonic() - started

    def __str__(self) -> str:
        return ', '.join(f'{work} {seconds:.0f} s' for work, seconds in self.spent.items())


def replay(job: Job, folder: Path, clock: Clock) -> tuple[list[Result], Graph]:
    """Run one job live and offline; return a result per estimator, and the graph as it ran.

    Raises ReplayError and BagError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    estimators = job.estimators()
    started = time.monotonic()
    live_bag = folder / 'live.mcap'
    with clock('live graphs'):
        heard = cut(job.bag, job.live_seconds, folder / 'cut.mcap') if job.live_seconds else job.bag
        with probe('watch') as eye:
            watch = Watch(eye)
            live(heard, estimators, live_bag, progress=sys.stderr.isatty(), watch=watch)
    seconds = time.monotonic() - started
    graph = without_lockstep(watch.graph).with_rates(replay_rates(heard, live_bag))
    with clock('offline replays'):
        offline = offline_all(heard, estimators, folder)
    found = {e.space: differences(live_bag, folder, [e]) for e in estimators}
    if heard is not job.bag:
        with clock('offline replays'):
            offline = offline_all(job.bag, estimators, folder)
    results = []
    for entry in job.replay.entries:
        name = space(entry)
        estimate = Subject(folder / f'{name}.mcap', f'/{name}/{entry.output}', entry.field)
        truth = Subject(job.bag, job.replay.truth, job.replay.truth_field)
        where = Subject(job.bag, job.replay.where) if job.replay.where else None
        window = read_window(job.replay.after, float('inf'), where)
        comparison = score(estimate, truth, window, constants=job.replay.solve)[0]
        results.append(Result(job, entry, comparison, offline[name], found[name], seconds))
    return results, graph


def table(results: list[Result]) -> str:
    """Return the table of errors: one line per bag, estimator and component."""
    head = ('system', 'bag', 'estimator', 'error', 'RMSE', 'max', 'printed', 'NEES/dof', 'graph = offline')
    rows = [head]
    for r in results:
        part = f' (first {r.job.live_seconds:g} s)' if r.job.live_seconds else ''
        equal = 'NO' if r.differences else f'to the last bit{part}'
        for i, name in enumerate(r.job.replay.components):
            c = r.comparison.score.component(name)
            printed = r.job.replay.printed.get(name)
            first = (r.job.system, r.job.bag.stem, r.entry.label) if i == 0 else ('', '', '')
            nees = '–' if c.nees is None else f'{c.nees:.2f}'
            unit = suffix(c.unit)
            shown = '–' if printed is None else f'{printed:g}{unit}'
            row = (*first, name, f'{c.rmse:.3g}{unit}', f'{c.max:.3g}{unit}', shown, nees)
            rows.append((*row, equal if i == 0 else ''))
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = ['  '.join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]
    lines.insert(1, '-' * max(len(line) for line in lines))
    return '\n'.join(lines)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='./ws run', description='Replay the bags through live graphs.')
    parser.add_argument('systems', nargs='*', help='packages to run (default all)')
    parser.add_argument('--whole', action='store_true', help='every bag through the graph from end to end')
    parser.add_argument('--no-recordings', action='store_true', help='fixtures only')
    parser.add_argument('--out', type=Path, default=root() / 'out', help='folder of bags and report')
    return parser.parse_args()


def main() -> int:
    """Entry point."""
    started = time.monotonic()
    clock = Clock()
    arguments = _arguments()
    out = arguments.out
    try:
        systems = choose(arguments.systems)
        jobs = fixtures(root() / 'bags', systems, 0.0 if arguments.whole else LIVE_SECONDS)
        if not arguments.no_recordings:
            jobs += recordings(systems, out / 'recordings', whole=arguments.whole)
    except (ValueError, BagError) as error:
        print(f'./ws run: {error}', file=sys.stderr)
        return 2
    results: list[Result] = []
    graphs: dict[str, Graph] = {}
    failed = 0
    with own_domain():
        for number, job in enumerate(jobs, 1):
            print(f'[{number}/{len(jobs)}] {job.system}: {job.replay.title} ({job.bag.stem})', flush=True)
            try:
                done, graph = replay(job, out / job.system / job.bag.stem, clock)
            except (ReplayError, BagError) as error:
                failed += 1
                print(f'      failed: {error}', file=sys.stderr)
                continue
            results += done
            graphs.setdefault(job.system, graph)
            lines = [line for r in done for line in r.differences]
            failed += bool(lines)
            print(
                '\n'.join(f'      differs from offline: {line}' for line in lines)
                or f'      {done[0].seconds:.0f} s'
            )
    if not results:
        print(f'./ws run: nothing to show; {failed} replays failed', file=sys.stderr)
        return 1
    print(f'\n{table(results)}\n')
    print(f'report: {write(results, graphs, out)}')
    rest = time.monotonic() - started - sum(clock.spent.values())
    print(f'time: {clock}, comparing, scoring and the report {rest:.0f} s')
    return 1 if failed else 0


if __name__ == '__main__':
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(0)
