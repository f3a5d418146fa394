# SPDX-License-Identifier: Apache-2.0
"""Removes cached machine code that numba would wrongly take for current.

Numba keys its cache by the file of a function, not by the kernels that the function calls: after a change
of one kernel its callers in other modules go on running the old one. ``python -m kalman_core.kernel_cache
FOLDER`` removes, package by package, every cache older than the newest module that it may have compiled in:
one of its own package or of kalman_core.
"""

import argparse
import sys
from pathlib import Path

_SHARED = 'kalman_core'


def _newest(folder: Path) -> float:
    return max((path.stat().st_mtime for path in folder.rglob('*.py')), default=0.0)


def remove_stale(source: Path) -> list[Path]:
    """Remove stale caches of all packages under `source` (the folder that holds them); return their paths.

    Raises NotADirectoryError when `source` is no folder.
    """
    if not source.is_dir():
        raise NotADirectoryError(f'{source} is not a folder of packages')
    shared = _newest(source / _SHARED / _SHARED)
    removed = []
    for package in sorted(path for path in source.iterdir() if (path / path.name).is_dir()):
        newest = max(shared, _newest(package / package.name))
        for index in sorted(package.rglob('__pycache__/*.nbi')):
            # The index is written again with every signature: the age of the code is that of its data files.
            files = [index, *index.parent.glob(f'{index.stem}.*.nbc')]
            if min(path.stat().st_mtime for path in files) < newest:
                for path in files:
                    path.unlink()
                removed.append(index)
    return removed


def main(arguments: list[str] | None = None) -> int:
    """Remove stale caches and say how many; 2 when the folder is none."""
    parser = argparse.ArgumentParser(description='Remove machine code that numba wrongly takes for current.')
    parser.add_argument('source', type=Path, help='the folder that holds the packages (ros2_ws/src)')
    try:
        removed = remove_stale(parser.parse_args(arguments).source)
    except NotADirectoryError as error:
        print(f'kernel_cache: {error}', file=sys.stderr)
        return 2
    if removed:
        print(f'kernel_cache: {len(removed)} kernels will be compiled anew')
    return 0


if __name__ == '__main__':
    sys.exit(main())
