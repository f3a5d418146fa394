# SPDX-License-Identifier: Apache-2.0
"""Draws a node graph as inline SVG in the page's colours: nodes and topics in columns, from left to right.

A node stands one column right of the last topic it listens to, a topic one column right of its publishers;
connections that close a loop run back beneath everything.
"""

from __future__ import annotations

import html
from dataclasses import dataclass

from workspace_harness.graph import Graph, TopicEdge

# Lengths in px of the drawing. A glyph of the bold 12 px face is about 7.4 px wide, of the small one 5.9 px.
_GLYPHS = (7.4, 5.9)
_ROW, _GAP, _COLUMN_GAP, _MARGIN = 42.0, 12.0, 46.0, 10.0
# A connection that closes a loop swings out this far beside the outermost boxes.
_SWING = 34.0
# Where a loop begins, as a reader expects it.
_SOURCES = ('player', 'simulator', 'driver')
_STYLE = (
    '.gn{fill:var(--panel);stroke:var(--s0);stroke-width:1.6}.gt{fill:var(--grid);stroke:none}'
    '.ge{fill:none;stroke:var(--muted);stroke-width:1.2}.gh{fill:var(--muted)}'
    '.gx{fill:var(--ink);font-size:12px;font-weight:600}.gy{fill:var(--muted);font-size:10.5px}'
)


@dataclass
class _Box:
    """A node or topic with its column and, once placed, its corner and width."""

    key: str
    lines: tuple[str, str]
    is_node: bool
    column: int = 0
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0

    @property
    def middle(self) -> float:
        return self.y + _ROW / 2.0


def _rate(topic: TopicEdge) -> str:
    if topic.rate is None:
        return 'silent'
    return f'{topic.rate:.0f} Hz' if topic.rate >= 9.95 else f'{topic.rate:.2g} Hz'


def _columns(graph: Graph) -> tuple[dict[str, int], set[tuple[str, str]]]:
    """Return the column of each node and topic, and the connections that close a loop."""
    after: dict[str, list[str]] = {f'n{n}': [] for n in graph.nodes}
    for topic in graph.topics:
        after[f't{topic.name}'] = [f'n{n}' for n in topic.subscribers]
        for node in topic.publishers:
            after.setdefault(f'n{node}', []).append(f't{topic.name}')
    back: set[tuple[str, str]] = set()
    order: list[str] = []
    state: dict[str, int] = {}

    def visit(key: str) -> None:
        state[key] = 1
        for following in after[key]:
            if state.get(following) == 1:
                back.add((key, following))
            elif following not in state:
                visit(following)
        state[key] = 2
        order.append(key)

    listened = {n for t in graph.topics for n in t.subscribers}

    def rank(key: str) -> tuple[bool, bool, bool, str]:
        # Sources first, so that a loop is cut where it returns to its source.
        named = any(word in key for word in _SOURCES)
        return not key.startswith('n'), not named, key[1:] in listened, key

    for key in sorted(after, key=rank):
        if key not in state:
            visit(key)
    column = dict.fromkeys(after, 0)
    for key in reversed(order):
        for following in after[key]:
            if (key, following) not in back:
                column[following] = max(column[following], column[key] + 1)
    return column, back


def _place(boxes: dict[str, _Box], links: list[tuple[str, str]], begin: float) -> tuple[float, float]:
    """Give every box its place from `begin` (px) on, in the row of what leads to it; return width, height."""
    columns = sorted({box.column for box in boxes.values()})
    x, height = begin, 0.0
    for number in columns:
        column = [box for box in boxes.values() if box.column == number]
        before = {b.key: [boxes[a].middle for a, c in links if c == b.key] for b in column}
        column.sort(key=lambda b: (sum(before[b.key]) / len(before[b.key]) if before[b.key] else 0.0, b.key))
        width = max(g * len(line) for box in column for g, line in zip(_GLYPHS, box.lines)) + 18.0
        for row, box in enumerate(column):
            box.x, box.y, box.width = x, _MARGIN + row * (_ROW + _GAP), width
        height = max(height, _MARGIN + len(column) * (_ROW + _GAP))
        x += width + _COLUMN_GAP
    for number in columns:  # centred, so that connections are short
        column = [box for box in boxes.values() if box.column == number]
        shift = (height - _MARGIN - len(column) * (_ROW + _GAP)) / 2.0
        for box in column:
            box.y += shift
    return x - _COLUMN_GAP + begin, height


def _arrow(start: _Box, end: _Box, bottom: float | None) -> str:
    x0, y0, x1, y1 = start.x + start.width, start.middle, end.x, end.middle
    if bottom is None:
        bend = max(18.0, (x1 - x0) / 2.0)
        path = f'M{x0:.0f} {y0:.0f}C{x0 + bend:.0f} {y0:.0f} {x1 - bend:.0f} {y1:.0f} {x1 - 5:.0f} {y1:.0f}'
    else:
        out, into = x0 + _SWING, x1 - _SWING
        path = (
            f'M{x0:.0f} {y0:.0f}C{out:.0f} {y0:.0f} {out:.0f} {bottom:.0f} {x0:.0f} {bottom:.0f}'
            f'L{x1:.0f} {bottom:.0f}C{into:.0f} {bottom:.0f} {into:.0f} {y1:.0f} {x1 - 5:.0f} {y1:.0f}'
        )
    head = f'M{x1:.0f} {y1:.0f}l-7 -4v8z'
    return f'<path class="ge" d="{path}"/><path class="gh" d="{head}"/>'


def _shape(box: _Box) -> str:
    kind, radius = ('gn', 6) if box.is_node else ('gt', 14)
    centre = box.x + box.width / 2.0
    title, about = (html.escape(line) for line in box.lines)
    return (
        f'<rect class="{kind}" x="{box.x:.0f}" y="{box.y:.0f}" width="{box.width:.0f}" height="{_ROW:.0f}" '
        f'rx="{radius}"/><text class="gx" x="{centre:.0f}" y="{box.y + 18:.0f}" text-anchor="middle">{title}'
        f'</text><text class="gy" x="{centre:.0f}" y="{box.y + 33:.0f}" text-anchor="middle">{about}</text>'
    )


def draw(graph: Graph, alt: str) -> str:
    """Return the graph as one <svg>, which needs the page's CSS variables."""
    column, back = _columns(graph)
    boxes = {f'n{n}': _Box(f'n{n}', (n, 'node'), True, column[f'n{n}']) for n in graph.nodes}
    for topic in graph.topics:
        about = f'{topic.type.split("/")[-1]} · {_rate(topic)}'
        key = f't{topic.name}'
        boxes[key] = _Box(key, (topic.name.lstrip('/'), about), False, column[key])
    links = [(f'n{n}', f't{t.name}') for t in graph.topics for n in t.publishers if f'n{n}' in boxes]
    links += [(f't{t.name}', f'n{n}') for t in graph.topics for n in t.subscribers if f'n{n}' in boxes]
    begin = _MARGIN + (_SWING if back else 0.0)
    width, height = _place(boxes, [link for link in links if link not in back], begin)
    arrows = []
    for a, b in links:
        bottom = height + 10.0 * len(arrows) % 30.0 if (a, b) in back else None
        arrows.append(_arrow(boxes[a], boxes[b], bottom))
    if back:
        height += 34.0
    shapes = ''.join(_shape(box) for box in boxes.values())
    return (
        f'<div class="scroll"><svg class="wide" role="img" aria-label="{html.escape(alt, quote=True)}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" style="display:block;width:100%;max-width:{width:.0f}px;'
        f'margin:auto;font-family:inherit"><style>{_STYLE}</style>{"".join(arrows)}{shapes}</svg></div>'
    )
