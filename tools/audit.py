# SPDX-License-Identifier: Apache-2.0
"""`./ws audit`: are weaknesses known of any pinned package?

Asks the advisories of the package index through pip-audit. Exit code 1 when a weakness is known. Where the
index does not answer nothing is known either: that is said, and is no failure, so that CI runs without it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

LOCKS = sorted((Path(__file__).resolve().parent.parent / 'requirements').glob('lock*.txt'))
# What a system Jazzy needs is part of the full lock.
_CONTAINED = 'lock-jazzy.txt'


def report(dependencies: list[dict[str, Any]]) -> tuple[list[str], int]:
    """Return a line per known weakness, and how many packages were looked up."""
    lines = []
    for package in dependencies:
        for weakness in package.get('vulns', ()):
            fixed = ', '.join(weakness['fix_versions']) or 'no version yet'
            lines.append(f'{package["name"]} {package["version"]}: {weakness["id"]}, mended in {fixed}')
    return lines, sum('skip_reason' not in package for package in dependencies)


def main() -> int:
    """Run pip-audit over the locks and print what it found."""
    command = [sys.executable, '-m', 'pip_audit', '--require-hashes', '--disable-pip', '-f', 'json']
    for lock in LOCKS:
        if lock.name != _CONTAINED:
            command += ['-r', str(lock)]
    done = subprocess.run(
        [*command, '--progress-spinner', 'off'], capture_output=True, text=True, check=False
    )
    try:
        dependencies = json.loads(done.stdout)['dependencies']
    except ValueError:
        said = (done.stderr.strip().splitlines() or ['no answer'])[-1]
        print(f'audit: no answer from the package index, nothing was looked up ({said})')
        return 0
    lines, known = report(dependencies)
    print('\n'.join(lines), end='\n' if lines else '')
    print(f'audit: {known} of {len(dependencies)} packages looked up, {len(lines)} weaknesses known')
    return 1 if lines else 0


if __name__ == '__main__':
    sys.exit(main())
