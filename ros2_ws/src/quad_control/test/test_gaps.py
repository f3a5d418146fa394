# SPDX-License-Identifier: Apache-2.0
"""Samples that never come, in flight: the filter is back soon and says how much it does not know."""

import numpy as np
import pytest

from bag_tools.bag import BagReader
from quad_control.attitude_filter import AttitudeFilter, tilt_error
from quad_control.codec import decode_imu
from quad_control.fixtures import FIXTURES
from quad_control.samples import Attitude

RATE = 200  # Hz
FLIGHT = (4.0, 10.5)  # s: climb, hold, lean by 10 degrees and come back


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """The IMU samples of the free flight, and the true attitude by stamp."""
    path = tmp_path_factory.mktemp('bags') / 'free.mcap'
    FIXTURES['quad_free_10deg'](path)
    truth = {}
    with BagReader(path) as reader:
        imu = [
            decode_imu(reader.decode(data, 'sensor_msgs/msg/Imu'))
            for _, _, data in reader.messages(['/imu/data_raw'])
        ]
        for _, stamp, data in reader.messages(['/truth/odometry']):
            q = reader.decode(data, 'nav_msgs/msg/Odometry').pose.pose.orientation
            truth[stamp] = (q.w, q.x, q.y, q.z)
    return imu, truth


@pytest.mark.parametrize('gap', [0.1, 0.3, 0.75, 0.99, 1.2])
def test_after_a_gap_in_flight_the_error_is_as_large_as_declared(flight, gap):
    imu, truth = flight
    ratios, late = [], []
    for first in np.arange(FLIGHT[0], FLIGHT[1], 0.25):
        a, b = round(first * RATE), round((first + gap) * RATE)
        f = AttitudeFilter()
        for sample in imu[: a + 1]:
            f.on_imu(sample)
        for sample in imu[b : b + 2 * RATE]:
            (out,) = (e for e in f.on_imu(sample) if type(e) is Attitude)
            if sample.stamp in truth:
                error = tilt_error(out.quaternion, truth[sample.stamp])
                ratios.append(error**2 / sum(out.attitude_variance[:2]))
                late.append(error)
    # Gaps begin at fixed places of one flight: a mean, not a distribution, is what 26 of them can show.
    assert np.mean(ratios) < 1.5
    assert np.quantile(ratios, 0.99) < 9.2 / 2  # chi-square, 2 degrees of freedom, over their number
    # Who takes the craft for level is 10 degrees off while it leans.
    assert np.degrees(np.sqrt(np.mean(np.square(late)))) < 10.0
