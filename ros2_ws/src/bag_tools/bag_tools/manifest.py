# SPDX-License-Identifier: Apache-2.0
"""The manifest of recorded fixtures: how each bag was made, and the hash of its decoded content.

::

    ship_calm.mcap:
      seed: 7
      command: ros2 run imu_kalman ...
      text: what it is for
      content: sha256 of decoded fields
      messages: 1234
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from bag_tools.bag import BagError, BagReader
from bag_tools.content import combined, topic_hashes

NAME = 'manifest.yaml'


@dataclass(frozen=True, slots=True)
class Entry:
    """One fixture. `seed` is None for bags without randomness."""

    command: str
    content: str
    messages: int
    seed: int | None = None
    text: str = ''


def entry_of(bag: str | Path, command: str, *, seed: int | None = None, text: str = '') -> Entry:
    """Return the entry that describes `bag` as it is now."""
    with BagReader(bag) as reader:
        return Entry(command, combined(topic_hashes(reader)), reader.count, seed, text)


def read(folder: str | Path) -> dict[str, Entry]:
    """Return the entries by bag name; raise BagError for a missing or malformed manifest."""
    path = Path(folder) / NAME
    try:
        document = yaml.safe_load(path.read_text())
    except OSError as error:
        raise BagError(f'{path}: cannot be read ({error.strerror}); expected a manifest of bags') from error
    except (yaml.YAMLError, UnicodeDecodeError):
        raise BagError(f'{path}: is not YAML; expected a manifest of bags') from None
    if not isinstance(document, dict):
        raise BagError(f'{path}: is not a mapping of bag names')
    entries = {}
    for name, body in document.items():
        try:
            entries[str(name)] = Entry(**body)
        except TypeError as error:
            raise BagError(f"{path}: entry '{name}' is malformed ({error})") from None
    return entries


def write(folder: str | Path, entries: dict[str, Entry]) -> Path:
    """Write the manifest, names sorted; return its path."""
    path = Path(folder) / NAME
    document: dict[str, Any] = {}
    for name, entry in sorted(entries.items()):
        document[name] = {
            'seed': entry.seed,
            'command': entry.command,
            'text': entry.text,
            'messages': entry.messages,
            'content': entry.content,
        }
    temporary = path.with_suffix('.yaml.partial')
    temporary.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100))
    temporary.replace(path)
    return path


def verify(folder: str | Path) -> list[str]:
    """Return one line per fixture that is missing, undeclared or differs from its hash."""
    folder = Path(folder)
    problems = []
    entries = read(folder)
    for name, entry in sorted(entries.items()):
        if not (folder / name).exists():
            problems.append(f'{name}: in the manifest but not in {folder}')
            continue
        now = entry_of(folder / name, entry.command)
        if now.content != entry.content:
            problems.append(f'{name}: content {now.content[:12]} is not the declared {entry.content[:12]}')
    stray = {p.name for p in folder.glob('*.mcap')} - set(entries)
    problems += [f'{name}: not in the manifest' for name in sorted(stray)]
    return problems
