# SPDX-License-Identifier: Apache-2.0
"""What the estimator nodes cost as processes, beside a bare relay with the same topics."""

import math
import os
from collections.abc import Iterable

from bag_tools.bench import Options, Row
from ev_velocity.codec import IMU, JOINTS, TWIST

PACKAGE = 'ev_velocity'
RATE = 500.0  # Hz
EVERY = 50  # GPS and encoder at 10 Hz


def _fill_imu(message, index):
    message.linear_acceleration.x = 0.1 * math.sin(0.01 * index)


def _fill_gps(message, index):
    message.twist.twist.linear.x = 8.0
    message.twist.covariance[0] = 0.0025


def _fill_encoder(message, index):
    message.name = ['encoder']
    message.position = [math.floor(8.0 * index / RATE / 0.0497) * 0.1745]


def rows(options: Options) -> Iterable[Row]:
    """Measure CPU ratio, latency and loss of both estimators at 500 Hz."""
    from node_core.live_bench import Feed, compare
    from node_core.testing import Process

    # Field checks are for tests; a user's graph runs without them.
    os.environ.pop('ROS_PYTHON_CHECK_FIELDS', None)
    feeds = [
        Feed(IMU, 'imu/data_raw', _fill_imu),
        Feed(TWIST, 'gps/speed', _fill_gps, EVERY),
        Feed(JOINTS, 'wheel/encoder', _fill_encoder, EVERY),
    ]
    count = round(RATE) * (4 if options.quick else 30)
    for node, output in (
        ('velocity_estimator', 'vehicle/velocity'),
        ('fusion_estimator', 'fusion/velocity'),
    ):
        ours, bare = compare(
            lambda node=node: Process.node(PACKAGE, node), feeds, (TWIST, output), RATE, count
        )
        name = f'{node} at 500 Hz'
        yield Row(PACKAGE, f'{name}: CPU ratio to a bare relay', ours.cpu / bare.cpu, '', 1.3)
        lost = {'bare relay': bare.lost}
        yield Row(PACKAGE, f'{name}: lost messages', ours.lost, 'messages', 0, 'lower', lost)
        late = {'bare relay': bare.latency_p99 * 1e3}
        p99 = ours.latency_p99 * 1e3
        yield Row(PACKAGE, f'{name}: p99 latency in to out', p99, 'ms', 2.0, 'lower', late)
