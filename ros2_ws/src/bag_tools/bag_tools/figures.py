# SPDX-License-Identifier: Apache-2.0
"""Small multiples for reports: one panel per component, as inline SVG that follows the page's theme, or PNG.

Figures are drawn in placeholder colours; for SVG these become CSS variables, for PNG the light palette.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bag_tools.series import Array

# Chosen apart in hue and lightness, also for the common kinds of colour blindness; truth is neutral.
LIGHT = {
    'ink': '#1c2128',
    'muted': '#5b6470',
    'grid': '#e1e4e8',
    'panel': '#ffffff',
    'truth': '#7b838d',
    's0': '#1760c4',
    's1': '#c2570c',
    's2': '#12805c',
    's3': '#a02c7d',
    's4': '#7a5c00',
    's5': '#0b7d93',
}
DARK = {
    'ink': '#e8eaed',
    'muted': '#a2abb6',
    'grid': '#343b44',
    'panel': '#1b1f24',
    'truth': '#98a1ab',
    's0': '#6aa8ff',
    's1': '#f29a52',
    's2': '#4fc79b',
    's3': '#e383c3',
    's4': '#d8b648',
    's5': '#55c4d9',
}
SERIES = 6
# Placeholders no real figure would use.
_KEYS = {name: f'#0000{index:02x}' for index, name in enumerate(LIGHT, start=1)}
_NAMES = {code: name for name, code in _KEYS.items()}
# Enough for every pixel of a panel to show the extremes of what falls on it.
_BINS = 360
_PANEL = (4.4, 2.1)  # inches; at 72 points per inch the width of a phone's screen
# Characters that a line's name and a panel's title have room for.
_NAME = 24
_TITLE = 44
_STYLE: Any = {
    'font.family': 'sans-serif',
    'font.size': 9.0,
    'svg.fonttype': 'none',
    'svg.hashsalt': 'bag_tools',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'path.simplify_threshold': 0.5,
}


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a panel: x in s; `color` is a name of the palette; `band` half-widths around zero."""

    name: str
    x: Array
    y: Array
    color: str
    band: Array | None = None
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """One small plot. `zero` marks the zero line; `log` is for quantities over decades; `span` are s."""

    title: str
    unit: str
    lines: Sequence[Line]
    zero: bool = False
    log: bool = False
    span: tuple[float, float] | None = None


def thin(x: Array, y: Array) -> tuple[Array, Array]:
    """Return x and y with at most two points a bin, its extremes, so that no spike is lost."""
    if len(x) <= 2 * _BINS:
        return x, y
    edges = np.linspace(0, len(x), _BINS + 1).astype(int)
    keep: list[int] = []
    for begin, end in pairwise(edges):
        part = y[begin:end]
        if np.all(np.isnan(part)):
            keep.append(int(begin))
            continue
        keep += sorted({int(begin + np.nanargmin(part)), int(begin + np.nanargmax(part))})
    index = np.array(keep)
    return x[index], y[index]


def broken(x: Array, y: Array) -> tuple[Array, Array]:
    """Return x and y with NaN where time leaps, so that no line is drawn across what is missing."""
    if len(x) < 3:
        return x, y
    steps = np.diff(x)
    # Half a percent of the plot is the least gap the eye can tell.
    leaps = np.flatnonzero(steps > max(10.0 * float(np.median(steps)), 0.005 * float(x[-1] - x[0]))) + 1
    return np.insert(x, leaps, x[leaps - 1]), np.insert(y, leaps, np.nan)


def spread(targets: Array, least: float, low: float, high: float) -> Array:
    """Return positions near `targets`, in their order, at least `least` apart and within [low, high]."""
    order = np.argsort(targets, kind='stable')
    placed = np.clip(targets[order].astype(float), low, high)
    for i in range(1, len(placed)):
        placed[i] = max(placed[i], placed[i - 1] + least)
    if len(placed) and placed[-1] > high:
        placed[-1] = high
        for i in range(len(placed) - 2, -1, -1):
            placed[i] = min(placed[i], placed[i + 1] - least)
    result = np.empty_like(placed)
    result[order] = placed
    return result


def middle_cut(text: str, limit: int) -> str:
    """Return `text` with its middle left out where it is longer than `limit`: topics differ at either end."""
    if len(text) <= limit:
        return text
    head = (limit - 1) // 2
    return f'{text[:head]}…{text[head + 1 - limit :]}'


def short_names(names: Sequence[str], limit: int = _NAME) -> list[str]:
    """Return `names` in at most `limit` characters, without the folders that all long paths share."""
    if all(len(name) <= limit for name in names):
        return list(names)
    paths = [name.strip('/').split('/') for name in names if '/' in name]
    depth = min(map(len, paths), default=0)
    # At least one part of each path stays.
    same = [len({path[i] for path in paths}) == 1 for i in (*range(depth), *range(-depth, 0))]
    head = (same[:depth] + [False]).index(False)
    tail = (same[depth:][::-1] + [False]).index(False)
    if len(paths) < 2 or head + tail >= depth:
        return [middle_cut(name, limit) for name in names]
    short = []
    for name in names:
        parts = name.strip('/').split('/')
        if len(name) > limit and len(parts) > head + tail:
            name = f'{"…/" * bool(head)}{"/".join(parts[head : len(parts) - tail])}{"/…" * bool(tail)}'
        short.append(middle_cut(name, limit))
    return short


def _limits(panel: Panel) -> tuple[float, float]:
    values = np.concatenate([line.y[np.isfinite(line.y)] for line in panel.lines])
    if not len(values):
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    if panel.log:
        # Beyond seven decades only rounding is left to see.
        low = max(low, high * 1e-7, 1e-12)
        return low / 1.5, max(high, low * 2.0) * 1.5
    if panel.zero:
        # The band shows what the filter claims; before convergence it may be clipped, errors never are.
        bands = [float(np.nanmedian(line.band)) for line in panel.lines if line.band is not None]
        reach = max([abs(low), abs(high), *(1.3 * b for b in bands)])
        low, high = -reach, reach
    margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    return low - margin, high + margin


def _draw_lines(ax: Axes, panel: Panel) -> None:
    for line in reversed(panel.lines):
        x, y = broken(*thin(line.x, line.y))
        style = (0, (4, 3)) if line.dashed else 'solid'
        # Truth shows as a halo where the estimate covers it.
        width = 1.0 if line.dashed else 3.2 if line.color == 'truth' else 1.2
        if line.band is not None:
            bx, band = thin(line.x, line.band)
            ax.fill_between(bx, -band, band, color=_KEYS[line.color], alpha=0.16, linewidth=0)
        ax.plot(
            x,
            y,
            color=_KEYS[line.color],
            linewidth=width,
            linestyle=style,
            solid_joinstyle='round',
            alpha=0.6 if line.color == 'truth' else 1.0,
        )


def _label_lines(ax: Axes, panel: Panel) -> None:
    """Name each line at its right end, moved apart where they would overlap."""
    low, high = ax.get_ylim()
    ends = []
    for line in panel.lines:
        good = line.y[np.isfinite(line.y)]
        end = float(np.mean(good[-max(len(good) // 50, 1) :])) if len(good) else low
        ends.append(
            (np.log(max(end, low) / low) / np.log(high / low)) if panel.log else (end - low) / (high - low)
        )
    height = ax.get_position().height * ax.figure.get_figheight() * 72.0  # type: ignore[union-attr]
    places = spread(np.array(ends), 11.0 / height, 0.04, 0.96)
    names = short_names([line.name for line in panel.lines])
    for line, name, place in zip(panel.lines, names, places):
        color = _KEYS[line.color]
        ax.text(1.015, place, name, transform=ax.transAxes, va='center', fontsize=8.5, color=color)


def _dress(ax: Axes, panel: Panel) -> None:
    title = middle_cut(panel.title, _TITLE)
    ax.set_title(
        f'{title} [{panel.unit}]' if panel.unit else title,
        loc='left', fontsize=9.5, color=_KEYS['ink'], pad=6,
    )  # fmt: skip
    ax.grid(True, color=_KEYS['grid'], linewidth=0.7)
    ax.set_axisbelow(True)
    ax.tick_params(which='both', colors=_KEYS['muted'], length=0, labelsize=8.5)
    for side in ('left', 'bottom'):
        ax.spines[side].set_color(_KEYS['grid'])
    if panel.zero:
        ax.axhline(0.0, color=_KEYS['muted'], linewidth=0.8)
    ax.set_xlabel('time [s]', color=_KEYS['muted'], fontsize=8.5, labelpad=2)


def _margins(panel: Panel) -> tuple[float, float]:
    """Return the left and right margins (share of the width) that tick labels and line names need."""
    longest = max(map(len, short_names([line.name for line in panel.lines])), default=0)
    # About 4.9 points a character of the 8.5 point face.
    return 44.0 / (_PANEL[0] * 72.0), (8.0 + 4.9 * longest) / (_PANEL[0] * 72.0)


def draw(panels: Sequence[Panel], columns: int = 1) -> Figure:
    """Return a figure with all panels in a grid of `columns`."""
    rows = -(-len(panels) // columns)
    with mpl.rc_context(_STYLE):
        fig = Figure(figsize=(_PANEL[0] * columns, _PANEL[1] * rows))
        fig.patch.set_facecolor(_KEYS['panel'])
        left, right = (max(m) for m in zip(*(_margins(p) for p in panels)))
        for index, panel in enumerate(panels):
            row, column = divmod(index, columns)
            box = (
                (column + left) / columns,
                (rows - 1 - row + 0.19) / rows,
                (1.0 - left - right) / columns,
                0.66 / rows,
            )
            ax = fig.add_axes(box)
            ax.set_facecolor('none')
            if panel.log:
                ax.set_yscale('log')
            _draw_lines(ax, panel)
            ax.set_ylim(*_limits(panel))
            ax.margins(x=0.01)
            if panel.span is not None:
                margin = 0.01 * (panel.span[1] - panel.span[0])
                ax.set_xlim(panel.span[0] - margin, panel.span[1] + margin)
            _dress(ax, panel)
            _label_lines(ax, panel)
        return fig


def svg(panel: Panel, alt: str) -> str:
    """Return one panel as an inline <svg> whose colours are the page's CSS variables."""
    buffer = io.StringIO()
    with mpl.rc_context(_STYLE):
        fig = draw([panel])
        fig.patch.set_alpha(0.0)
        fig.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None})
    text = buffer.getvalue()
    text = text[text.index('<svg') :]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    text = re.sub(r'\s(xmlns(:\w+)?|version|width|height)="[^"]*"', '', text, count=5)
    text = re.sub(r'#0000[0-9a-f]{2}', lambda m: f'var(--{_NAMES[m[0]]})' if m[0] in _NAMES else m[0], text)
    text = re.sub(r'font: ([\d.]+)px[^;\"]*', r'font-size: \1px', text)
    text = re.sub(r'\n\s*', '\n', text)
    return text.replace('<svg', f'<svg role="img" aria-label="{alt}"', 1)


def png(panels: Sequence[Panel], path: Path, columns: int) -> None:
    """Write the panels as one PNG in the light palette."""
    import PIL.Image

    fig = draw(panels, columns)
    for artist in fig.findobj():
        _paint(artist)
    buffer = io.BytesIO()
    fig.savefig(buffer, format='png', dpi=160)
    buffer.seek(0)
    # A palette of its own makes a line drawing a third of the size.
    picture = PIL.Image.open(buffer).convert('RGB')
    picture.quantize(128, dither=PIL.Image.Dither.NONE).save(path, optimize=True)


def _real(color: object) -> str | None:
    """Return the light palette's colour for a placeholder."""
    try:
        code = mpl.colors.to_hex(color)  # type: ignore[arg-type]
    except ValueError:
        return None
    return LIGHT[_NAMES[code]] if code in _NAMES else None


def _paint(artist: object) -> None:
    for kind in ('color', 'facecolor', 'edgecolor'):
        getter, setter = getattr(artist, f'get_{kind}', None), getattr(artist, f'set_{kind}', None)
        if getter is None or setter is None:
            continue
        value = getter()
        if isinstance(value, np.ndarray) and value.ndim == 2:
            value = value[0] if len(value) else None
        real = _real(value) if value is not None else None
        if real is not None:
            setter(real)
