# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools report``: one self-contained HTML page (dark and light, phone and desk) and PNGs."""

from __future__ import annotations

import argparse
import html
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bag_tools.align import CONSTANTS
from bag_tools.bag import SUFFIXES, BagError, BagReader, resolve
from bag_tools.cli import guarded
from bag_tools.figures import SERIES, Line, Panel, png
from bag_tools.offline import OfflineResult
from bag_tools.report_page import chip, document, grid, number, slug, table
from bag_tools.score import SOLVE_HELP, Comparison, Subject, Window, read_window, score
from bag_tools.series import NANOSECONDS, Array

DIAGNOSTICS = '/diagnostics'


@dataclass(frozen=True, slots=True)
class NisTrace:
    """Smoothed NIS of one sensor: `seconds` of the bag, `nis` and `gate` (n,), NaN where unknown."""

    seconds: Array
    nis: Array
    gate: Array


@dataclass(slots=True)
class RunResult:
    """One run of the report: what each estimator made of the same data.

    `comparisons` by estimator, the family's own first; `nis` by sensor, or by ``estimator: sensor`` where
    there are several; `timing` by label with unit (``{'p99 per message [µs]': 31.0}``).
    """

    name: str
    comparisons: Mapping[str, Sequence[Comparison]]
    text: str = ''
    nis: Mapping[str, NisTrace] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Chapter:
    """Runs that belong together; `body` is HTML that stands before them."""

    title: str
    runs: Sequence[RunResult]
    body: str = ''


def nis_of(result: OfflineResult, estimator: str = '') -> dict[str, NisTrace]:
    """Return the NIS that an offline run noted once a second, by sensor, or by `estimator` and sensor."""
    traces = {}
    owner = f'{estimator}: ' if estimator else ''
    for name, health in result.health.items():
        stamps = np.array(health.stamps, dtype=np.int64)
        seconds = (stamps - result.start).astype(np.float64) / NANOSECONDS
        traces[f'{owner}{name}'] = NisTrace(seconds, np.array(health.nis), np.array(health.gate))
    return traces


def diagnostics_of(bag: str | Path) -> tuple[dict[str, NisTrace], dict[str, float]]:
    """Return NIS by sensor and processing times (µs) from the recorded /diagnostics; empty without."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    timing: dict[str, float] = {}
    with BagReader(bag) as reader:
        if DIAGNOSTICS not in reader.topics:
            return {}, {}
        for _, stamp, data in reader.messages([DIAGNOSTICS]):
            for status in reader.decode(data, reader.topics[DIAGNOSTICS].type).status:
                values = {v.key: v.value for v in status.values}
                if 'nis' in values:
                    row = (
                        (stamp - reader.start) * 1e-9,
                        float(values['nis']),
                        float(values.get('gate', 'nan')),
                    )
                    rows.setdefault(status.name, []).append(row)
                for key in ('processing_p50_s', 'processing_p99_s'):
                    value = float(values.get(key, 'nan'))
                    if math.isfinite(value):
                        timing[f'{status.name}, {key[11:14]} per message [µs]'] = value * 1e6
    return {name: NisTrace(*np.array(r).T) for name, r in rows.items()}, timing


# Text -----------------------------------------------------------------------------------------------


def _colors(runs: Sequence[RunResult]) -> dict[str, str]:
    """Give every estimator one colour for the whole page, no two of one run the same while colours last."""
    colors: dict[str, str] = {}
    for name in dict.fromkeys(name for run in runs for name in run.comparisons):
        others = {n for run in runs if name in run.comparisons for n in run.comparisons}
        taken = {colors[n] for n in others if n in colors}
        free = [f's{i}' for i in range(SERIES) if f's{i}' not in taken]
        colors[name] = free[0] if free else f's{len(colors) % SERIES}'
    return colors


def _errors_table(run: RunResult, colors: Mapping[str, str]) -> str:
    head = ('estimator', 'quantity', 'RMSE', 'max', '95 %', 'unit', 'NEES/dof', 'delay')
    rows = []
    for name, comparisons in run.comparisons.items():
        for c in comparisons:
            for index, s in enumerate(c.score.components):
                first = index == 0
                lag = f'{1e3 * c.score.delay:.1f} ms' if c.score.delay is not None and first else ''
                rows.append(
                    (
                        chip(name, colors[name]) if first else '',
                        html.escape(f'{c.score.role.replace("_", " ")}: {s.name}'),
                        f'<b>{number(s.rmse)}</b>',
                        number(s.max),
                        number(s.percentiles['95']),
                        html.escape(s.unit),
                        '' if s.nees is None else number(s.nees),
                        lag,
                    )
                )
    return table(head, rows)


def _overview(runs: Sequence[RunResult], colors: Mapping[str, str]) -> str:
    """Return RMSE by run and estimator, the best of each run in bold, and the means over all runs."""
    parts = []
    roles = dict.fromkeys(c.score.role for run in runs for cs in run.comparisons.values() for c in cs)
    for role in roles:
        found = {run.name: _rmse(run, role) for run in runs}
        found = {name: rows for name, rows in found.items() if rows}
        labels = list(dict.fromkeys(k for rows in found.values() for values in rows.values() for k in values))
        # A component that nobody gets wrong, such as the sideways speed of a car, is none.
        labels = [
            k for k in labels if any(v.get(k) for rows in found.values() for v in rows.values())
        ] or labels
        if len(found) > 1:
            found['mean'] = _means(found, labels)
        body = [row for name, rows in found.items() for row in _group(name, rows, labels, colors)]
        head = ('run', 'estimator', *(html.escape(label) for label in labels))
        title = html.escape(role.replace('_', ' '))
        parts.append(f'<h3>RMSE: {title}</h3>{table(head, body)}')
    return ''.join(parts)


def _rmse(run: RunResult, role: str) -> dict[str, dict[str, float]]:
    """Return {estimator: {component with unit: RMSE}} of one quantity."""
    return {
        name: {f'{s.name} [{s.unit}]' if s.unit else s.name: s.rmse for s in c.score.components}
        for name, comparisons in run.comparisons.items()
        for c in comparisons
        if c.score.role == role
    }


def _means(
    found: Mapping[str, Mapping[str, Mapping[str, float]]], labels: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return the means over the runs of each estimator that took part in all of them."""
    names = [n for n in next(iter(found.values())) if all(n in rows for rows in found.values())]
    return {
        n: {k: sum(rows[n].get(k, math.nan) for rows in found.values()) / len(found) for k in labels}
        for n in names
    }


def _group(
    name: str, rows: Mapping[str, Mapping[str, float]], labels: Sequence[str], colors: Mapping[str, str]
) -> list[list[str]]:
    best = {k: min((values[k] for values in rows.values() if k in values), default=None) for k in labels}
    lines = []
    for index, (estimator, values) in enumerate(rows.items()):
        cells = [number(values.get(k)) for k in labels]
        if len(rows) > 1:
            cells = [f'<b>{c}</b>' if values.get(k) == best[k] else c for c, k in zip(cells, labels)]
        lines.append([html.escape(name) if not index else '', chip(estimator, colors[estimator]), *cells])
    return lines


# Figures --------------------------------------------------------------------------------------------


def panels_of(run: RunResult, colors: Mapping[str, str]) -> dict[str, list[Panel]]:
    """Return, by quantity, a panel of estimate and truth and one of the error for each component."""
    by_role: dict[str, list[tuple[str, Comparison]]] = {}
    for name, comparisons in run.comparisons.items():
        for c in comparisons:
            by_role.setdefault(c.score.role, []).append((name, c))
    panels: dict[str, list[Panel]] = {}
    for role, members in by_role.items():
        first = members[0][1]
        for i, label in enumerate(first.labels):
            lines = [Line(n, c.times, c.estimate[:, i], colors[n]) for n, c in members]
            truth = Line('truth', first.times, first.truth[:, i], 'truth')
            errors = [
                Line(
                    n,
                    c.times,
                    c.errors[:, i],
                    colors[n],
                    # The band of one estimator only: several would cover each other.
                    band=3.0 * c.sigmas[:, i] if c.sigmas is not None and n == members[0][0] else None,
                )
                for n, c in members
            ]
            banded = ' with ±3σ' if errors[0].band is not None else ''
            panels.setdefault(role, []).append(Panel(label, first.unit, [*lines, truth]))
            panels[role].append(Panel(f'{first.error_labels[i]}{banded}', first.unit, errors, zero=True))
    return panels


def panels_of_nis(run: RunResult) -> list[Panel]:
    """Return a panel for each sensor, on the time axis of the errors."""
    panels = []
    # On the axis of the errors above, whenever a sensor began.
    last = max((c.times[-1] for cs in run.comparisons.values() for c in cs if len(c.times)), default=0.0)
    for name, trace in run.nis.items():
        lines = [Line('NIS', trace.seconds, trace.nis, 's0')]
        if np.any(np.isfinite(trace.gate)):
            lines.append(Line('gate', trace.seconds, trace.gate, 's1', dashed=True))
        end = max(float(last), float(trace.seconds[-1]))
        panels.append(Panel(name, '', lines, log=True, span=(0.0, end)))
    return panels


def _details(run: RunResult, colors: Mapping[str, str], pngs: Path | None) -> str:
    """Return everything about one run: errors, plots, NIS and timing."""
    parts = [f'<p>{html.escape(run.text)}</p>'] if run.text else []
    parts.append(_errors_table(run, colors))
    parts += [
        f'<p class="note">{html.escape(f"{name}: taken out before, {c.score.solved}")}</p>'
        for name, comparisons in run.comparisons.items()
        for c in comparisons
        if c.score.solved is not None
    ]
    for role, panels in panels_of(run, colors).items():
        parts.append(f'<h3>{html.escape(role.replace("_", " ").capitalize())}</h3>{grid(panels, run.name)}')
        if pngs is not None:
            png(panels, pngs / f'{slug(run.name)}_{slug(role)}.png', columns=2)
    nis = panels_of_nis(run)
    if nis:
        parts.append(
            '<h3>Normalised innovation squared</h3><p class="note">Smoothed over about 50 updates; near its '
            f'degrees of freedom when the filter is consistent.</p>{grid(nis, run.name)}'
        )
        if pngs is not None:
            png(nis, pngs / f'{slug(run.name)}_nis.png', columns=min(2, len(nis)))
    if run.timing:
        rows = [(html.escape(k), number(v)) for k, v in run.timing.items()]
        parts.append(f'<h3>Timing</h3>{table(("what", "value"), rows)}')
    return ''.join(parts)


def _section(run: RunResult, colors: Mapping[str, str], pngs: Path | None) -> str:
    name = html.escape(run.name)
    return f'<section id="{slug(run.name)}"><h2>{name}</h2>{_details(run, colors, pngs)}</section>'


def _chapter(chapter: Chapter, colors: Mapping[str, str], pngs: Path | None) -> str:
    """Return a chapter: its own text and figures, one table of its runs, and each run to unfold."""
    runs = ''.join(
        f'<details id="{slug(run.name)}"><summary>{html.escape(run.name)}: errors with ±3σ, NIS, timing'
        f'</summary>{_details(run, colors, pngs)}</details>'
        for run in chapter.runs
    )
    head = f'<h2>{html.escape(chapter.title)}</h2>{chapter.body}'
    overview = _overview(chapter.runs, colors) if chapter.runs else ''
    return f'<section id="{slug(chapter.title)}">{head}{overview}{runs}</section>'


def _legend(runs: Sequence[RunResult], colors: Mapping[str, str]) -> str:
    names = [name for name in colors if any(name in run.comparisons for run in runs)]
    return f'<p>{"".join(chip(n, colors[n]) for n in names)}{chip("truth", "truth")}</p>'


def _folder(pngs: str | Path | None) -> Path | None:
    folder = Path(pngs) if pngs is not None else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def _write(path: str | Path, title: str, body: str) -> Path:
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f'.{target.name}.partial')
    temporary.write_text(document(title, body), encoding='utf-8')
    temporary.replace(target)
    return target


def write_report(
    path: str | Path,
    runs: Sequence[RunResult],
    title: str,
    text: str = '',
    *,
    pngs: str | Path | None = None,
) -> Path:
    """Write the page to `path` and, when `pngs` names a folder, one PNG per run and quantity into it."""
    if not any(run.comparisons for run in runs):
        raise BagError(f'{path}: nothing to report; expected at least one run with a comparison')
    folder = _folder(pngs)
    colors = _colors(runs)
    links = ''.join(f'<a href="#{slug(r.name)}">{html.escape(r.name)}</a>' for r in runs)
    body = (
        f'<h1>{html.escape(title)}</h1>{f"<p>{html.escape(text)}</p>" if text else ""}'
        f'{_legend(runs, colors)}{f"<nav>{links}</nav>" if len(runs) > 1 else ""}'
        f'{_overview(runs, colors)}{"".join(_section(r, colors, folder) for r in runs)}'
    )
    return _write(path, title, body)


def write_chapters(
    path: str | Path,
    chapters: Sequence[Chapter],
    title: str,
    head: str = '',
    *,
    pngs: str | Path | None = None,
) -> Path:
    """Write a page of chapters to `path`: `head` (HTML), then each chapter with its runs folded."""
    folder = _folder(pngs)
    # Within a chapter colours must differ; across chapters the first estimator always has the first one.
    links = ''.join(f'<a href="#{slug(c.title)}">{html.escape(c.title)}</a>' for c in chapters)
    body = ''.join(_chapter(c, _colors(c.runs), folder) for c in chapters)
    return _write(path, title, f'<h1>{html.escape(title)}</h1><nav>{links}</nav>{head}{body}')


def run_of_bag(
    bag: str | Path,
    estimates: Sequence[str],
    truth: Subject,
    window: Window | None = None,
    name: str = '',
    constants: Collection[str] = (),
) -> RunResult:
    """Return a run from a recorded bag: its estimate topics against `truth`, NIS from /diagnostics."""
    comparisons = {
        resolve(t).lstrip('/'): score(Subject(bag, t), truth, window, constants=constants) for t in estimates
    }
    nis, timing = diagnostics_of(bag)
    return RunResult(name or bag_names([bag])[0], comparisons, nis=nis, timing=timing)


def bag_names(bags: Sequence[str | Path]) -> list[str]:
    """Return a name for each bag: its file's, with as many folders before it as tell all of them apart."""
    paths = [Path(bag).absolute() for bag in bags]
    parts = [(*p.parts[1:-1], p.stem if p.suffix in SUFFIXES else p.name) for p in paths]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ['/'.join(part[-depth:]) for part in parts]
        if len(set(map(slug, names))) == len(names):
            return names
    return [f'{name} ({number})' for number, name in enumerate(names, start=1)]


def run(argv: list[str]) -> int:
    """Write a report as the command line says."""
    p = argparse.ArgumentParser(prog='report', description='One HTML page of errors and plots from bags.')
    p.add_argument('bags', nargs='+', help='bags with estimates, one run each')
    p.add_argument('--estimate', nargs='+', required=True, metavar='TOPIC', help='estimate topics')
    p.add_argument('--truth', required=True, metavar='TOPIC', help='truth topic')
    p.add_argument('--truth-bag', help='bag with the truth, when it is another one')
    p.add_argument('--where', help='Bool topic of the truth bag: score only while it is true')
    p.add_argument('--after', type=float, default=0.0, help='s after the first truth from which to score')
    p.add_argument('--solve', nargs='+', choices=CONSTANTS, default=(), metavar='CONSTANT', help=SOLVE_HELP)
    p.add_argument('--title', default='Estimates against truth')
    p.add_argument('-o', '--output', default='report.html', help='file to write (default report.html)')
    p.add_argument('--png', metavar='FOLDER', help='also write PNG files there')
    o = p.parse_args(argv)
    runs = []
    for bag, name in zip(o.bags, bag_names(o.bags)):
        truth_bag = o.truth_bag or bag
        window = read_window(o.after, math.inf, Subject(truth_bag, o.where) if o.where else None)
        runs.append(run_of_bag(bag, o.estimate, Subject(truth_bag, o.truth), window, name, o.solve))
    print(write_report(o.output, runs, o.title, pngs=o.png))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('report', run, argv)


if __name__ == '__main__':
    sys.exit(main())
