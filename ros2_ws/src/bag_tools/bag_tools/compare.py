# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools compare A B``: are two bags equal to the last bit in their decoded fields?"""

from __future__ import annotations

import argparse
import sys

from bag_tools.bag import BagError
from bag_tools.cli import guarded
from bag_tools.content import compare

EXIT_DIFFERENT = 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='compare',
        description='Compare two bags in decoded fields. Exit code 0: equal, 1: different, 2: unusable.',
    )
    parser.add_argument('a', help='a bag')
    parser.add_argument('b', help='another bag')
    parser.add_argument('--topics', nargs='+', help='only these (default: all but /diagnostics, /clock, ...)')
    parser.add_argument('--stamps', action='store_true', help='bag times have to be equal too')
    parser.add_argument(
        '--tolerance', type=float, default=0.0, help='allowed absolute difference of numbers (default 0)'
    )
    return parser


def run(argv: list[str]) -> int:
    """Compare, print one line per topic, return the exit code."""
    options = _parser().parse_args(argv)
    if not options.tolerance >= 0.0:
        raise BagError(f'--tolerance is {options.tolerance:g}, allowed: >= 0')
    results = compare(
        options.a, options.b, options.topics, stamps=options.stamps, tolerance=options.tolerance
    )
    if not results:
        raise BagError(f'{options.a}, {options.b}: no topic to compare')
    width = max(len(r.topic) for r in results)
    for r in results:
        verdict = 'equal' if r.equal else 'DIFFERENT'
        print(f'{r.topic:{width}}  {verdict}  {r.count_a} messages  {r.difference}'.rstrip())
    return 0 if all(r.equal for r in results) else EXIT_DIFFERENT


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('compare', run, argv)


if __name__ == '__main__':
    sys.exit(main())
