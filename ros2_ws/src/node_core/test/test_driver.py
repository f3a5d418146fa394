# SPDX-License-Identifier: Apache-2.0
"""The step that node and offline runner share."""

import sys
from pathlib import Path

from sensor_msgs.msg import Imu

from node_core.driver import EstimatorDriver

sys.path.insert(0, str(Path(__file__).parent))
from echo_estimator import LEAK_PORTS, LeakParams


def message(x):
    imu = Imu()
    imu.header.stamp.sec = 1
    imu.angular_velocity.x = x
    return imu


def test_an_estimate_goes_to_the_output_of_its_class():
    driver = EstimatorDriver(LEAK_PORTS, LeakParams(leak=1.0))
    ((output, estimate),) = driver.feed(LEAK_PORTS.inputs[0], message(3.0))
    assert output.topic == 'mean'
    assert estimate.value == 3.0


def test_a_message_that_cannot_be_decoded_is_counted_with_its_reason():
    driver = EstimatorDriver(LEAK_PORTS, LeakParams())
    assert driver.feed(LEAK_PORTS.inputs[0], message(float('nan'))) == []
    assert driver.tally.sensor('imu/data_raw').rejected == {'rate not finite': 1}


def test_reset_returns_to_the_initial_state():
    driver = EstimatorDriver(LEAK_PORTS, LeakParams())
    driver.feed(LEAK_PORTS.inputs[0], message(3.0))
    driver.reset()
    assert driver.estimator.mean == 0.0
