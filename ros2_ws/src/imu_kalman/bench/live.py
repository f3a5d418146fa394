# SPDX-License-Identifier: Apache-2.0
"""What the attitude node costs as a process, beside a bare relay with the same topics."""

import os
from collections.abc import Iterable

from bag_tools.bench import Options, Row

RATE = 500.0  # Hz, issue of the foundation: the node at 500 Hz
MAG_EVERY = 5  # magnetometer at 100 Hz


def _fill_imu(message, index):
    message.angular_velocity.x = 0.01 * (index % 7)
    message.linear_acceleration.z = 9.81


def _fill_mag(message, index):
    message.magnetic_field.y = 20e-6 + 1e-9 * (index % 5)
    message.magnetic_field.z = -45e-6


def live_rows(options: Options) -> Iterable[Row]:
    """Measure CPU ratio, latency and loss of `attitude_estimator` at 500 Hz."""
    from node_core.live_bench import Feed, compare
    from node_core.testing import Process

    # Field checks are for tests; a user's graph runs without them.
    os.environ.pop('ROS_PYTHON_CHECK_FIELDS', None)
    feeds = [
        Feed('sensor_msgs/msg/Imu', 'imu/data_raw', _fill_imu),
        Feed('sensor_msgs/msg/MagneticField', 'imu/mag', _fill_mag, MAG_EVERY),
    ]
    count = round(RATE) * (4 if options.quick else 30)

    def start() -> Process:
        return Process.node('imu_kalman', 'attitude_estimator')

    ours, bare = compare(start, feeds, ('sensor_msgs/msg/Imu', 'imu/data'), RATE, count)
    name = 'attitude_estimator at 500 Hz'
    yield Row('imu_kalman', f'{name}: CPU ratio to a bare relay', ours.cpu / bare.cpu, '', 1.25)
    yield Row(
        'imu_kalman', f'{name}: lost messages', ours.lost, 'messages', 0, 'lower', {'bare relay': bare.lost}
    )
    yield Row(
        'imu_kalman',
        f'{name}: p99 latency in to out',
        ours.latency_p99 * 1e3,
        'ms',
        None,
        'lower',
        {'bare relay': bare.latency_p99 * 1e3},
    )
