# SPDX-License-Identifier: Apache-2.0
"""Runs mypy over kalman_core, node_core and the algorithm modules of every package (not over nodes)."""

import os
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent / 'ros2_ws' / 'src'


def main() -> int:
    """Return mypy's exit code."""
    packages = [p.parent.name for p in sorted(SOURCE.glob('*/package.xml'))]
    os.environ['MYPYPATH'] = os.pathsep.join(str(SOURCE / name) for name in packages)
    arguments = [argument for name in packages for argument in ('-p', name)]
    command = [sys.executable, '-m', 'mypy', '--config-file', str(SOURCE.parent.parent / 'pyproject.toml')]
    return subprocess.run([*command, *arguments], check=False, cwd=SOURCE.parent.parent).returncode


if __name__ == '__main__':
    sys.exit(main())
