# SPDX-License-Identifier: Apache-2.0
"""`ros2 run` and `ros2 pkg`."""

import os
import sys
from pathlib import Path

from ament_index_python import PackageNotFoundError, get_package_prefix, get_packages_with_prefixes


def _executables(name: str) -> list[Path]:
    folder = Path(get_package_prefix(name)) / 'lib' / name
    return (
        sorted(p for p in folder.glob('*') if p.is_file() and os.access(p, os.X_OK))
        if folder.exists()
        else []
    )


def run(name: str, executable: str, argv: list[str]) -> int:
    """Replace this process by the executable, so that signals reach it directly."""
    try:
        found = [path for path in _executables(name) if path.name == executable]
    except PackageNotFoundError:
        print(f"Package '{name}' not found", file=sys.stderr)
        return 1
    if not found:
        print('No executable found', file=sys.stderr)
        return 1
    os.execv(found[0], [str(found[0]), *argv])
    return 1


def pkg_list(_arguments) -> int:
    """Print the names of all packages."""
    print('\n'.join(sorted(get_packages_with_prefixes())))
    return 0


def pkg_executables(arguments) -> int:
    """Print `package executable` lines."""
    names = [arguments.package] if arguments.package else sorted(get_packages_with_prefixes())
    try:
        for name in names:
            for path in _executables(name):
                print(name, path.name)
    except PackageNotFoundError:
        print(f"Package '{arguments.package}' not found", file=sys.stderr)
        return 1
    return 0


def pkg_prefix(arguments) -> int:
    """Print the install prefix of a package."""
    try:
        print(get_package_prefix(arguments.package))
    except PackageNotFoundError:
        print('Package not found', file=sys.stderr)
        return 1
    return 0
