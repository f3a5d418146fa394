# SPDX-License-Identifier: Apache-2.0
"""The licences of everything that the locked pins install, as a table.

Licences are those that the packages state of themselves: metadata of the wheel, or the package.xml that a
ROS wheel installs. A pin that another Python than this one needs keeps the row that it has.
"""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

HEAD = ('| package | version | licence |', '|---|---|---|')
_PIN = re.compile(r'^([A-Za-z0-9_.-]+)==([^ ;\\]+)(?: ; ([^\\]+))?')
_PYTHONS = ('3.11', '3.12', '3.13')
# Words of the trove classifiers and of free text, in the identifiers of SPDX.
_SPDX = {
    'Apache Software License': 'Apache-2.0',
    'Apache License, Version 2.0': 'Apache-2.0',
    'Apache License 2.0': 'Apache-2.0',
    'Apache 2.0': 'Apache-2.0',
    'MIT License': 'MIT',
    'BSD License': 'BSD',
    'Python Software Foundation License': 'PSF-2.0',
    'Mozilla Public License 2.0 (MPL 2.0)': 'MPL-2.0',
    'The Unlicense (Unlicense)': 'Unlicense',
    'GNU General Public License (GPL)': 'GPL',
}


class LicenceError(ValueError):
    """A pin has no known licence; the message names it."""


def _applies(marker: str | None) -> bool:
    """Return whether a pin is installed on Linux by any Python that is supported."""
    if marker is None:
        return True
    # Needed by this table alone, and by no one who runs an estimator.
    from packaging.markers import Marker

    linux = {'sys_platform': 'linux', 'platform_system': 'Linux', 'os_name': 'posix'}
    linux |= {'platform_machine': 'x86_64', 'implementation_name': 'cpython'}
    parsed = Marker(marker)
    return any(
        parsed.evaluate({**linux, 'python_version': p, 'python_full_version': f'{p}.9'}) for p in _PYTHONS
    )


def pins(lock: Path) -> dict[str, list[str]]:
    """Return the versions of each pinned package that Linux installs, in the order of the file."""
    found: dict[str, list[str]] = {}
    for line in lock.read_text(encoding='utf-8').splitlines():
        pin = _PIN.match(line)
        if pin is not None and _applies(pin[3]):
            found.setdefault(pin[1], []).append(pin[2])
    return found


def _stated(fields: Any) -> str | None:
    """Return the licence that the metadata of a wheel states."""
    if fields.get('License-Expression'):
        return str(fields['License-Expression'])
    named = [c.split(' :: ')[-1] for c in fields.get_all('Classifier') or () if c.startswith('License ::')]
    named = [_SPDX.get(name, name) for name in named if name != 'OSI Approved']
    text = (fields.get('License') or '').strip()
    short = text if text and '\n' not in text and len(text) < 40 and text != 'UNKNOWN' else None
    if named:
        # "BSD" in a classifier says less than the text beside it.
        return short if short and named == ['BSD'] and short.startswith('BSD-') else ', '.join(named)
    return _SPDX.get(short, short) if short else None


def _of_package_xml(name: str) -> str | None:
    """Return the licence in the package.xml of a ROS wheel (ros-foo-bar or ros-jazzy-foo-bar)."""
    package = re.sub(r'^ros-(jazzy-)?', '', name).replace('-', '_')
    path = Path(sys.prefix) / 'share' / package / 'package.xml'
    if not name.startswith('ros-') or not path.is_file():
        return None
    named = [(entry.text or '').strip() for entry in ET.parse(path).getroot().iter('license')]
    return ', '.join(_SPDX.get(text, text) for text in named) or None


def licence_of(name: str, versions: Sequence[str]) -> str | None:
    """Return the licence of a package, None where none of `versions` is installed or it says nothing."""
    try:
        fields = metadata(name)
    except PackageNotFoundError:
        return None
    if fields['Version'] not in versions:
        return None
    return _stated(fields) or _of_package_xml(name)


def _rows(body: str) -> Iterator[tuple[str, str]]:
    for line in body.splitlines():
        cells = [cell.strip() for cell in line.strip('|').split('|')]
        if len(cells) == 3:
            yield cells[0], cells[2]


def licence_table(lock: Path, body: str = '') -> str:
    """Return the table of the pins in `lock`; `body` is the table so far. Raises LicenceError."""
    known = dict(_rows(body))
    lines = list(HEAD)
    for name, versions in sorted(pins(lock).items()):
        # Where each Python has a version of its own, each would word the licence as its own does.
        kept = known.get(name) if len(set(versions)) > 1 else None
        licence = kept or licence_of(name, versions) or known.get(name)
        if licence is None:
            raise LicenceError(f"'{name}' states no licence here; write its row by hand once")
        lines.append(f'| {name} | {", ".join(dict.fromkeys(versions))} | {licence} |')
    return '\n'.join(lines)
