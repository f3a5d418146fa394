# SPDX-License-Identifier: Apache-2.0
"""The HTML report of `./ws run`: one table, then per system the graph, the paper's figures and the bags."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from bag_tools.bench import RESULTS, load_records
from bag_tools.headline import headlines
from bag_tools.report import Chapter, RunResult, nis_of, write_chapters
from bag_tools.report_page import grid, table
from workspace_harness.graph import Graph
from workspace_harness.graph_svg import draw
from workspace_harness.make_bags import root
from workspace_harness.paper_figures import FIGURES, HEAD, PaperFigures

if TYPE_CHECKING:
    from workspace_harness.run import Result

TITLES = {
    'imu_kalman': 'Angle filter (imu_kalman)',
    'ship_inclinometer': "Ship's inclinometer (ship_inclinometer)",
    'ev_velocity': 'Electric car (ev_velocity)',
    'ins_gps': 'INS/GPS (ins_gps)',
    'quad_control': 'Quadcopter (quad_control)',
}


def section(results: Sequence[Result]) -> RunResult:
    """Return one section from the results of one job; the family's own estimator stands last in the job."""
    job = results[0].job
    ordered = list(reversed(results))
    equal = all(not r.differences for r in results)
    timing = {
        f'{r.entry.label}: offline, per message [µs]': 1e6
        * r.offline.seconds
        / sum(r.offline.inputs.values())
        for r in ordered
    }
    part = f' over its first {job.live_seconds:g} s' if job.live_seconds else ''
    verdict = (
        f'equals the offline runner to the last bit{part}' if equal else 'DIFFERS from the offline runner'
    )
    return RunResult(
        name=job.bag.stem,
        comparisons={r.entry.label: [r.comparison] for r in ordered},
        text=f'{job.replay.title[0].upper()}{job.replay.title[1:]}. The live graph {verdict}.',
        nis=nis_of(ordered[0].offline, ordered[0].entry.label),
        timing=timing,
    )


def headline_html() -> str:
    """Return the report's one table: paper, best peer and this workspace, as `./ws bench` measured them."""
    choice = yaml.safe_load((root() / 'docs' / 'headline.yaml').read_text(encoding='utf-8'))
    lines = headlines(load_records(root() / RESULTS), choice, partial=True)
    rows = []
    for line in lines:
        bar = f'<span class="missed">{line.bar} missed</span>' if line.met is False else line.bar
        cells = (line.system, line.figure, line.paper, line.peer)
        rows.append((*(html.escape(c) for c in cells), f'<b>{html.escape(line.here)}</b>', bar))
    dates = sorted({line.date for line in lines})
    when = html.escape(' to '.join(dict.fromkeys([*dates[:1], *dates[-1:]])))
    about = (
        f'<p class="note">Measured by ./ws bench ({when}), '
        'peers in the same run. What this run measured stands in the chapters.</p>'
    )
    return table(('system', 'figure', 'paper', 'best peer', 'here', 'bar'), rows) + about


def figures_html(figures: PaperFigures, system: str) -> str:
    """Return the paper's figures and printed results of one system."""
    rows = [tuple(html.escape(cell) or '–' for cell in row) for row in figures.rows]
    return (
        f"<h3>The paper's figures, remade</h3><p>{html.escape(figures.text)}</p>"
        f'{grid(figures.panels, system)}{table(HEAD, rows, names=1)}'
    )


def graph_html(graph: Graph, system: str) -> str:
    """Return the drawing of a running graph with what it leaves out."""
    return (
        f'<h3>The graph as it ran</h3>{draw(graph, f"{system}: nodes and topics")}'
        '<p class="note">Read from the running graph; rates are messages per second of bag time. Left out: '
        '/diagnostics, /rosout, /parameter_events and what only lock-step adds.</p>'
    )


def chapter(system: str, results: Sequence[Result], graph: Graph | None) -> Chapter:
    """Return the chapter of one system."""
    parts = []
    if graph is not None and graph.topics:
        parts.append(graph_html(graph, system))
    needed, make = FIGURES[system]
    if any(r.job.bag.stem == needed for r in results):
        parts.append(figures_html(make(results), system))
    runs = [section(list(group)) for _, group in groupby(results, key=lambda r: r.job.bag)]
    return Chapter(TITLES[system], runs, ''.join(parts))


def write(results: Sequence[Result], graphs: Mapping[str, Graph], out: Path) -> Path:
    """Write the page and its pictures below `out`; return the page's path."""
    chapters = [
        chapter(system, list(group), graphs.get(system))
        for system, group in groupby(
            sorted(results, key=lambda r: _order(r.job.system)), lambda r: r.job.system
        )
    ]
    title = 'Five estimators: papers, peers and this workspace'
    return write_chapters(out / 'report.html', chapters, title, headline_html(), pngs=out / 'plots')


def _order(system: str) -> int:
    return list(TITLES).index(system)
