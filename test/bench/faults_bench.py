# SPDX-License-Identifier: Apache-2.0
"""Every fault in every system: how many of the stated results held; writes docs/results/faults.md."""

from __future__ import annotations

from collections.abc import Iterable

from faults.campaign import TABLE, run_all, table
from faults.cases import cases, short_cases
from workspace_harness.make_bags import root

from bag_tools.bench import Options, Row


def measure(options: Options) -> Iterable[Row]:
    """Run all cases; with --quick those of the tests, and no table."""
    chosen = short_cases() if options.quick else cases()
    outcomes = run_all(chosen, lambda text: print(f'  {text}', flush=True))
    if not options.quick:
        path = root() / TABLE
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(table(outcomes), encoding='utf-8')
    held = sum(outcome.held for outcome in outcomes)
    yield Row('workspace_harness', 'fault cases held', held, 'cases', bar=len(chosen), better='higher')
