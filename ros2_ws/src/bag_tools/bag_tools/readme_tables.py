# SPDX-License-Identifier: Apache-2.0
"""Keeps generated parts of the documents current: parameters, topics, benchmark figures, default YAML.

In every README.md and every page under docs/ a block ::

    <!-- params:MODULE:CLASS -->
    <!-- ports:MODULE:NAME -->
    <!-- bench:PACKAGE -->
    <!-- headline:FILE -->
    <!-- recordings:FILE -->
    <!-- licences:LOCK -->

up to the next ``<!-- end -->`` is filled with a table: the parameters of a dataclass, the topics of a
`node_core.ports.Ports` (by attribute of the module, or by key of its ESTIMATORS), the stored figures of a
package, the few that FILE (a YAML list below docs/, see `bag_tools.headline`) chooses, the importers with
what they read (`bag_tools.recordings`), or the licences of the pins in LOCK.
``config/NODE.yaml`` is written for each node in `node_parameters`.
``./ws docs`` writes, ``./ws docs --check`` names the files that drift.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

from bag_tools.bench import RESULTS, BenchError, load_records, project_root
from bag_tools.headline import HeadlineError, headlines, suffix
from bag_tools.licences import LicenceError, licence_table
from bag_tools.recordings import RecordingsError, recordings_table
from kalman_core.parameters import default_yaml, markdown_table
from node_core.ports import Ports

_KINDS = 'params|ports|bench|headline|recordings|licences'
_BLOCK = re.compile(
    rf'^<!-- (?P<kind>{_KINDS}):(?P<what>\S+) -->\n(?P<body>.*?)^<!-- end -->$',
    re.DOTALL | re.MULTILINE,
)
_OPENING = re.compile(rf'^<!-- (?:{_KINDS}):\S+ -->$', re.MULTILINE)


class TableError(Exception):
    """A block or a configuration file cannot be made; the message names the file and what is wrong."""


def ports_table(ports: Ports) -> str:
    """Return the topics of an estimator as a table, inputs first."""
    rows = ['| topic | direction | type | remark |', '|---|---|---|---|']
    for port in ports.inputs:
        remark = f'stale after {port.timeout:g} s' if port.timeout else 'may be absent'
        rows.append(f'| `{port.topic}` | in | `{port.type}` | {remark} |')
    for estimate, output in ports.outputs.items():
        remark = _first_sentence(estimate) + (' (latched)' if output.latched else '')
        rows.append(f'| `{output.topic}` | out | `{output.type}` | {remark.strip()} |')
    return '\n'.join(rows)


def _first_sentence(cls: type) -> str:
    text = ' '.join((cls.__doc__ or '').split())
    if text.startswith(f'{cls.__name__}('):  # what dataclasses and named tuples put in by themselves
        return ''
    return re.split(r'(?<=[.:;]) ', text, maxsplit=1)[0].rstrip('.:;').replace('|', '\\|')


def _number(value: float | None) -> str:
    return 'no result' if value is None else f'{value:.4g}'


def bench_table(records: list[dict[str, Any]], package: str) -> str:
    """Return the stored figures of `package` as a table; missed bars are named as such."""
    rows = ['| figure | value | bar | met | in the same run |', '|---|---|---|---|---|']
    for entry in records:
        if entry['package'] != package:
            continue
        unit = suffix(entry['unit'])
        sign = '≤' if entry['better'] == 'lower' else '≥'
        bar = '–' if entry['bar'] is None else f'{sign} {entry["bar"]:g}{unit}'
        met = '–' if entry['bar'] is None and entry['pass'] else ('yes' if entry['pass'] else '**no**')
        peers = ', '.join(f'{peer} {_number(value)}' for peer, value in entry['reference'].items())
        cells = (entry['name'], f'{_number(entry["value"])}{unit}', bar, met, peers or '–')
        rows.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    if len(rows) == 2:
        return f'Not measured yet: `./ws bench {package}`.'
    return '\n'.join(rows)


def headline_table(records: list[dict[str, Any]], choice: list[dict[str, Any]]) -> str:
    """Return the chosen figures as a table; raise TableError for one that is not stored."""
    rows = ['| system | figure | paper | best peer | here | bar |', '|---|---|---|---|---|---|']
    try:
        lines = headlines(records, choice)
    except HeadlineError as error:
        raise TableError(str(error)) from None
    for line in lines:
        bar = f'{line.bar} **missed**' if line.met is False else line.bar
        rows.append(
            '| ' + ' | '.join((line.system, line.figure, line.paper, line.peer, line.here, bar)) + ' |'
        )
    return '\n'.join(rows)


def _listed(root: Path, what: str, table: Callable[[Any], str]) -> str:
    """Return `table` of the YAML list docs/`what`."""
    path = root / 'docs' / what
    try:
        return table(yaml.safe_load(path.read_text(encoding='utf-8')))
    except RecordingsError as error:
        raise TableError(f'{path.name}: {error}') from None
    except (OSError, yaml.YAMLError, TypeError, KeyError) as error:
        raise TableError(f'{path.name} is not such a list ({error})') from None


def _licences(lock: Path, body: str) -> str:
    try:
        return licence_table(lock, body)
    except (OSError, LicenceError) as error:
        raise TableError(str(error)) from None


def _attribute(what: str) -> tuple[Any, str]:
    module_name, _, name = what.partition(':')
    try:
        return importlib.import_module(module_name), name
    except ImportError as error:
        raise TableError(f'module {module_name} cannot be imported ({error})') from None


def _params(what: str) -> str:
    module, name = _attribute(what)
    cls = getattr(module, name, None)
    if not isinstance(cls, type):
        raise TableError(f'{module.__name__} has no class {name}')
    return markdown_table(cls)


def _ports(what: str) -> str:
    module, name = _attribute(what)
    ports = getattr(module, name, None) or getattr(module, 'ESTIMATORS', {}).get(name)
    if not isinstance(ports, Ports):
        raise TableError(f'{module.__name__} has no Ports named {name}')
    return ports_table(ports)


def fill(text: str, records: list[dict[str, Any]], root: Path = Path()) -> str:
    """Return a document with every block filled; raise TableError naming the block that cannot be."""
    makers: dict[str, Callable[[str, str], str]] = {
        'params': lambda what, _: _params(what),
        'ports': lambda what, _: _ports(what),
        'bench': lambda what, _: bench_table(records, what),
        'headline': lambda what, _: _listed(root, what, lambda choice: headline_table(records, choice)),
        'recordings': lambda what, _: _listed(root, what, lambda entries: recordings_table(entries, root)),
        'licences': lambda what, body: _licences(root / what, body),
    }

    def filled(match: re.Match[str]) -> str:
        kind, what = match['kind'], match['what']
        opening = f'<!-- {kind}:{what} -->'
        if _OPENING.search(match['body']):
            raise TableError(f'{opening} is not closed by <!-- end -->')
        try:
            body = makers[kind](what, match['body'])
        except TableError as error:
            raise TableError(f'{opening}: {error}') from None
        return f'{opening}\n{body}\n<!-- end -->'

    text = _BLOCK.sub(filled, text)
    if len(_OPENING.findall(text)) != len(_BLOCK.findall(text)):
        raise TableError('a block is not closed by <!-- end -->')
    return text


def documents(root: Path) -> list[Path]:
    """Return the documents that may hold blocks."""
    pages = [*root.glob('README.md'), *root.glob('*/README.md'), *root.glob('ros2_ws/src/*/README.md')]
    return sorted({*pages, *root.glob('docs/**/*.md')})


def node_parameters(package: str) -> dict[str, type]:
    """Return the parameter dataclass of each configured node of `package`, by name of the node.

    These are the estimators of its codec and what its ``codec.NODE_PARAMETERS`` adds (simulators, drivers).
    """
    codec, _ = _attribute(f'{package}.codec')
    estimators = {ports.name: ports.params for ports in getattr(codec, 'ESTIMATORS', {}).values()}
    return {**estimators, **getattr(codec, 'NODE_PARAMETERS', {})}


def _packages_with_codec(root: Path) -> list[str]:
    return sorted(path.parent.name for path in (root / 'ros2_ws' / 'src').glob('*/*/codec.py'))


def wanted(root: Path) -> Iterator[tuple[Path, str]]:
    """Yield (path, content it should have) of every generated file; raise TableError naming a bad one."""
    try:
        records = load_records(root / RESULTS)
    except BenchError as error:
        raise TableError(str(error)) from None
    for path in documents(root):
        try:
            yield path, fill(path.read_text(encoding='utf-8'), records, root)
        except TableError as error:
            raise TableError(f'{path.relative_to(root)}: {error}') from None
    for package in _packages_with_codec(root):
        for node, params in node_parameters(package).items():
            path = root / 'ros2_ws' / 'src' / package / 'config' / f'{node}.yaml'
            yield path, default_yaml(params, node)


def drifted(root: Path) -> list[tuple[Path, str]]:
    """Return (path, content it should have) of every generated file that is not as it should be."""
    return [
        (path, content)
        for path, content in wanted(root)
        if not path.exists() or path.read_text(encoding='utf-8') != content
    ]


def main(arguments: list[str] | None = None) -> int:
    """Write what drifts, or with ``--check`` only name it; 0 when all is current, 1 on drift, 2 on errors."""
    parser = argparse.ArgumentParser(prog='./ws docs', description='Fill the generated tables.')
    parser.add_argument('--check', action='store_true', help='write nothing, name the files that drift')
    check = parser.parse_args(arguments).check
    try:
        root = project_root()
        drift = drifted(root)
    except (BenchError, TableError) as error:
        print(f'docs: {error}', file=sys.stderr)
        return 2
    for path, content in drift:
        if not check:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding='utf-8')
        print(f'{"drifts" if check else "written"}: {path.relative_to(root)}')
    return 1 if check and drift else 0


if __name__ == '__main__':
    sys.exit(main())
