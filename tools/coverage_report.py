# SPDX-License-Identifier: Apache-2.0
"""`./ws coverage [PACKAGE …]`: statement and branch coverage of kalman_core and the algorithm modules.

Compiled kernels cannot be traced. The tests are therefore run with NUMBA_DISABLE_JIT=1, where the kernels are
plain Python and slow: a test that is not done within its time is stopped, what it has covered by then counts,
and its file is run once more as it is, for all that is no kernel. Tests that start nodes run as they are, and
their processes are measured too; the files of the nodes themselves are glue and left out.
Exit code 1 below the bar; the figures are kept in docs/results/bench.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bag_tools.bench import Row, keep

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / 'ros2_ws' / 'src'
PACKAGES = ('kalman_core', 'imu_kalman', 'ship_inclinometer', 'ev_velocity', 'ins_gps', 'quad_control')
BAR = 95.0  # %
_OMIT = ('*/nodes/*', '*/test/*', '*/fake_*', '*/fixtures.py', '*/replays.py', '*/importers.py')
# Seconds that one test may take without the compiler, and as many its fixtures.
_LIMIT = 15.0
# What limit_tests.py says of one that took longer.
_STOPPED = 'not done within'
# Words of tests that start nodes: these keep their pace, and so the compiler.
_LIVE = ('rclpy.init', 'node_core.testing', 'chromium')


def _environment(package: str, folder: Path) -> dict[str, str]:
    paths = [str(SOURCE / p) for p in (*PACKAGES, 'node_core', 'bag_tools')]
    settings = folder / 'coveragerc'
    settings.write_text(
        f'[run]\nbranch = True\nparallel = True\nsigterm = True\npatch = subprocess\nsource = {package}\n'
        f'data_file = {folder / "data"}\nomit = {",".join(_OMIT)}\n'
        '[report]\nexclude_also =\n    if TYPE_CHECKING:\n    ^\\s*\\.\\.\\.$\n'
    )
    return {
        **os.environ,
        'PYTHONPATH': os.pathsep.join([*paths, os.environ.get('PYTHONPATH', '')]),
        'COVERAGE_RCFILE': str(settings),
    }


def _uncompiled(environment: dict[str, str], limit: float) -> dict[str, str]:
    path = os.pathsep.join([str(ROOT / 'tools'), environment['PYTHONPATH']])
    plugin = {'PYTEST_PLUGINS': 'limit_tests', 'TEST_LIMIT': f'{limit:g}', 'PYTHONPATH': path}
    return {**environment, **plugin, 'NUMBA_DISABLE_JIT': '1'}


def _starts_nodes(file: Path) -> bool:
    return any(word in file.read_text(encoding='utf-8') for word in _LIVE)


def _pytest(package: str, file: Path, environment: dict[str, str]) -> tuple[str, bool]:
    """Return the last line of the tests of `file`, and whether each was done within its time."""
    command = [sys.executable, '-m', 'coverage', 'run', '-m', 'pytest', '-q', '-rs', '-p', 'no:cacheprovider']
    done = subprocess.run(
        [*command, str(file)],
        cwd=SOURCE / package,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    last = next((line for line in reversed(done.stdout.splitlines()) if ' in ' in line), done.stdout[-200:])
    return last, _STOPPED not in done.stdout


def measure(package: str, limit: float) -> dict:
    """Run the tests of `package`; return coverage's JSON report."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compiled = _environment(package, folder)
        for file in sorted((SOURCE / package / 'test').glob('test_*.py')):
            whole = False
            if not _starts_nodes(file):
                said, whole = _pytest(package, file, _uncompiled(compiled, limit))
                print(f'{package}: {file.name}: {said}', flush=True)
            if not whole:
                said, _ = _pytest(package, file, compiled)
                print(f'{package}: {file.name}, compiled: {said}', flush=True)
        report = folder / 'report.json'
        for words in (['combine', '-q'], ['json', '-q', '-o', str(report)]):
            subprocess.run(
                [sys.executable, '-m', 'coverage', *words], env=compiled, cwd=SOURCE / package, check=True
            )
        return json.loads(report.read_text())


def _lines(report: dict, package: str) -> list[str]:
    lines = []
    for file, entry in sorted(report['files'].items()):
        summary = entry['summary']
        if summary['percent_covered'] < 100.0:
            missing = [str(n) for n in entry['missing_lines']]
            missing += [f'{a}->{b}' for a, b in entry['missing_branches'] if a not in entry['missing_lines']]
            lines.append(
                f'  {Path(file).name:32} {summary["percent_covered"]:5.1f} %  {", ".join(missing)[:160]}'
            )
    parts = ', '.join(f'{row.name} {row.value:.1f} %' for row in _rows(report, package))
    return [*lines, f'{package}: {parts}']


def _rows(report: dict, package: str) -> list[Row]:
    total = report['totals']
    statements = 100.0 * total['covered_lines'] / max(total['num_statements'], 1)
    branches = 100.0 * total['covered_branches'] / max(total['num_branches'], 1)
    return [
        Row(package, 'statements covered by tests', statements, '%', bar=BAR, better='higher'),
        Row(package, 'branches covered by tests', branches, '%', bar=BAR, better='higher'),
    ]


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog='./ws coverage', description='Measure the coverage of algorithms.')
    parser.add_argument('packages', nargs='*', help=f'default: {" ".join(PACKAGES)}')
    parser.add_argument('--limit', type=float, default=_LIMIT, help='s per test without the compiler')
    asked = parser.parse_args()
    if unknown := set(asked.packages) - set(PACKAGES):
        parser.error(f"no package '{min(unknown)}'; known: {', '.join(PACKAGES)}")
    low = False
    for package in asked.packages or PACKAGES:
        started = time.monotonic()
        report = measure(package, asked.limit)
        keep(_rows(report, package), time.monotonic() - started)
        print('\n'.join(_lines(report, package)), flush=True)
        low = low or report['totals']['percent_covered'] < BAR
    return 1 if low else 0


if __name__ == '__main__':
    sys.exit(main())
