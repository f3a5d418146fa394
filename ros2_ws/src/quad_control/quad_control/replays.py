# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package: the 10 degree test and recorded flights, all three filters."""

from dataclasses import replace
from pathlib import Path

from bag_tools.align import HEADING, LAG, MOUNTING
from bag_tools.catalogue import Entry, Recorded, Replay

_ENTRIES = tuple(
    Entry(name, 'attitude_filter', 'imu/data', {'filter': name})
    for name in ('published', 'corrected', 'gyro_driven')
)
# Errors count once the still second is over and the motors turn.
_SETTLED = 2.5  # s

REPLAYS = (
    Replay(
        'quad_stand_10deg',
        'the 10 degree test on the stand',
        '/truth/odometry',
        _ENTRIES,
        ('inclination',),
        after=_SETTLED,
    ),
    Replay(
        'quad_free_10deg',
        'the 10 degree test in free flight',
        '/truth/odometry',
        _ENTRIES,
        ('inclination',),
        after=_SETTLED,
    ),
)

# The IMU of these flights samples at 120 Hz.
_FLIGHT_ENTRIES = tuple(replace(e, params={**e.params, 'period': 1.0 / 120.0}) for e in _ENTRIES)


def _flight(bag: Path) -> Replay:
    """Return the replay of a recorded flight.

    Its IMU was glued on, the autopilot keeps its own time, and without a magnetometer the heading is that
    since the start.
    """
    return Replay(
        bag.stem,
        "recorded flight with the autopilot's attitude",
        '/truth/orientation',
        _FLIGHT_ENTRIES,
        ('inclination',),
        solve=(MOUNTING, HEADING, LAG),
    )


RECORDED = (
    Recorded('quad/phantom4rtk/H*_IMU_1.csv', 'quad_control:phantom4rtk', _flight, live_seconds=10.0),
)
