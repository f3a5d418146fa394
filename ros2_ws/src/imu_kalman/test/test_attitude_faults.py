# SPDX-License-Identifier: Apache-2.0
"""Faults of the sensors: the covariance tells what they cost, and clean data mends it within two seconds."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_kalman import attitude_layout as layout
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.attitude_batch import filter_batch
from imu_kalman.params import AttitudeParams
from imu_kalman.samples import ImuSample
from imu_kalman.scenario_faults import FAULTS, MOTIONS, faulty, follow
from imu_kalman.scenarios import ShipParams, rolling_ship
from imu_kalman.smoother import smooth

# Limits of one run, whatever happens in it. A run without faults has up to 7 degrees of heading error where
# a hand outruns the gyro's range.
NEES_LIMIT = 4.0  # per degree of freedom, mean over the run; 1 is exact
TILT_LIMIT, HEADING_LIMIT = 10.0, 25.0  # deg, from 2 s of clean data on
NEVER_BEFORE = 10_000  # seeds of the simulator that nothing was chosen on


def run(*arguments):
    """The outcome of a faulty recording, and the estimator that met it."""
    estimator = AttitudeFilter()
    return follow(faulty(*arguments), estimator), estimator


faults = st.lists(
    st.tuples(st.sampled_from(FAULTS), st.floats(0.0, 3.0), st.floats(0.01, 0.8)), min_size=1, max_size=6
)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    st.sampled_from(MOTIONS),
    st.integers(0, 10_000),
    st.sampled_from((50.0, 100.0, 200.0)),
    st.floats(5.0, 9.0),
    faults,
)
def test_any_sequence_of_faults_is_told_by_the_covariance_and_mended_within_two_seconds(
    motion, seed, rate, first, sequence
):
    time, placed = first, []
    for kind, pause, length in sequence:
        placed.append((kind, time + pause, length))
        time += pause + length
    outcome, _ = run(motion, NEVER_BEFORE + seed, placed, time + 3.0, rate)
    assert outcome.nees.mean() < NEES_LIMIT
    mended = outcome.time > time + 2.0
    assert outcome.tilt[mended].max() < TILT_LIMIT
    assert outcome.heading[mended].max() < HEADING_LIMIT


@pytest.mark.parametrize('kind', FAULTS)
def test_errors_during_a_fault_are_within_what_the_covariance_says(kind):
    times = (7.0, 11.0, 15.0)
    found = [run(motion, 20_000, [(kind, t, 0.4) for t in times], 18.0)[0] for motion in MOTIONS]
    assert np.mean([outcome.nees.mean() for outcome in found]) < 1.0


def test_noise_at_rest_that_freezes_is_no_rest():
    _, estimator = run('tilt_steps', 20_000, [('frozen', 8.0, 3.0)], 10.9)
    assert estimator.state[layout.REST_TIME] == 0.0
    assert estimator.state[layout.STUCK_COUNT] > 200


def test_a_sensor_without_noise_is_believed_at_rest():
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    for i in range(1000):
        estimator.on_imu(ImuSample(10**9 + i * 5_000_000, (0.001, 0.002, 0.0), (0.0, 0.0, 9.81)))
    assert estimator.state[layout.REST_TIME] > 4.0


def test_a_frozen_sensor_is_believed_in_the_end():
    rng = np.random.default_rng(4)
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    for i in range(400 + 600):
        noise = rng.normal(size=6) if i < 400 else np.ones(6)
        gyr, acc = 0.001 * noise[:3], np.array([0.0, 0.0, 9.81]) + 0.01 * noise[3:]
        estimator.on_imu(ImuSample(10**9 + i * 5_000_000, tuple(gyr.tolist()), tuple(acc.tolist())))
    assert estimator.state[layout.REST_TIME] > 0.5


def noisy(i, rng, gyr=None, acc=None):
    """Sample `i` of a body at rest, 100 Hz, with a reading replaced."""
    gyr = tuple((1.5e-3 * rng.normal(size=3)).tolist()) if gyr is None else gyr
    acc = tuple((0.03 * rng.normal(size=3) + [0.0, 0.0, 9.81]).tolist()) if acc is None else acc
    return ImuSample(10**9 + i * 10_000_000, gyr, acc)


@pytest.mark.parametrize('wild', [{'gyr': (90.0, 0.0, 0.0)}, {'acc': (300.0, 0.0, 0.0)}])
def test_a_reading_that_is_refused_is_not_published(wild):
    rng, estimator = np.random.default_rng(7), AttitudeFilter()
    for i in range(500):
        before = estimator.on_imu(noisy(i, rng))[0].values
    after = estimator.on_imu(noisy(500, rng, **wild))[0].values
    assert estimator.tally.sensors['imu/data_raw'].rejected['wild jump'] == 1
    assert np.abs(after[4:7]).max() < 0.02
    assert np.abs(after[7:10] - [0.0, 0.0, 9.81]).max() < 0.3
    doubted = slice(19, 28) if 'gyr' in wild else slice(28, 37)
    assert (np.diag(after[doubted].reshape(3, 3)) > np.diag(before[doubted].reshape(3, 3))).all()


def test_the_variance_of_a_stuck_reading_grows_and_that_after_a_gap_is_that_of_any_other():
    rng, estimator = np.random.default_rng(7), AttitudeFilter()
    for i in range(1000):
        before = estimator.on_imu(noisy(i, rng))[0].values
    after = estimator.on_imu(noisy(1080, rng))[0].values
    np.testing.assert_allclose(after[[19, 28]], before[[19, 28]], rtol=0.5)
    for i in range(1081, 2000):
        estimator.on_imu(noisy(i, rng))
    for i in range(2000, 2060):
        stuck = estimator.on_imu(noisy(i, rng, (0.5, 0.0, 0.0), (1.0, 0.0, 9.7)))[0].values
    # What is stuck is wrong by half a radian per second, and by a metre per second squared.
    assert 3.0 * math.sqrt(stuck[19]) > 0.5
    assert 3.0 * math.sqrt(stuck[28]) > 1.0
    for i in range(2060, 2070):
        again = estimator.on_imu(noisy(i, rng))[0].values
    np.testing.assert_allclose(again[[19, 28]], before[[19, 28]], rtol=0.5)


def gyro_at_rest(rates, rate=100.0):
    """Attitude variance about z and turn about z (rad) after these rates about z, with noise, then rest."""
    rng = np.random.default_rng(5)
    n = 500 + len(rates)
    gyr, acc = 1e-3 * rng.normal(size=(n, 3)), 0.02 * rng.normal(size=(n, 3)) + [0.0, 0.0, 9.81]
    gyr[500:, 2] += rates
    # The field tells heading until the turn begins.
    mag = np.tile([0.0, 18e-6, -45e-6], (n, 1)) + 1e-7 * rng.normal(size=(n, 3))
    mag[500:] = np.nan
    stamp = 10**9 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
    params = dataclasses.replace(AttitudeParams(), sensor_delay=0.0)
    out = filter_batch(stamp, gyr, acc, mag, params=params)
    yaw = 2.0 * np.arctan2(out.orientation[:, 3], out.orientation[:, 0])
    return out.covariance[-1, 5] - out.covariance[499, 5], yaw[-1] - yaw[499]


def test_a_blow_is_integrated_in_full_though_it_jumps():
    rates = np.full(40, 5.0)
    more, turned = gyro_at_rest(rates)
    # From one stamp to the next counts the mean of both samples: half of the first step.
    assert turned == pytest.approx(5.0 * 0.395, abs=0.01)
    assert more < math.radians(1.0) ** 2


def test_a_pulse_that_may_be_a_fault_is_doubted_by_what_it_turned():
    rates = np.zeros(40)
    rates[5:10] = 5.0
    more, turned = gyro_at_rest(rates)
    assert turned == pytest.approx(5.0 * 0.05, abs=0.01)
    assert more == pytest.approx(turned**2, rel=0.5)


def test_two_wild_samples_turn_nothing():
    rates = np.zeros(40)
    rates[5:7] = 20.0
    more, turned = gyro_at_rest(rates)
    assert turned == pytest.approx(0.0, abs=0.005)
    assert more < math.radians(1.0) ** 2


def test_shaking_that_jumps_for_long_is_taken_for_the_motion():
    rng = np.random.default_rng(6)
    rates = np.concatenate([rng.uniform(-8.0, 8.0, 100), rng.uniform(-8.0, 8.0, 300)])
    first, _ = gyro_at_rest(rates[:100])
    whole, _ = gyro_at_rest(rates)
    assert whole - first < first


def test_the_smoother_passes_over_faults_with_an_honest_covariance():
    ship = rolling_ship(ShipParams(duration=60.0), seed=1000)
    gyr, acc = ship.gyr.copy(), ship.acc.copy()
    gyr[4000:4100], acc[4000:4100] = gyr[4000], acc[4000]
    gyr[6000:6002] += 30.0
    keep = np.ones(len(gyr), bool)
    keep[8000:8080] = False
    args = (ship.stamp[keep], gyr[keep], acc[keep], ship.mag[keep])
    for estimate in (filter_batch, smooth):
        out = estimate(*args)
        w, x, y, z = out.orientation.T
        p = ship.orientation[keep].T
        # The vector part of truth times conjugate estimate, doubled: the error's rotation vector.
        error = 2.0 * np.stack(
            [
                -p[0] * x + p[1] * w - p[2] * z + p[3] * y,
                -p[0] * y + p[1] * z + p[2] * w - p[3] * x,
                -p[0] * z - p[1] * y + p[2] * x + p[3] * w,
            ],
            axis=1,
        )
        late = slice(2000, None)
        assert np.mean(error[late] ** 2 / out.covariance[late][:, [0, 3, 5]]) < 1.2
        assert np.degrees(np.sqrt(np.mean(error[-1000:] ** 2, axis=0))).max() < 2.0
