# SPDX-License-Identifier: Apache-2.0
"""The rolling ship agrees with itself: rates with attitude, settings with the words."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_kalman.scenarios import GRAVITY, ShipParams, rolling_ship

CLEAN = {'gyro_noise': 0.0, 'gyro_walk': 0.0, 'accel_noise': 0.0, 'mag_noise': 0.0, 'mag_residual': 0.0}


@pytest.fixture(scope='module')
def clean():
    return rolling_ship(ShipParams(duration=300.0, **CLEAN), seed=3)


def test_rates_are_the_derivative_of_attitude_plus_the_bias(clean):
    attitude = Rotation.from_quat(clean.orientation, scalar_first=True)
    middle = (attitude[:-2].inv() * attitude[2:]).as_rotvec() * 100.0
    np.testing.assert_allclose(clean.gyr[1:-1] - clean.bias[1:-1], middle, atol=1e-5)


def test_forces_average_to_gravity_and_contain_the_lever_arm(clean):
    attitude = Rotation.from_quat(clean.orientation, scalar_first=True)
    force = attitude.apply(clean.acc)
    np.testing.assert_allclose(force.mean(axis=0), [0, 0, GRAVITY], atol=0.05)
    still = rolling_ship(ShipParams(duration=300.0, linear=0.0, **CLEAN), seed=3)
    np.testing.assert_allclose(np.linalg.norm(still.acc, axis=1), GRAVITY, atol=1e-9)
    assert np.std(force[:, :2], axis=0).min() > 0.3


def test_field_has_its_strength_and_dip(clean):
    field = Rotation.from_quat(clean.orientation, scalar_first=True).apply(clean.mag)
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), 48.5e-6, rtol=1e-12)
    np.testing.assert_allclose(np.degrees(np.arctan2(-field[:, 2], field[:, 1])), 68.0, atol=1e-9)
    np.testing.assert_allclose(field[:, 0], 0.0, atol=1e-15)


def test_motion_is_as_large_as_said(clean):
    yaw, pitch, roll = (
        Rotation.from_quat(clean.orientation, scalar_first=True).as_euler('ZYX', degrees=True).T
    )
    assert np.abs(roll).max() == pytest.approx(15.0, abs=0.5)
    assert np.abs(pitch).max() == pytest.approx(4.0, abs=0.1)
    assert np.ptp(np.unwrap(yaw, period=360)) == pytest.approx(93, abs=4)


def test_equal_seeds_give_equal_recordings_and_others_do_not():
    one, same, other = (rolling_ship(ShipParams(duration=2.0), seed) for seed in (7, 7, 8))
    for a, b in zip(one, same):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.acc, other.acc)


def test_noise_has_the_densities_of_the_definition():
    noisy = rolling_ship(ShipParams(duration=100.0), seed=1)
    quiet = rolling_ship(
        ShipParams(duration=100.0, **{**CLEAN, 'gyro_walk': 0.003, 'mag_residual': 1.0}), seed=1
    )
    root = np.sqrt(200.0)
    assert np.degrees(np.std(noisy.gyr - quiet.gyr)) == pytest.approx(0.01 * root, rel=0.02)
    assert np.std(noisy.acc - quiet.acc) == pytest.approx(300e-6 * GRAVITY * root, rel=0.02)
    assert np.std(noisy.mag - quiet.mag) == pytest.approx(0.6e-6, rel=0.02)
