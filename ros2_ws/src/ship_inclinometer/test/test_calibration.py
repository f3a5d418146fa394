# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'bench'))

from kalman_core.parameters import build
from ship_inclinometer.calibration import CalibrationError, fit_ellipsoid, gyro_bias, swing, write_yaml
from ship_inclinometer.params import AttitudeParams

SOFT = np.array([[1.1, 0.04, -0.02], [0.04, 0.93, 0.03], [-0.02, 0.03, 1.02]])
HARD = np.array([12e-6, -30e-6, 5e-6])


def sphere(count=2000, seed=0, noise=0.0, keep=lambda v: np.ones(len(v), bool)):
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions = directions[keep(directions)]
    raw = 48e-6 * directions @ np.linalg.inv(SOFT).T + HARD
    return directions, raw + noise * rng.standard_normal(raw.shape)


def test_a_clean_ellipsoid_is_undone_exactly():
    directions, raw = sphere()
    calibration = fit_ellipsoid(raw, 48e-6)
    np.testing.assert_allclose(calibration.apply(raw), 48e-6 * directions, atol=1e-11)
    np.testing.assert_allclose(calibration.offset, HARD, atol=1e-11)


def test_noise_and_spikes_bend_it_little():
    directions, raw = sphere(noise=0.15e-6)
    raw[::50] += 30e-6
    calibration = fit_ellipsoid(raw, 48e-6)
    error = calibration.apply(raw) - 48e-6 * directions
    assert np.max(np.abs(np.delete(error, np.s_[::50], axis=0))) < 1.5e-6


@pytest.mark.parametrize(
    ('keep', 'missing'),
    [
        (lambda v: v[:, 2] > -0.3, '-z'),
        (lambda v: v[:, 0] < 0.4, r'\+x'),
        (lambda v: np.abs(v[:, 1]) < 0.4, 'y'),
    ],
)
def test_poor_coverage_is_refused_and_the_missing_side_is_named(keep, missing):
    with pytest.raises(CalibrationError, match=missing):
        fit_ellipsoid(sphere(keep=keep)[1])


def test_a_plane_is_refused():
    angle = np.linspace(0.0, 20.0, 500)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.full(500, 0.3)])
    with pytest.raises(CalibrationError, match=r'turn the sensor|covered'):
        fit_ellipsoid(circle)


def test_too_few_or_equal_vectors_are_refused():
    with pytest.raises(CalibrationError, match='expected at least'):
        fit_ellipsoid(np.ones((20, 3)))
    with pytest.raises(CalibrationError, match='equal'):
        fit_ellipsoid(np.ones((200, 3)))
    with pytest.raises(CalibrationError, match='shape'):
        fit_ellipsoid(np.ones((200, 2)))
    with pytest.raises(CalibrationError, match='expected at least 100'):
        gyro_bias(np.zeros((99, 3)))
    with pytest.raises(CalibrationError, match='expected at least 8'):
        swing(np.radians([0.0, 120.0, 240.0]), np.zeros(3))


def test_a_field_that_was_not_constant_and_what_is_no_ellipsoid_are_refused():
    directions, _ = sphere()
    strength = np.random.default_rng(1).uniform(0.6, 1.4, len(directions))
    with pytest.raises(CalibrationError, match='the field was not constant'):
        fit_ellipsoid(48e-6 * strength[:, None] * directions)
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 20), np.linspace(-1.0, 1.0, 20))
    saddle = np.column_stack([x.ravel(), y.ravel(), np.sqrt(1.0 + (x**2 + y**2).ravel())])
    with pytest.raises(CalibrationError, match='no ellipsoid'):
        fit_ellipsoid(saddle)


def test_a_gyro_in_motion_is_refused():
    rates = 0.002 * np.random.default_rng(0).standard_normal((1000, 3)) + 0.03
    np.testing.assert_allclose(gyro_bias(rates), 0.03, atol=3e-4)
    with pytest.raises(CalibrationError, match='not at rest'):
        gyro_bias(rates + np.linspace(0.0, 0.1, 1000)[:, None])


def test_a_swing_gives_back_its_coefficients_and_names_the_gap():
    headings = np.radians(np.arange(0.0, 360.0, 45.0))
    true = np.array([0.01, 0.03, -0.02, 0.005, 0.004])
    deviation = true[0] + true[1] * np.sin(headings) + true[2] * np.cos(headings)
    deviation += true[3] * np.sin(2 * headings) + true[4] * np.cos(2 * headings)
    np.testing.assert_allclose(swing(headings, deviation), true, atol=1e-12)
    with pytest.raises(CalibrationError, match='between 90'):
        swing(np.radians([0, 10, 20, 40, 50, 60, 80, 90, 250, 300]), np.zeros(10))


def test_the_estimator_loads_what_is_written(tmp_path):
    calibration = fit_ellipsoid(sphere()[1], 48e-6)
    path = tmp_path / 'calibration.yaml'
    fitted = {
        'magnetometer_matrix': calibration.matrix.ravel().tolist(),
        'magnetometer_offset': [5e-05, -3e-05, 0.0],
        'gyro_offset': [0.01, 0.0, -0.02],
        'declination': 3.0,
    }
    write_yaml(path, 'attitude_estimator', fitted)
    values = yaml.safe_load(path.read_text())['attitude_estimator']['ros__parameters']
    params = build(AttitudeParams, values)
    np.testing.assert_allclose(np.reshape(params.magnetometer_matrix, (3, 3)), calibration.matrix)
    assert params.gyro_offset[2] == -0.02
    assert params.magnetometer_offset == (5e-05, -3e-05, 0.0)
    assert params.declination == 3.0


def test_the_recorded_sphere_is_within_half_a_percent_on_held_out_samples():
    import service_bench

    raw = service_bench.recorded_sphere()
    if raw is None:
        pytest.skip('no recorded sphere (ESTIMATOR_DATA) or no h5py')
    assert service_bench.held_out_spread(raw, service_bench.blocks(len(raw), 50, 5)) <= 0.5
