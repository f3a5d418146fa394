# SPDX-License-Identifier: Apache-2.0
"""Counts what colcon test really ran: fails when a package ran no test, and prints one closing line."""

import sys
import xml.etree.ElementTree as ET
from pathlib import Path


def packages(folders: list[Path]) -> list[str]:
    """Return the names of all packages below `folders`."""
    manifests = [
        m for folder in folders for m in [*folder.glob('package.xml'), *folder.glob('*/package.xml')]
    ]
    return sorted(ET.parse(m).getroot().findtext('name', '') for m in manifests)


def counts(result: Path) -> dict[str, int]:
    """Return the totals of one JUnit file."""
    suites = ET.parse(result).getroot().iter('testsuite')
    keys = ('tests', 'failures', 'errors', 'skipped')
    total = dict.fromkeys(keys, 0)
    for suite in suites:
        for key in keys:
            total[key] += int(suite.get(key, 0))
    return total


def main() -> int:
    """Print the table; return 1 when a test failed or a package ran none."""
    build, source, harness, *selected = sys.argv[1:]
    passed = failed = skipped = 0
    empty = []
    print('\npackage              passed  failed  skipped')
    for name in selected or packages([Path(source), Path(harness)]):
        result = Path(build) / name / 'pytest.xml'
        total = (
            counts(result)
            if result.exists()
            else dict.fromkeys(('tests', 'failures', 'errors', 'skipped'), 0)
        )
        bad = total['failures'] + total['errors']
        good = total['tests'] - bad - total['skipped']
        print(f'{name:20s} {good:6d}  {bad:6d}  {total["skipped"]:7d}')
        passed, failed, skipped = passed + good, failed + bad, skipped + total['skipped']
        if good + bad == 0:
            empty.append(name)
    for name in empty:
        print(f'{name}: no test ran')
    print(f'{passed} passed, {failed + len(empty)} failed, {skipped} skipped')
    return 1 if failed or empty else 0


if __name__ == '__main__':
    sys.exit(main())
