# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools report``: one self-contained HTML page (dark and light, phone and desk) and PNGs."""

from __future__ import annotations

import argparse
import html
import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bag_tools.bag import BagError, BagReader, resolve
from bag_tools.cli import guarded
from bag_tools.figures import DARK, LIGHT, SERIES, Line, Panel, png, svg
from bag_tools.offline import OfflineResult
from bag_tools.score import Comparison, Subject, Window, read_window, score
from bag_tools.series import NANOSECONDS, Array

DIAGNOSTICS = '/diagnostics'


@dataclass(frozen=True, slots=True)
class NisTrace:
    """Smoothed NIS of one sensor: `seconds`, `nis` and `gate` (n,); the gate is NaN where unknown."""

    seconds: Array
    nis: Array
    gate: Array


@dataclass(slots=True)
class RunResult:
    """One run of the report: what each estimator made of the same data.

    `comparisons` by estimator, the family's own first; `nis` by sensor; `timing` by label with unit
    (``{'p99 per message [µs]': 31.0}``).
    """

    name: str
    comparisons: Mapping[str, Sequence[Comparison]]
    text: str = ''
    nis: Mapping[str, NisTrace] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)


def nis_of(result: OfflineResult) -> dict[str, NisTrace]:
    """Return the NIS that an offline run noted once a second."""
    traces = {}
    for name, health in result.health.items():
        stamps = np.array(health.stamps, dtype=np.int64)
        seconds = (stamps - stamps[0]).astype(np.float64) / NANOSECONDS
        traces[name] = NisTrace(seconds, np.array(health.nis), np.array(health.gate))
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


def _number(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return '–'
    if value == 0.0:
        return '0'
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f'{value:.{min(digits, 6)}f}' if abs(value) >= 1e-4 else f'{value:.2e}'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; the cells are HTML already. Of more than two columns, the first two are names."""
    kind = ' class="named"' if len(head) > 2 else ''
    top = ''.join(f'<th>{cell}</th>' for cell in head)
    body = ''.join('<tr>' + ''.join(f'<td>{c}</td>' for c in row) + '</tr>' for row in rows)
    return (
        f'<div class="scroll"><table{kind}><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _colors(runs: Sequence[RunResult]) -> dict[str, str]:
    """Give every estimator one colour for the whole page, no two of one run the same while colours last."""
    colors: dict[str, str] = {}
    for name in dict.fromkeys(name for run in runs for name in run.comparisons):
        others = {n for run in runs if name in run.comparisons for n in run.comparisons}
        taken = {colors[n] for n in others if n in colors}
        free = [f's{i}' for i in range(SERIES) if f's{i}' not in taken]
        colors[name] = free[0] if free else f's{len(colors) % SERIES}'
    return colors


def _chip(name: str, color: str) -> str:
    return f'<span class="chip"><i style="background:var(--{color})"></i>{html.escape(name)}</span>'


def _errors_table(run: RunResult, colors: Mapping[str, str]) -> str:
    head = ('estimator', 'quantity', 'RMSE', 'max', '95 %', 'unit', 'NEES (expected)', 'delay')
    rows = []
    for name, comparisons in run.comparisons.items():
        for c in comparisons:
            for index, s in enumerate(c.score.components):
                first = index == 0
                nees = (
                    f'{_number(c.score.nees)} ({c.score.dof})' if c.score.nees is not None and first else ''
                )
                lag = f'{1e3 * c.score.delay:.1f} ms' if c.score.delay is not None and first else ''
                rows.append(
                    (
                        _chip(name, colors[name]) if first else '',
                        html.escape(f'{c.score.role.replace("_", " ")}: {s.name}'),
                        f'<b>{_number(s.rmse)}</b>',
                        _number(s.max),
                        _number(s.percentiles['95']),
                        html.escape(s.unit),
                        nees,
                        lag,
                    )
                )
    return _table(head, rows)


def _overview(runs: Sequence[RunResult], colors: Mapping[str, str]) -> str:
    """Return RMSE by run and estimator, the best of each run in bold, and the means over all runs."""
    parts = []
    roles = dict.fromkeys(c.score.role for run in runs for cs in run.comparisons.values() for c in cs)
    for role in roles:
        table = {run.name: _rmse(run, role) for run in runs}
        table = {name: rows for name, rows in table.items() if rows}
        labels = list(dict.fromkeys(k for rows in table.values() for values in rows.values() for k in values))
        if len(table) > 1:
            table['mean'] = _means(table, labels)
        body = [row for name, rows in table.items() for row in _group(name, rows, labels, colors)]
        head = ('run', 'estimator', *(html.escape(label) for label in labels))
        title = html.escape(role.replace('_', ' '))
        parts.append(f'<h3>RMSE: {title}</h3>{_table(head, body)}')
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
    table: Mapping[str, Mapping[str, Mapping[str, float]]], labels: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return the means over the runs of each estimator that took part in all of them."""
    names = [n for n in next(iter(table.values())) if all(n in rows for rows in table.values())]
    return {
        n: {k: sum(rows[n].get(k, math.nan) for rows in table.values()) / len(table) for k in labels}
        for n in names
    }


def _group(
    name: str, rows: Mapping[str, Mapping[str, float]], labels: Sequence[str], colors: Mapping[str, str]
) -> list[list[str]]:
    best = {k: min((values[k] for values in rows.values() if k in values), default=None) for k in labels}
    lines = []
    for index, (estimator, values) in enumerate(rows.items()):
        cells = [_number(values.get(k)) for k in labels]
        if len(rows) > 1:
            cells = [f'<b>{c}</b>' if values.get(k) == best[k] else c for c, k in zip(cells, labels)]
        lines.append([html.escape(name) if not index else '', _chip(estimator, colors[estimator]), *cells])
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


def _nis_panels(run: RunResult) -> list[Panel]:
    panels = []
    for name, trace in run.nis.items():
        lines = [Line('NIS', trace.seconds, trace.nis, 's0')]
        if np.any(np.isfinite(trace.gate)):
            lines.append(Line('gate', trace.seconds, trace.gate, 's1', dashed=True))
        panels.append(Panel(name, '', lines, log=True))
    return panels


def _grid(panels: Sequence[Panel], about: str) -> str:
    figures = ''.join(
        f'<figure>{svg(p, html.escape(f"{about}: {p.title}", quote=True))}</figure>' for p in panels
    )
    return f'<div class="grid">{figures}</div>'


def _slug(text: str) -> str:
    return re.sub(r'[^a-z0-9]+', '_', text.lower()).strip('_') or 'run'


def _section(run: RunResult, colors: Mapping[str, str], pngs: Path | None) -> str:
    parts = [f'<section id="{_slug(run.name)}"><h2>{html.escape(run.name)}</h2>']
    if run.text:
        parts.append(f'<p>{html.escape(run.text)}</p>')
    parts.append(_errors_table(run, colors))
    for role, panels in panels_of(run, colors).items():
        parts.append(f'<h3>{html.escape(role.replace("_", " ").capitalize())}</h3>{_grid(panels, run.name)}')
        if pngs is not None:
            png(panels, pngs / f'{_slug(run.name)}_{_slug(role)}.png', columns=2)
    nis = _nis_panels(run)
    if nis:
        parts.append(
            '<h3>Normalised innovation squared</h3><p class="note">Smoothed over about 50 updates; near its '
            f'degrees of freedom when the filter is consistent.</p>{_grid(nis, run.name)}'
        )
        if pngs is not None:
            png(nis, pngs / f'{_slug(run.name)}_nis.png', columns=min(2, len(nis)))
    if run.timing:
        rows = [(html.escape(k), _number(v)) for k, v in run.timing.items()]
        parts.append(f'<h3>Timing</h3>{_table(("what", "value"), rows)}')
    return ''.join([*parts, '</section>'])


_CSS = """
:root{color-scheme:light dark;--page:#f6f7f8;%(light)s}
@media (prefers-color-scheme:dark){:root{--page:#121518;%(dark)s}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:1280px;padding:16px;background:var(--page);color:var(--ink);
 font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.6rem;line-height:1.2;margin:.3em 0}
h2{font-size:1.25rem;margin:2.2em 0 .4em;padding-top:.8em;border-top:1px solid var(--grid)}
h3{font-size:1rem;margin:1.6em 0 .5em}
p{max-width:70ch;margin:.4em 0}.note{color:var(--muted);font-size:.9rem}
nav a{display:inline-block;margin:0 1em .3em 0;color:var(--s0)}
.scroll{overflow-x:auto;background:var(--panel);border:1px solid var(--grid);border-radius:8px}
table{border-collapse:collapse;width:100%%;font-size:.875rem;font-variant-numeric:tabular-nums}
th,td{padding:.4em .8em;text-align:right;white-space:nowrap;border-bottom:1px solid var(--grid)}
th{color:var(--muted);font-weight:600;vertical-align:bottom}
td:first-child,th:first-child,.named td:nth-child(2),.named th:nth-child(2){text-align:left}
tbody tr:last-child td{border-bottom:0}
.chip{white-space:nowrap;margin-right:.9em}
.chip i{display:inline-block;width:.75em;height:.75em;border-radius:2px;margin-right:.4em}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%%,440px),1fr));gap:12px}
figure{margin:0;padding:8px;background:var(--panel);border:1px solid var(--grid);border-radius:8px}
figure svg{display:block;width:100%%;height:auto;font-family:inherit}
"""


def _css() -> str:
    light, dark = (''.join(f'--{k}:{v};' for k, v in p.items()) for p in (LIGHT, DARK))
    return _CSS % {'light': light, 'dark': dark}


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
    folder = Path(pngs) if pngs is not None else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    colors = _colors(runs)
    chips = ''.join(_chip(n, c) for n, c in colors.items()) + _chip('truth', 'truth')
    links = ''.join(f'<a href="#{_slug(r.name)}">{html.escape(r.name)}</a>' for r in runs)
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<title>{html.escape(title)}</title><style>{_css()}</style></head><body>'
        f'<h1>{html.escape(title)}</h1>{f"<p>{html.escape(text)}</p>" if text else ""}'
        f'<p>{chips}</p>{f"<nav>{links}</nav>" if len(runs) > 1 else ""}'
        f'{_overview(runs, colors)}{"".join(_section(r, colors, folder) for r in runs)}</body></html>\n'
    )
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f'.{target.name}.partial')
    temporary.write_text(page, encoding='utf-8')
    temporary.replace(target)
    return target


def run_of_bag(
    bag: str | Path, estimates: Sequence[str], truth: Subject, window: Window | None = None, name: str = ''
) -> RunResult:
    """Return a run from a recorded bag: its estimate topics against `truth`, NIS from /diagnostics."""
    comparisons = {resolve(t).lstrip('/'): score(Subject(bag, t), truth, window) for t in estimates}
    nis, timing = diagnostics_of(bag)
    return RunResult(name or Path(bag).stem, comparisons, nis=nis, timing=timing)


def run(argv: list[str]) -> int:
    """Write a report as the command line says."""
    p = argparse.ArgumentParser(prog='report', description='One HTML page of errors and plots from bags.')
    p.add_argument('bags', nargs='+', help='bags with estimates, one run each')
    p.add_argument('--estimate', nargs='+', required=True, metavar='TOPIC', help='estimate topics')
    p.add_argument('--truth', required=True, metavar='TOPIC', help='truth topic')
    p.add_argument('--truth-bag', help='bag with the truth, when it is another one')
    p.add_argument('--where', help='Bool topic of the truth bag: score only while it is true')
    p.add_argument('--after', type=float, default=0.0, help='s after the first truth from which to score')
    p.add_argument('--title', default='Estimates against truth')
    p.add_argument('-o', '--output', default='report.html', help='file to write (default report.html)')
    p.add_argument('--png', metavar='FOLDER', help='also write PNG files there')
    o = p.parse_args(argv)
    runs = []
    for bag in o.bags:
        truth_bag = o.truth_bag or bag
        window = read_window(o.after, math.inf, Subject(truth_bag, o.where) if o.where else None)
        runs.append(run_of_bag(bag, o.estimate, Subject(truth_bag, o.truth), window))
    print(write_report(o.output, runs, o.title, pngs=o.png))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('report', run, argv)


if __name__ == '__main__':
    sys.exit(main())
