# SPDX-License-Identifier: Apache-2.0
"""How often a lock-step replay through live processes equals the offline runner to the last bit."""

import tempfile
from collections.abc import Iterable
from pathlib import Path

from bag_tools.bench import Options, Row

RUNS = 20
SECONDS = 5.0  # of each fixture: starting the processes takes longer than replaying it


def lockstep_rows(options: Options) -> Iterable[Row]:
    """Replay the beginning of each fixture through the live graph again and again."""
    from workspace_harness.domain import own_domain
    from workspace_harness.make_bags import root
    from workspace_harness.replay import cut, differences, live, offline_all
    from workspace_harness.systems import fixtures

    runs = 1 if options.quick else RUNS
    jobs = fixtures(root() / 'bags', ['imu_kalman'])
    equal = 0
    with tempfile.TemporaryDirectory() as temporary, own_domain():
        folder = Path(temporary)
        for job in jobs:
            bag = cut(job.bag, SECONDS, folder / f'{job.bag.stem}.mcap')
            offline_all(bag, job.estimators(), folder)
            for _ in range(runs):
                live(bag, job.estimators(), folder / 'live.mcap')
                equal += not differences(folder / 'live.mcap', folder, job.estimators())
    yield Row(
        'imu_kalman',
        f'lock-step replays equal to offline to the last bit ({len(jobs)} fixtures × {runs})',
        equal,
        'replays',
        len(jobs) * runs,
        'higher',
    )
