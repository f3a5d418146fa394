# SPDX-License-Identifier: Apache-2.0
"""The angle estimator: orientations, yaw, gimbal limit, the ship, bad input."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imu_kalman.angle import AngleFilter, filter_angles
from imu_kalman.params import TwoStateParams
from imu_kalman.samples import ImuSample, RollPitchYaw, SettledAttitude
from imu_kalman.scenarios import ShipParams, rolling_ship

DT = 10_000_000
SHIP = {'measurement_variance': 30.0, 'angle_noise': 1e-5, 'bias_noise': 1e-6}


def feed(estimator, count, gyr=(0.0, 0.0, 0.0), acc=(0.0, 0.0, 9.81), first=10**9):
    for i in range(count):
        out = estimator.on_imu(ImuSample(first + i * DT, gyr, acc))
    return out


@pytest.mark.parametrize('roll', [-170, -90, -30, 0, 60, 135])
@pytest.mark.parametrize('pitch', [-75, -20, 0, 45, 78])
def test_still_orientation_is_found_in_all_directions(roll, pitch):
    body_n = Rotation.from_euler('ZYX', [0, pitch, roll], degrees=True).inv()
    attitude, rpy = feed(AngleFilter(), 3, acc=tuple(body_n.apply([0, 0, 9.81]).tolist()))
    np.testing.assert_allclose(np.degrees(rpy.angles), [roll, pitch, 0], atol=1e-9)
    found = Rotation.from_quat(attitude.orientation, scalar_first=True)
    np.testing.assert_allclose(found.as_matrix(), body_n.inv().as_matrix(), atol=1e-12)


def test_turning_about_a_tilted_axis_follows_the_true_rotation():
    params = TwoStateParams(bias_sigma=0.0, bias_noise=0.0, measurement_variance=100.0)
    estimator, attitude = AngleFilter(params), None
    truth = Rotation.from_euler('ZYX', [0.0, 0.3, -0.5])
    rate = np.array([0.2, -0.1, 0.15])
    for i in range(500):
        acc = truth.inv().apply([0.0, 0.0, 9.81])
        attitude, _ = estimator.on_imu(ImuSample(10**9 + i * DT, tuple(rate), tuple(acc)))
        truth = truth * Rotation.from_rotvec(rate * 0.01)
    truth = truth * Rotation.from_rotvec(-rate * 0.01)
    error = Rotation.from_quat(attitude.orientation, scalar_first=True) * truth.inv()
    assert error.magnitude() < 2e-3  # Euler rates at 100 Hz are a first-order integration


def test_yaw_variance_grows_with_bias_and_is_bounded_by_a_full_circle():
    params = TwoStateParams(bias_sigma=0.01, gyro_noise=1e-3, lag_window=0.0)
    estimator = AngleFilter(params)
    attitude, _ = feed(estimator, 1001)
    expected = (0.01 * 10.0) ** 2 + 1e-6 * 10.0
    assert attitude.orientation_covariance[2, 2] == pytest.approx(expected, rel=1e-6)
    attitude, _ = feed(estimator, 40_000, first=10**9 + 1001 * DT)
    assert attitude.orientation_covariance[2, 2] == pytest.approx(math.pi**2 / 3, rel=1e-6)


def test_beyond_the_gimbal_limit_yaw_is_lost_and_roll_starts_anew_on_return():
    estimator = AngleFilter()
    feed(estimator, 50)
    up = 9.81 * math.sin(1.5), 9.81 * math.cos(1.5)
    attitude, _ = feed(estimator, 50, acc=(-up[0], 0.0, up[1]), first=2 * 10**9)
    assert attitude.orientation_covariance.trace() > 3.0
    acc = (0.0, 9.81 * math.sin(2.0), 9.81 * math.cos(2.0))
    _, rpy = feed(estimator, 300, acc=acc, first=3 * 10**9)
    assert rpy.angles[0] == pytest.approx(2.0, abs=0.02)


def test_a_long_gap_starts_roll_and_pitch_anew_and_says_so():
    estimator = AngleFilter()
    feed(estimator, 10)
    acc = (0.0, 9.81 * math.sin(0.5), 9.81 * math.cos(0.5))
    _, rpy = feed(estimator, 1, acc=acc, first=4 * 10**9)
    assert rpy.angles[0] == pytest.approx(0.5)
    assert estimator.tally.restarts == ['angles from the accelerometer after a gap']


def inclination_error(recording, **params):
    quat = filter_angles(recording.stamp, recording.gyr, recording.acc, TwoStateParams(**params))
    up, true = (
        Rotation.from_quat(q, scalar_first=True).inv().apply([0, 0, 1]) for q in (quat, recording.orientation)
    )
    error = np.arccos(np.clip((up * true).sum(axis=1), -1, 1))
    return np.degrees(np.sqrt(np.mean(error[30 * 200 :] ** 2)))


def test_arrays_and_stream_give_the_same_bits():
    ship = rolling_ship(ShipParams(duration=5.0), seed=2)
    estimator = AngleFilter()
    streamed = []
    for stamp, gyr, acc in zip(*(column.tolist() for column in ship[:3])):
        attitude, _ = estimator.on_imu(ImuSample(stamp, tuple(gyr), tuple(acc)))
        streamed.append(attitude.orientation)
    np.testing.assert_array_equal(filter_angles(*ship[:3]), streamed)


def test_on_the_ship_the_documented_setting_beats_the_constants_of_the_listing():
    ship = rolling_ship(ShipParams(duration=150.0), seed=0)
    still = rolling_ship(ShipParams(duration=60.0, linear=0.0), seed=0)
    assert inclination_error(ship, **SHIP) < 1.0
    assert inclination_error(ship) > 2.0
    assert inclination_error(still) < 0.1


def test_late_samples_within_the_window_change_nothing_in_the_settled_output():
    ship = rolling_ship(ShipParams(duration=5.0), seed=1)
    samples = [
        ImuSample(t, tuple(g), tuple(a))
        for t, g, a in zip(ship.stamp.tolist(), ship.gyr.tolist(), ship.acc.tolist())
    ]
    rng = np.random.default_rng(0)
    order = np.argsort(np.arange(len(samples)) + rng.uniform(0, 60, len(samples)), kind='stable')
    settled, states = [], []
    for sequence in (samples, [samples[i] for i in order]):
        estimator = AngleFilter(TwoStateParams(settled_output=True))
        found = {}
        for sample in sequence:
            for estimate in estimator.on_imu(sample):
                if isinstance(estimate, SettledAttitude):
                    found[estimate.stamp] = estimate.values.tobytes()
        settled.append(found)
        states.append(estimator.state.tobytes())
    common = settled[0].keys() & settled[1].keys()
    assert len(common) > 800
    assert all(settled[0][k] == settled[1][k] for k in common)
    assert states[0] == states[1]


numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)
vectors = st.tuples(numbers, numbers, numbers)
steps = st.integers(-(10**9), 3 * 10**9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(steps, vectors, vectors), max_size=40))
def test_whatever_comes_no_estimate_is_ever_non_finite_and_clean_data_is_followed_within_two_seconds(stream):
    estimator = AngleFilter(TwoStateParams(lag_window=0.0))
    stamp = 10**12
    for step, gyr, acc in stream:
        stamp += step
        for estimate in estimator.on_imu(ImuSample(stamp, gyr, acc)):
            if not isinstance(estimate, RollPitchYaw):
                assert np.isfinite(estimate.values).all()
    # Later than every stamp of the stream, so that no clean sample is behind the window.
    first = 10**12 + 200 * 10**9
    acc = (0.0, 9.81 * math.sin(0.4), 9.81 * math.cos(0.4))
    _, rpy = feed(estimator, 200, acc=acc, first=first)
    assert rpy.angles[0] == pytest.approx(0.4, abs=0.05)
    assert rpy.angles[1] == pytest.approx(0.0, abs=0.05)


def test_after_a_gap_without_a_usable_force_nothing_is_said_until_there_is_one():
    estimator = AngleFilter()
    feed(estimator, 100)
    first = 10**9 + 300 * DT
    assert feed(estimator, 50, gyr=(1.0, 0.0, 0.0), acc=(0.0, 0.0, 0.0), first=first) == []
    _, rpy = feed(estimator, 1, acc=(0.0, 9.81, 0.0), first=first + 50 * DT)
    assert rpy.angles[0] == pytest.approx(math.pi / 2)
    assert estimator.tally.restarts == ['angles from the accelerometer after a gap']


def test_a_force_that_is_not_usable_is_marked_as_not_measured():
    estimator = AngleFilter()
    measured, _ = feed(estimator, 100)
    assert measured.values[28] > 0.0
    attitude, _ = feed(estimator, 1, acc=(0.0, 0.0, 0.1), first=10**9 + 100 * DT)
    np.testing.assert_array_equal(attitude.values[7:10], 0.0)
    assert attitude.values[28] == -1.0


@pytest.mark.parametrize('values', [{}, SHIP])
@pytest.mark.parametrize('pitch', [-1.3, 0.0, 0.5, 1.0, 1.3])
def test_a_bias_about_the_vertical_of_a_pitched_body_is_within_what_the_covariances_say(values, pitch):
    params = TwoStateParams(**values)
    acc = tuple(Rotation.from_euler('y', pitch).inv().apply([0.0, 0.0, 9.81]).tolist())
    bias = (0.0, 0.0, params.bias_sigma)
    attitude, rpy = feed(AngleFilter(params), 300, gyr=bias, acc=acc)
    # One sigma of bias is one sigma of yaw, however much faster than the body it turns.
    assert rpy.angles[2] ** 2 < 1.2 * attitude.orientation_covariance[2, 2]
    attitude, _ = feed(AngleFilter(params), 20_000, gyr=bias, acc=acc)
    nees = attitude.rate @ np.linalg.solve(attitude.rate_covariance, attitude.rate)
    assert nees < 3.0 * 1.2
