# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package: fixtures, and recordings with an optical reference."""

from dataclasses import replace
from pathlib import Path

from bag_tools.catalogue import Entry, Recorded, Replay

_ENTRIES = (
    Entry('published', 'angle_estimator', 'imu/data', {'variant': 'published'}),
    Entry('corrected', 'angle_estimator', 'imu/data', {'variant': 'corrected'}),
    Entry('attitude', 'attitude_estimator', 'imu/data'),
)
# The simulated sensors have no delay; the defaults are those of a recorded one.
_PROMPT = (*_ENTRIES[:2], replace(_ENTRIES[2], params={'sensor_delay': 0.0, 'mag_delay': 0.0}))
_TRUTH = '/truth/orientation'
# Errors count once every estimator has had time to start, as BENCHMARKS.md has it for the ship.
_SETTLED = 10.0  # s
_TILT_AND_HEADING = ('inclination', 'heading')

REPLAYS = (
    Replay('imu_tilt', 'tilt steps of 30 degrees', _TRUTH, _PROMPT, _TILT_AND_HEADING, after=_SETTLED),
    Replay('imu_hand_held', 'turned and swung in a hand', _TRUTH, _PROMPT, _TILT_AND_HEADING, after=_SETTLED),
    Replay(
        'imu_rolling_ship', 'started on a rolling ship', _TRUTH, _PROMPT, _TILT_AND_HEADING, after=_SETTLED
    ),
    Replay('imu_bad_data', 'faults between clean data', _TRUTH, _PROMPT, _TILT_AND_HEADING, after=_SETTLED),
)


def _broad(bag: Path) -> Replay:
    """Return the replay of an imported BROAD trial, scored while it moves."""
    return Replay(
        bag.stem,
        'recorded motion with optical reference',
        _TRUTH,
        _ENTRIES,
        ('total', 'heading', 'inclination'),
        where='/truth/movement',
    )


# At 285 Hz twice.
RECORDED = (Recorded('imu/broad_*.npz', 'broad', _broad, live_seconds=5.0),)
