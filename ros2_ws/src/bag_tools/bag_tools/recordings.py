# SPDX-License-Identifier: Apache-2.0
"""The table of public recordings: what each importer of the workspace reads, whose it is, and the command.

The list is YAML: ``{recording, importers: [NAME or PACKAGE:NAME], source, licence, command}``. Every importer
has to stand in it, so that none is found only by reading code.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bag_tools.bag import BagError
from bag_tools.import_data import FOLDER
from bag_tools.registry import find_importer


class RecordingsError(ValueError):
    """The list and the importers do not fit; the message names the importer."""


def importers(packages: Sequence[str]) -> set[str]:
    """Return the names of all importers as ``ros2 run bag_tools import`` takes them."""
    found = {path.stem for path in FOLDER.glob('*.yaml')}
    for package in packages:
        if importlib.util.find_spec(f'{package}.importers') is not None:
            offered = importlib.import_module(f'{package}.importers').IMPORTERS
            found |= {f'{package}:{name}' for name in offered}
    return found


def _check(entries: Sequence[Mapping[str, Any]], packages: Sequence[str]) -> None:
    listed = [name for entry in entries for name in entry['importers']]
    for name in listed:
        package, mark, importer = name.partition(':')
        try:
            if mark:
                find_importer(package, importer)
            elif not (FOLDER / f'{name}.yaml').exists():
                raise RecordingsError(f"there is no mapping '{name}'")
        except BagError as error:
            raise RecordingsError(str(error)) from None
    missing = importers(packages) - set(listed)
    if missing:
        raise RecordingsError(f"importer '{min(missing)}' is not in the list")


def recordings_table(entries: Sequence[Mapping[str, Any]], root: Path) -> str:
    """Return the list as a table; raise RecordingsError when an importer is missing or not there."""
    packages = sorted(path.parent.name for path in (root / 'ros2_ws' / 'src').glob('*/*/importers.py'))
    _check(entries, packages)
    rows = ['| recording | licence | source | import |', '|---|---|---|---|']
    for entry in entries:
        cells = (
            entry['recording'],
            entry['licence'],
            entry['source'],
            f'`ros2 run bag_tools import {entry["command"]}`',
        )
        rows.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(rows)
