# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package: the 10 degree test, all three filters side by side."""

from bag_tools.catalogue import Entry, Replay

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
