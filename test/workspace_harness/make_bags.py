# SPDX-License-Identifier: Apache-2.0
"""`./ws bags`: makes the fixtures in bags/ from their seeds, or checks that they still come out the same.

Each package lists its fixtures in ``PKG.fixtures.FIXTURES``: name → function that writes one bag to a path.
The function's docstring says what the bag is for; the seed stands in the function's module.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bag_tools import manifest
from bag_tools.bag import BagError
from bag_tools.content import compare

PACKAGES = ('imu_kalman', 'ship_inclinometer', 'ev_velocity', 'ins_gps', 'quad_control')
# Fixtures are cloned by every user.
_LIMIT = 10_000_000  # bytes, all together
# Largest difference of a number made elsewhere: a few roundings of a pseudorange (2e7 m) in double precision.
_ROUNDING = 1e-8


def root() -> Path:
    """Return the folder of the workspace."""
    return Path(os.environ['WS_ROOT'])


def fixtures() -> dict[str, tuple[str, Callable[[Path], None]]]:
    """Return (package, writer) by bag name."""
    found = {}
    for package in PACKAGES:
        if importlib.util.find_spec(f'{package}.fixtures') is not None:
            table = importlib.import_module(f'{package}.fixtures').FIXTURES
            found |= {f'{name}.mcap': (package, write) for name, write in table.items()}
    return found


def _text(write: Callable) -> str:
    return (write.__doc__ or '').strip().split('\n')[0]


def make(folder: Path, names: list[str]) -> dict[str, manifest.Entry]:
    """Write the named fixtures into `folder`; return their manifest entries."""
    table = fixtures()
    entries = {}
    for name in names or sorted(table):
        if name not in table:
            raise BagError(f"no fixture '{name}'; known: {', '.join(sorted(table))}")
        package, write = table[name]
        path = folder / name
        path.unlink(missing_ok=True)
        started = time.monotonic()
        write(path)
        entries[name] = manifest.entry_of(path, f'./ws bags {name}', text=f'{package}: {_text(write)}')
        print(
            f'{name:36s} {path.stat().st_size / 1e3:8.0f} kB  {time.monotonic() - started:5.1f} s', flush=True
        )
    return entries


def check(folder: Path, names: list[str]) -> list[str]:
    """Make the fixtures anew; return one line for each that differs from the recorded one.

    On the machine that recorded them they are equal to the last bit; elsewhere libraries may round
    otherwise, which _ROUNDING allows for.
    """
    problems = manifest.verify(folder)
    declared = manifest.read(folder)
    with tempfile.TemporaryDirectory() as temporary:
        for name, entry in make(Path(temporary), names or sorted(declared)).items():
            if name not in declared:
                problems.append(f'{name}: not in the manifest; run ./ws bags')
            elif entry.content != declared[name].content:
                results = compare(folder / name, Path(temporary) / name, tolerance=_ROUNDING)
                problems += [f'{name}: {r.topic}: {r.difference}' for r in results if not r.equal]
    return problems


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog='./ws bags', description='Make the recorded fixtures from their seeds.'
    )
    parser.add_argument('names', nargs='*', help='fixtures to make (default all)')
    parser.add_argument('--check', action='store_true', help='compare with the manifest, change nothing')
    arguments = parser.parse_args()
    folder = root() / 'bags'
    folder.mkdir(exist_ok=True)
    try:
        if arguments.check:
            problems = check(folder, arguments.names)
            print('\n'.join(problems) or 'all fixtures as declared')
            return 1 if problems else 0
        known = manifest.read(folder) if (folder / manifest.NAME).exists() else {}
        entries = {**known, **make(folder, arguments.names)}
        entries = {name: entry for name, entry in entries.items() if name in fixtures()}
        manifest.write(folder, entries)
    except BagError as error:
        print(f'./ws bags: {error}', file=sys.stderr)
        return 2
    total = sum(p.stat().st_size for p in folder.glob('*.mcap'))
    print(f'{len(entries)} fixtures, {total / 1e6:.2f} MB')
    return 0 if total < _LIMIT else 1


if __name__ == '__main__':
    sys.exit(main())
