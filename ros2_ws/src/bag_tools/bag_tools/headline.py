# SPDX-License-Identifier: Apache-2.0
"""The figures of the front page and of the report: paper, best peer and this workspace, side by side.

The choice is a YAML list (docs/headline.yaml) of::

    - system: INS/GPS               # as readers call it
      package: ins_gps              # with `name`: a row of docs/results/bench.json
      name: 'paper table: proposed, mean error'
      paper: printed in the paper   # a reference of that row, or {row: NAME}, or {printed: '2-3 s'}
      peers: [VQF, imufusion]       # references made by others; the best of them is shown

`paper` and `peers` may be left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


class HeadlineError(ValueError):
    """A chosen figure is not stored; the message names it."""


@dataclass(frozen=True, slots=True)
class Headline:
    """One line: texts with units, except `met`, which is None without a bar."""

    system: str
    figure: str
    paper: str
    peer: str
    here: str
    bar: str
    met: bool | None
    date: str


def suffix(unit: str) -> str:
    """Return `unit` as it stands behind a number: a degree sign without a space."""
    return unit if not unit or unit.startswith('°') else f' {unit}'


def _amount(value: float | None, unit: str) -> str:
    if value is None:
        return 'no result'
    return f'{value:.4g}{suffix(unit)}'


def _paper(wish: Mapping[str, Any], row: Mapping[str, Any], stored: Mapping[tuple, Mapping]) -> str:
    paper = wish.get('paper')
    if paper is None:
        return '–'
    if isinstance(paper, str):
        if paper not in row['reference']:
            raise HeadlineError(f"'{row['name']}' has no reference '{paper}'")
        return _amount(row['reference'][paper], row['unit'])
    if 'printed' in paper:
        return str(paper['printed'])
    other = stored.get((wish['package'], paper['row']))
    if other is None:
        raise HeadlineError(f"no stored figure '{paper['row']}' of {wish['package']}")
    return _amount(other['value'], other['unit'])


def _peer(wish: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    missing = [name for name in wish.get('peers', ()) if name not in row['reference']]
    if missing:
        raise HeadlineError(f"'{row['name']}' has no reference '{missing[0]}'")
    values = {n: row['reference'][n] for n in wish.get('peers', ()) if row['reference'][n] is not None}
    if not values:
        return '–'
    best = (min if row['better'] == 'lower' else max)(values, key=lambda name: values[name])
    return f'{best} {_amount(values[best], row["unit"])}'


def headlines(
    records: Sequence[Mapping[str, Any]], choice: Sequence[Mapping[str, Any]], *, partial: bool = False
) -> list[Headline]:
    """Return the chosen figures; raise HeadlineError for one that is not stored, or leave it out."""
    stored = {(record['package'], record['name']): record for record in records}
    lines = []
    for wish in choice:
        row = stored.get((wish['package'], wish['name']))
        if row is None:
            if partial:
                continue
            raise HeadlineError(f"no stored figure '{wish['name']}' of {wish['package']}")
        sign = '≤' if row['better'] == 'lower' else '≥'
        bar = '–' if row['bar'] is None else f'{sign} {_amount(row["bar"], row["unit"])}'
        met = None if row['bar'] is None else bool(row['pass'])
        lines.append(
            Headline(
                wish['system'],
                row['name'],
                _paper(wish, row, stored),
                _peer(wish, row),
                _amount(row['value'], row['unit']),
                bar,
                met,
                str(row.get('date', '')),
            )
        )
    return lines
