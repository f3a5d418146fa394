# SPDX-License-Identifier: Apache-2.0
"""The HTML report of `./ws run`: one section per bag, all estimators of it together."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from bag_tools.report import RunResult, nis_of, write_report

if TYPE_CHECKING:
    from workspace_harness.run import Result


def section(results: Sequence[Result]) -> RunResult:
    """Return one section from the results of one job; the family's own estimator stands last in the job."""
    job = results[0].job
    ordered = list(reversed(results))
    equal = all(not r.differences for r in results)
    timing = {
        f'{r.entry.label}: offline, per message [µs]': 1e6
        * r.offline.seconds
        / sum(r.offline.inputs.values())
        for r in ordered
    }
    part = f' over its first {job.live_seconds:g} s' if job.live_seconds else ''
    verdict = (
        f'equals the offline runner to the last bit{part}' if equal else 'DIFFERS from the offline runner'
    )
    return RunResult(
        name=f'{job.system} · {job.bag.stem}',
        comparisons={r.entry.label: [r.comparison] for r in ordered},
        text=f'{job.replay.title[0].upper()}{job.replay.title[1:]}. The live graph {verdict}.',
        nis=nis_of(ordered[0].offline),
        timing=timing,
    )


def write(results: Sequence[Result], out: Path) -> Path:
    """Write the page and its pictures below `out`; return the page's path."""
    runs = [section(list(group)) for _, group in groupby(results, key=lambda r: r.job.bag)]
    title = 'Estimators on recorded and simulated data'
    return write_report(out / 'report.html', runs, title, pngs=out / 'plots')
