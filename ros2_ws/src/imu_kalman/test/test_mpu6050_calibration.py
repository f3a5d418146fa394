# SPDX-License-Identifier: Apache-2.0
"""The gyro bias that the driver learns at rest."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from mpu6050_rig import DEG, RATE, G, Rig, constant, mean_of, still

from imu_kalman.mpu6050_calibration import Calibration, Refused


def test_the_bias_is_learnt_at_rest():
    bias = (0.05, -0.04, 0.02)
    rig = Rig(still, chip={'gyro_bias': bias})
    rig.run(1.0)
    assert rig.driver.diagnostics()['level'] == 1
    readings = rig.run(6.0)[-400:]
    np.testing.assert_allclose(rig.driver.bias, bias, atol=3e-4)
    np.testing.assert_allclose(mean_of(readings, 'gyro'), 0.0, atol=5e-4)
    assert rig.driver.diagnostics()['level'] == 0
    assert rig.driver.diagnostics()['calibration'] == 'calibrated at rest'


def test_the_stated_variance_of_the_bias_is_its_error():
    bias = np.array([0.05, -0.04, 0.02])
    ratios = []
    for seed in range(20):
        rig = Rig(still, chip={'gyro_bias': tuple(bias), 'seed': seed}, rate=100.0)
        rig.run(2.5)
        result = rig.driver.calibrate()
        assert isinstance(result, Calibration)
        ratios.append(((result.bias - bias) ** 2).mean() / result.variance)
    assert 0.2 < np.mean(ratios) < 1.5


def rolling(amplitude, frequency):
    """A ship that rolls about x, seen at the centre of rotation."""

    def motion(times):
        omega = 2.0 * math.pi * frequency
        roll = amplitude * np.sin(omega * times)
        rate = np.zeros((len(times), 3))
        rate[:, 0] = amplitude * omega * np.cos(omega * times)
        force = G * np.stack([np.zeros_like(roll), np.sin(roll), np.cos(roll)], axis=1)
        return SimpleNamespace(rate=rate, force=force)

    return motion


@pytest.mark.parametrize(
    'motion',
    [
        rolling(3.0 * DEG, 0.1),
        rolling(15.0 * DEG, 0.1),
        rolling(1.0 * DEG, 0.5),
        constant(rate=(0.0, 0.0, 25.0 * DEG), force=(0.0, 0.0, G)),
    ],
    ids=['slow ship', 'ship', 'boat', 'turntable'],
)
def test_motion_is_never_taken_for_a_rest(motion):
    rig = Rig(motion, rate=100.0)
    rig.run(20.0)
    np.testing.assert_array_equal(rig.driver.bias, 0.0)
    assert rig.driver.diagnostics()['level'] == 1
    result = rig.driver.calibrate()
    assert isinstance(result, Refused)
    assert 'moving' in result.reason or 'turning' in result.reason


def test_calibration_without_samples_is_refused():
    rig = Rig()
    assert isinstance(rig.driver.calibrate(), Refused)
    rig.run(0.5)
    result = rig.driver.calibrate()
    assert isinstance(result, Refused)
    assert 'less than' in result.reason


def test_a_bias_from_the_parameters_is_subtracted_at_once():
    rig = Rig(gyro_bias=tuple(RATE), calibrate_at_start=False)
    np.testing.assert_allclose(mean_of(rig.run(1.0), 'gyro'), 0.0, atol=2e-3)


def test_the_bias_survives_a_reconnection():
    rig = Rig(still, chip={'gyro_bias': (0.05, -0.04, 0.02)})
    rig.run(5.0)
    bias = rig.driver.bias
    rig.bus.stuck = True
    rig.run(2.0)
    rig.bus.stuck = False
    rig.run(3.0)
    np.testing.assert_array_equal(rig.driver.bias, bias)
