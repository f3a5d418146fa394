# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ev_velocity.scenarios import PULSE, RATE, SCENARIOS, acceleration_profile, scenario


@pytest.mark.parametrize('name', SCENARIOS)
def test_a_drive_moves_forward_and_ends_standing(name):
    drive = scenario(name, 3)
    assert drive.v.min() == 0.0
    assert 7.0 < drive.v.max() < 14.0
    assert np.all(drive.v[-int(RATE) :] == 0.0)
    assert np.all(np.diff(drive.counts) >= 0.0)


def test_one_seed_gives_one_drive():
    first, again, other = (scenario('oil_patch_10hz', seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.accelerometer, again.accelerometer)
    np.testing.assert_array_equal(first.gps_v, again.gps_v)
    assert not np.array_equal(first.accelerometer, other.accelerometer)


def test_speed_is_the_integral_of_the_acceleration():
    drive = scenario('good_road_10hz', 1)
    integral = np.concatenate(([0.0], np.cumsum(drive.a[1:]) / RATE))
    np.testing.assert_allclose(integral, drive.v, atol=1e-9)


def test_the_profile_is_jerk_limited():
    t = np.arange(0.0, 30.0, 1e-3)
    jerk = np.diff(acceleration_profile(((2.0, 6.0), (-2.2, 3.0), (0.0, 9.0)), t)) / 1e-3
    assert np.abs(jerk).max() == pytest.approx(4.2 / 0.3, rel=0.01)


def test_the_gps_tells_the_speed_of_its_delay_ago():
    drive = scenario('good_road_10hz', 2)
    error = drive.gps_v - np.interp(drive.gps_t - 0.15, drive.t, drive.v)
    moving = np.interp(drive.gps_t, drive.t, drive.v) > 1.0
    assert np.std(error[moving]) == pytest.approx(0.05, rel=0.15)
    assert abs(np.mean(error[moving])) < 0.01


def test_counts_are_the_rolled_distance_in_teeth_of_a_wheel_one_percent_off():
    drive = scenario('good_road_10hz', 4)
    rolled = (drive.counts[-1] - drive.counts[0]) * PULSE
    driven = np.sum(drive.v) / RATE
    assert abs(drive.radius_error) == 0.01
    assert rolled == pytest.approx(driven / (1.0 + drive.radius_error), rel=2e-3)


def test_on_the_patch_the_wheel_leaves_the_speed_by_six_metres_per_second():
    drive = scenario('oil_patch_10hz', 5)
    excess = drive.wheel_speed - drive.v / (1.0 + drive.radius_error)
    slipping = excess > 0.5
    assert excess.max() == pytest.approx(6.0, abs=0.1)
    assert 0.3 < np.count_nonzero(slipping) / RATE < 0.4
    assert 19.0 < drive.t[slipping][0] < 21.0


def test_two_drives_of_one_car_share_the_wheels():
    errors = {scenario('no_gps', seed, car=3).radius_error for seed in range(20)}
    assert len(errors) == 1
    assert len({scenario('no_gps', seed).radius_error for seed in range(20)}) == 2
