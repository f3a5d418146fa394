# SPDX-License-Identifier: Apache-2.0
"""``ros2 run node_core compose PACKAGE/NODE …``: several nodes in one process, in one executor thread.

The nodes are those of the executables, built by the same ``build()``; they still talk over DDS, so their
outputs are the same as those of separate processes. Names and values for one of them carry its name:
``-p attitude_estimator:accel_noise:=0.05``, ``-r attitude_estimator:imu/data:=ours``.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

from node_core.spin import fail, run

_NAME = re.compile(r'[a-z]\w*/[a-z]\w*')


def builder(name: str) -> Callable[[], Any]:
    """Return the ``build`` of ``PACKAGE/NODE``; raise ValueError, in words for the user, without one."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"'{name}' is no PACKAGE/NODE")
    package, node = name.split('/')
    try:
        return importlib.import_module(f'{package}.nodes.{node}').build
    except ModuleNotFoundError as error:
        if error.name not in (package, f'{package}.nodes', f'{package}.nodes.{node}'):
            raise
        raise ValueError(f"package '{package}' has no node '{node}'") from None
    except AttributeError:
        raise ValueError(f"'{name}' cannot be composed: it is a program, not a node") from None


def compose(names: Sequence[str], argv: list[str]) -> int:
    """Run the named nodes in this process until it is told to stop; return the exit code."""
    try:
        builders = [builder(name) for name in names]
    except ValueError as error:
        return fail(str(error))
    return run(lambda: [build() for build in builders], argv)


def main() -> None:
    """Entry point."""
    names = []
    for argument in sys.argv[1:]:
        if argument.startswith('-'):
            break
        names.append(argument)
    if not names:
        sys.exit(fail('expected PACKAGE/NODE …, for example imu_kalman/attitude_estimator'))
    sys.exit(compose(names, [sys.argv[0], *sys.argv[1 + len(names) :]]))
