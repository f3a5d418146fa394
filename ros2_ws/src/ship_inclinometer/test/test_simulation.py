# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from ship_inclinometer.sea import sea_motion, spectrum
from ship_inclinometer.simulation import GRAVITY, SCENARIOS, rotation_matrices, scenario, simulate


def quiet(name, **changes):
    silent = {
        'gyro_noise': 0.0,
        'gyro_bias': 0.0,
        'gyro_warmup': 0.0,
        'gyro_bias_walk': 0.0,
        'accelerometer_noise': (0.0, 0.0, 0.0),
        'accelerometer_bias': 0.0,
        'engine_acceleration': 0.0,
        'magnetometer_noise': 0.0,
        'soft_iron': 0.0,
        'hard_iron': 0.0,
        'gnss_noise': 0.0,
        'duration': 60.0,
        'angle_noise': 0.0,
    }
    return scenario(name, **(silent | changes))


@pytest.mark.parametrize('name', list(SCENARIOS))
def test_specific_force_is_the_derivative_of_velocity_less_gravity(name):
    recording = simulate(quiet(name, turn_starts=(10.0, -1.0)), 1)
    truth, dt = recording.truth, 1.0 / recording.params.rate
    acceleration = (truth.velocity[2:] - truth.velocity[:-2]) / (2.0 * dt)
    mats = rotation_matrices(truth.angles[1:-1])
    expected = np.einsum('nji,nj->ni', mats, acceleration + [0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(recording.accelerometer[1:-1], expected, atol=2e-3)


def test_rates_turn_the_attitude():
    recording = simulate(quiet('turns', turn_starts=(10.0, -1.0)), 2)
    mats = rotation_matrices(recording.truth.angles)
    dt = 1.0 / recording.params.rate
    relative = np.swapaxes(mats[:-2], 1, 2) @ mats[2:]
    vector = 0.5 * np.column_stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ]
    )
    np.testing.assert_allclose(vector / (2.0 * dt), recording.gyro[1:-1], atol=1e-5)


def test_a_sea_has_the_height_and_period_it_is_asked_for():
    for sea in ('jonswap', 'pierson_moskowitz'):
        params = scenario('beam', sea=sea, heave=1.0)
        frequency = np.arange(1, 4000) / 10000.0
        density = spectrum(params, frequency)
        assert 4.0 * math.sqrt(np.sum(density) * 1e-4) == pytest.approx(params.significant_height, rel=1e-6)
        assert 1.0 / frequency[np.argmax(density)] == pytest.approx(params.peak_period, rel=0.02)


def test_roll_is_scaled_to_its_largest_value():
    for seed in range(3):
        recording = simulate(quiet('beam', duration=300.0), seed)
        assert np.degrees(np.max(np.abs(recording.truth.angles[:, 0]))) == pytest.approx(15.0)


def test_heave_has_the_height_of_the_sea():
    heights = []
    for seed in range(20):
        params = scenario('beam')
        t = np.arange(0.0, 600.0, 1.0 / params.rate)
        motion = sea_motion(params, t, np.random.default_rng(seed))
        heave = np.cumsum(motion.velocity[:, 2]) / params.rate
        heights.append(4.0 * np.std(heave - np.mean(heave)))
    assert np.mean(heights) == pytest.approx(2.5, rel=0.05)


def test_equal_seeds_give_equal_numbers_and_others_do_not():
    first, again, other = (simulate(scenario('beam', duration=5.0), s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.accelerometer, again.accelerometer)
    np.testing.assert_array_equal(first.magnetometer, again.magnetometer)
    assert not np.array_equal(first.gyro, other.gyro)


def test_a_turn_heels_outward_and_ends_on_the_opposite_course():
    recording = simulate(quiet('turns', duration=200.0, turn_starts=(20.0, -1.0), largest_roll=0.01), 1)
    angles = np.degrees(recording.truth.angles)
    half = recording.truth.t == 70.0
    # A turn to port (yaw grows) heels to starboard.
    assert angles[half, 0][0] == pytest.approx(2.0, abs=0.1)
    assert angles[-1, 2] - angles[0, 2] == pytest.approx(180.0, abs=4.0)


def test_gnss_is_late_by_its_delay_and_silent_in_a_drop_out():
    params = quiet('turns_gnss', gnss_delay=0.3, gnss_dropout_start=20.0, gnss_dropout_time=10.0)
    recording = simulate(params, 1)
    valid = recording.gnss_t - 0.3
    assert not np.any((valid > 20.0) & (valid < 29.9))


def test_a_still_magnetometer_sees_the_field_it_should():
    recording = simulate(
        quiet('calm', course=0.0, largest_roll=0.01, largest_pitch=0.01, largest_yaw=0.01), 1
    )
    mean = np.mean(recording.magnetometer, axis=0)
    np.testing.assert_allclose(
        mean, 48e-6 * np.array([math.cos(math.radians(55)), 0.0, -math.sin(math.radians(55))]), atol=2e-8
    )
