# SPDX-License-Identifier: Apache-2.0
"""The vocabulary of a report page: numbers, tables, figures, style. One file, no script, no network."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence

from bag_tools.figures import DARK, LIGHT, Panel, svg


def number(value: float | None) -> str:
    """Return three significant digits, or a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return '–'
    if value == 0.0:
        return '0'
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f'{value:.{min(digits, 6)}f}' if abs(value) >= 1e-4 else f'{value:.2e}'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, names: int | None = None) -> str:
    """Return a table of HTML cells; the first `names` columns are text (default: one, or two of three).

    On a narrow screen a row becomes a card: its names, then each cell under the head of its column.
    """
    labels = [html.escape(html.unescape(re.sub('<[^>]*>', '', cell)), quote=True) for cell in head]
    kind = ' class="named"' if (names if names is not None else len(head) - 1) > 1 else ''
    top = ''.join(f'<th>{cell}</th>' for cell in head)
    body = ''.join(
        '<tr>' + ''.join(f'<td data-head="{label}">{c}</td>' for label, c in zip(labels, row)) + '</tr>'
        for row in rows
    )
    return (
        f'<div class="scroll"><table{kind}><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def chip(name: str, color: str) -> str:
    """Return a name with its colour (a name of the palette)."""
    return f'<span class="chip"><i style="background:var(--{color})"></i>{html.escape(name)}</span>'


def grid(panels: Sequence[Panel], about: str) -> str:
    """Return the panels as figures, side by side where the page is wide enough."""
    figures = ''.join(
        f'<figure>{svg(p, html.escape(f"{about}: {p.title}", quote=True))}</figure>' for p in panels
    )
    return f'<div class="grid">{figures}</div>'


def slug(text: str) -> str:
    """Return `text` as a file name and anchor."""
    return re.sub(r'[^a-z0-9]+', '_', text.lower()).strip('_') or 'run'


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
.chip{display:inline-flex;align-items:baseline;margin-right:.9em;overflow-wrap:anywhere}
.chip i{flex:none;width:.75em;height:.75em;border-radius:2px;margin-right:.4em}
@media (max-width:1000px){th,td{padding:.35em .5em}td,th{white-space:normal}
 .named td:nth-child(2){min-width:9em}}
@media (max-width:640px){thead{display:none}table,tbody{display:block}
 tr{display:grid;grid-template-columns:repeat(auto-fill,minmax(5em,1fr));gap:.15em .5em;padding:.5em .6em;
  border-bottom:1px solid var(--grid)}
 tbody tr:last-child{border-bottom:0}
 td{display:block;padding:0;border:0;text-align:left;font-size:.76rem;overflow-wrap:anywhere}
 td:empty{display:none}
 td:before{content:attr(data-head);display:block;color:var(--muted);font-size:.7rem;line-height:1.2}
 td:first-child,.named td:nth-child(2){grid-column:1/-1}
 td:first-child{font-size:.875rem;font-weight:600}
 td:first-child:before,.named td:nth-child(2):before{content:none}
}
.grid{margin:.6em 0;display:grid;gap:12px;
 grid-template-columns:repeat(auto-fill,minmax(min(100%%,440px),1fr))}
figure{margin:0;padding:8px;background:var(--panel);border:1px solid var(--grid);border-radius:8px}
.wide{min-width:680px}
details{margin:.8em 0}summary{cursor:pointer;font-weight:600;padding:.4em 0}
.missed{color:var(--s1);font-weight:600}
figure svg{display:block;width:100%%;height:auto;font-family:inherit}
"""


def _css() -> str:
    light, dark = (''.join(f'--{k}:{v};' for k, v in p.items()) for p in (LIGHT, DARK))
    return _CSS % {'light': light, 'dark': dark}


def document(title: str, body: str) -> str:
    """Return the whole page around `body` (HTML)."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<title>{html.escape(title)}</title><style>{_css()}</style></head><body>{body}</body></html>\n'
    )
