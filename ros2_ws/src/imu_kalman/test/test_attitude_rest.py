# SPDX-License-Identifier: Apache-2.0
"""What a rate that stays the same is taken for: bias, a turn about the vertical, or a bias just taken off."""

import math

import numpy as np
import pytest
from attitude_errors import rotation
from mpu6050_rig import DEG, Rig
from mpu6050_rig import still as resting
from scipy.spatial.transform import Rotation

from imu_kalman import attitude_layout as layout
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.attitude_batch import filter_batch
from imu_kalman.params import AttitudeParams
from imu_kalman.samples import ImuSample

RATE = 100
FIELD = np.array([0.0, 2e-5, -4e-5])
PROMPT = {'sensor_delay': 0.0, 'mag_delay': 0.0}


def turntable(rates, bias, mount=None):
    """Stamps, readings (n, 3) and attitude of a body that turns about the vertical at `rates` (rad/s)."""
    rng = np.random.default_rng(1)
    n = len(rates)
    heading = np.cumsum(0.5 * (rates + np.append(0.0, rates[:-1]))) / RATE
    turned = Rotation.from_rotvec(np.outer(heading, [0.0, 0.0, 1.0])) * (mount or Rotation.identity())
    gyr = turned.inv().apply(np.outer(rates, [0.0, 0.0, 1.0])) + bias + 0.0015 * rng.normal(size=(n, 3))
    acc = turned.inv().apply([0.0, 0.0, 9.80665]) + 0.03 * rng.normal(size=(n, 3))
    mag = turned.inv().apply(FIELD) + 2e-7 * rng.normal(size=(n, 3))
    return 10**9 + np.arange(n) * (10**9 // RATE), gyr, acc, mag, turned


def bias_and_sigma(state):
    cov = state[layout.COV :].reshape(layout.N, layout.N)
    return state[layout.BIAS : layout.BIAS + 3], np.sqrt(np.diag(cov)[3:6])


@pytest.mark.parametrize('axes', [6, 9])
@pytest.mark.parametrize('rate', [0.05, 0.3, 1.0])
def test_a_steady_turn_about_the_vertical_is_no_bias(rate, axes):
    bias = np.array([0.005, -0.003, 0.004])
    rates = np.concatenate([np.zeros(10 * RATE), np.full(20 * RATE, rate)])
    mount = Rotation.from_euler('ZYX', [0.4, -0.5, 0.3])
    stamp, gyr, acc, mag, truth = turntable(rates, bias, mount)
    state = np.zeros(layout.STATE)
    params = AttitudeParams(**PROMPT)
    out = filter_batch(stamp, gyr, acc, mag if axes == 9 else None, params=params, state=state)
    found, sigma = bias_and_sigma(state)
    assert (np.abs(found - bias) < 5.0 * sigma).all()
    # Without a field heading is what it was when the turn began.
    before = truth[10 * RATE - 1].inv() * rotation(out.orientation[10 * RATE - 1])
    error = (truth[-1].inv() * rotation(out.orientation[-1])) * before.inv()
    # At 1 rad/s the first sample of the turn is a jump, which is held.
    assert error.magnitude() < math.radians(1.5)


def test_a_bias_that_has_changed_by_much_is_believed_after_a_minute_of_rest():
    steps = np.concatenate([np.full(5 * RATE, 0.004), np.full(65 * RATE, 0.054)])
    stamp, gyr, acc, _, _ = turntable(np.zeros(len(steps)), steps[:, None] * [0.0, 0.0, 1.0])
    out = filter_batch(stamp, gyr, acc)
    assert out.bias[60 * RATE, 2] == pytest.approx(0.004, abs=2e-3)
    assert out.bias[-1, 2] > 0.03


@pytest.mark.parametrize('axis', [0, 1])
def test_however_large_a_bias_about_a_level_axis_is_taken_from_rest(axis):
    bias = np.zeros(3)
    bias[axis] = 0.3
    stamp, gyr, acc, _, _ = turntable(np.zeros(10 * RATE), bias)
    out = filter_batch(stamp, gyr, acc)
    np.testing.assert_allclose(out.bias[-1], bias, atol=1e-3)
    up = rotation(out.orientation[-1]).apply([0.0, 0.0, 1.0])
    assert math.degrees(math.acos(min(1.0, up[2]))) < 1.0


def follow(rig, estimator, seconds):
    """Heading (rad) by sample while the driver's readings go to the estimator."""
    yaw = []
    while len(yaw) < 200 * seconds:
        for r in rig.run(0.02):
            told = rig.driver.variances.gyro
            sample = ImuSample(r.stamp, tuple(r.gyro.tolist()), tuple(r.accel.tolist()), '', told)
            yaw.append(rotation(estimator.on_imu(sample)[0].orientation).as_euler('ZYX')[0])
    return np.degrees(yaw)


def test_a_bias_that_the_driver_takes_off_is_not_taken_off_twice():
    rig = Rig(resting, chip={'gyro_bias': (1.0 * DEG, -1.0 * DEG, 4.5 * DEG)})
    estimator = AttitudeFilter(AttitudeParams(use_magnetometer=False, **PROMPT))
    yaw = follow(rig, estimator, 20.0)
    assert rig.driver.calibration_message == 'calibrated at rest'
    # The estimator has found the bias by then; the driver does with the 400th sample.
    assert abs(yaw[-1] - yaw[395]) < 0.3
    found, sigma = bias_and_sigma(estimator.state)
    assert (np.abs(found) < 5.0 * sigma).all()
    rig.chip.gyro_bias += 1.0 * DEG
    follow(rig, estimator, 3.0)
    assert rig.driver.calibrate().variance < 1e-6
    yaw = follow(rig, estimator, 10.0)
    assert abs(yaw[-1] - yaw[0]) < 0.3


def test_a_variance_that_wavers_takes_no_bias_off():
    stamp, gyr, acc, _, _ = turntable(np.zeros(5 * RATE), [0.0, 0.0, 0.02])
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    for i, row in enumerate(zip(stamp.tolist(), gyr.tolist(), acc.tolist())):
        told = (1e-5, 3e-6, 0.0, 5e-6)[i % 4]
        estimator.on_imu(ImuSample(row[0], tuple(row[1]), tuple(row[2]), '', told))
    assert estimator.state[layout.BIAS + 2] == pytest.approx(0.02, abs=1e-3)
