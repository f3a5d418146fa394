# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package: its fixtures through both schedules."""

from bag_tools.catalogue import Entry, Replay

_TRUTH = '/truth/orientation'
_PARTS = ('inclination', 'heading')
_PLAIN = (
    Entry('published', 'attitude_estimator', 'imu/data', {'schedule': 'published'}),
    Entry('full', 'attitude_estimator', 'imu/data'),
)
# Lever arm of the simulated antenna from the simulated IMU, and the receiver's delay.
_GNSS = {'antenna_lever_arm': (10.0, 3.0, 10.0), 'gnss_delay': 0.2}
_TURN = (_PLAIN[0], Entry('full', 'attitude_estimator', 'imu/data', _GNSS))

REPLAYS = (
    Replay('ship_beam_sea', 'irregular beam sea, no GNSS', _TRUTH, _PLAIN, _PARTS, after=60.0),
    Replay('ship_turn_gnss', 'turn at 8 m/s with GNSS velocity', _TRUTH, _TURN, _PARTS, after=40.0),
    Replay('ship_magnetic_disturbance', 'a field of 15 µT passes', _TRUTH, _PLAIN, _PARTS, after=60.0),
)
