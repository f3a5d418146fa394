# SPDX-License-Identifier: Apache-2.0
"""The attitude estimator as a whole: start, rest, field, faults, order of arrival, honesty, recordings."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from attitude_errors import errors, rms, rotation
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imu_kalman import attitude_layout as layout
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.attitude_batch import filter_batch
from imu_kalman.params import AttitudeParams
from imu_kalman.samples import Attitude, GyroBias, ImuSample, MagSample, SettledAttitude
from imu_kalman.scenario_matched import matched_params, matched_world
from imu_kalman.scenarios import ShipParams, rolling_ship
from imu_kalman.smoother import smooth

FIELD = np.array([0.0, 18e-6, -45e-6])
DT = 5_000_000


def still(attitude, seconds, gyr=(0.0, 0.0, 0.0), field=FIELD, first=10**9):
    """Samples of a body at rest: (ImuSample, MagSample) pairs at 200 Hz."""
    acc = tuple(attitude.inv().apply([0.0, 0.0, 9.81]).tolist())
    mag = tuple(attitude.inv().apply(field).tolist())
    for i in range(round(seconds * 200)):
        yield ImuSample(first + i * DT, gyr, acc), MagSample(first + i * DT, mag)


def feed(estimator, pairs):
    last = None
    for imu, mag in pairs:
        for estimate in estimator.on_imu(imu):
            if type(estimate) is Attitude:
                last = estimate
        estimator.on_mag(mag)
    return last


def rows(recording):
    columns = (recording.stamp, recording.gyr, recording.acc, recording.mag)
    for stamp, gyr, acc, mag in zip(*(column.tolist() for column in columns)):
        yield ImuSample(stamp, tuple(gyr), tuple(acc)), MagSample(stamp, tuple(mag))


def test_one_sample_is_enough_for_roll_and_pitch_and_a_first_field_for_heading():
    truth = Rotation.from_euler('ZYX', [2.0, -0.4, 2.5])
    estimator = AttitudeFilter()
    first = feed(estimator, still(truth, 0.005))
    up = rotation(first.orientation).apply(truth.inv().apply([0, 0, 1]))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
    last = feed(estimator, still(truth, 0.3, first=10**9 + DT))
    assert (rotation(last.orientation) * truth.inv()).magnitude() < math.radians(6)


def test_stream_and_arrays_give_the_same_bits():
    ship = rolling_ship(ShipParams(duration=20.0), seed=2)
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    streamed = []
    for imu, mag in rows(ship):
        streamed += [e.values[:4] for e in estimator.on_imu(imu) if type(e) is Attitude]
        estimator.on_mag(mag)
    batch = filter_batch(ship.stamp, ship.gyr, ship.acc, ship.mag)
    np.testing.assert_array_equal(batch.orientation, np.array(streamed))


def test_arrays_skip_what_the_stream_rejects():
    ship = rolling_ship(ShipParams(duration=10.0), seed=2)
    gyr, acc, mag, stamp = ship.gyr.copy(), ship.acc.copy(), ship.mag.copy(), ship.stamp.copy()
    gyr[500] = np.nan
    acc[600, 1] = 1e9
    acc[650] = 0.0
    mag[700] = np.inf
    mag[701] = 0.0
    mag[702] = 1e-170
    stamp[800] = stamp[799]
    bad = ship._replace(gyr=gyr, acc=acc, mag=mag, stamp=stamp)
    batch = filter_batch(stamp, gyr, acc, mag)
    assert np.isfinite(batch.orientation).all()
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    for imu, field in rows(bad):
        for estimate in estimator.on_imu(imu):
            if type(estimate) is Attitude:
                last = estimate
        estimator.on_mag(field)
    np.testing.assert_array_equal(batch.orientation[-1], last.values[:4])


def test_shifted_stamps_change_no_bit():
    ship = rolling_ship(ShipParams(duration=10.0), seed=1)
    shifted = filter_batch(ship.stamp + 123_456_789_012_345, ship.gyr, ship.acc, ship.mag)
    plain = filter_batch(ship.stamp, ship.gyr, ship.acc, ship.mag)
    np.testing.assert_array_equal(plain.orientation, shifted.orientation)
    np.testing.assert_array_equal(plain.covariance, shifted.covariance)


def test_a_sensor_mounted_another_way_gives_the_same_attitude():
    ship = rolling_ship(ShipParams(duration=30.0), seed=1)
    mount = Rotation.from_euler('ZYX', [90.0, 0.0, 180.0], degrees=True)
    turned = filter_batch(ship.stamp, *(mount.apply(v) for v in (ship.gyr, ship.acc, ship.mag)))
    plain = filter_batch(ship.stamp, ship.gyr, ship.acc, ship.mag)
    # The first samples differ: roll and pitch of one sample leave heading to chance.
    late = slice(1000, None)
    back = rotation(turned.orientation[late]) * mount
    assert (back * rotation(plain.orientation[late]).inv()).magnitude().max() < 1e-6
    np.testing.assert_allclose(turned.covariance[late], plain.covariance[late], rtol=1e-6, atol=1e-12)


def test_order_of_arrival_within_the_window_changes_no_bit_of_state_and_settled_output():
    ship = rolling_ship(ShipParams(duration=4.0), seed=3)
    samples = [(port, sample) for pair in rows(ship) for port, sample in enumerate(pair)]
    rng = np.random.default_rng(0)
    order = np.argsort(np.arange(len(samples)) + rng.uniform(0, 120, len(samples)), kind='stable')
    settled, states = [], []
    for sequence in (samples, [samples[i] for i in order]):
        estimator = AttitudeFilter(AttitudeParams(settled_output=True))
        found = {}
        for port, sample in sequence:
            for estimate in (estimator.on_mag if port else estimator.on_imu)(sample):
                if isinstance(estimate, SettledAttitude):
                    found[estimate.stamp] = estimate.values.tobytes()
        settled.append(found)
        states.append(estimator.state.tobytes())
    common = settled[0].keys() & settled[1].keys()
    assert len(common) > 600
    assert all(settled[0][k] == settled[1][k] for k in common)
    assert states[0] == states[1]


def test_rest_reveals_the_gyro_bias():
    rng = np.random.default_rng(0)
    bias = np.radians([0.8, -0.5, 1.2])
    estimator, published = AttitudeFilter(), []
    for imu, mag in still(Rotation.identity(), 10.0):
        gyr = tuple((bias + np.radians(0.1) * rng.normal(size=3)).tolist())
        published += [e for e in estimator.on_imu(imu._replace(gyr=gyr)) if isinstance(e, GyroBias)]
        estimator.on_mag(mag)
    np.testing.assert_allclose(published[-1].bias, bias, atol=np.radians(0.02))
    assert len(published) == 10
    assert (np.abs(published[-1].bias - bias) < 4 * np.sqrt(np.diag(published[-1].covariance))).all()


@pytest.mark.parametrize('roll', [15.0, 7.5, 3.0])
def test_a_rolling_ship_is_never_taken_for_rest_and_attitude_holds_the_bars(roll):
    ship = rolling_ship(ShipParams(roll=roll, duration=200.0), seed=0)
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    longest, found = 0.0, []
    for imu, mag in rows(ship):
        found += [e.values[:4] for e in estimator.on_imu(imu) if type(e) is Attitude]
        estimator.on_mag(mag)
        longest = max(longest, estimator.state[layout.REST_TIME])
    assert longest < estimator.params.rest_time
    _, heading, inclination = rms(errors(np.array(found), ship.orientation)[30 * 200 :])
    assert inclination < 0.35
    assert heading < 1.2  # the bar of 1.0 holds over 600 s, 50 seeds


@pytest.mark.parametrize('rate', [10.0, 19.0, 20.0])
def test_a_sensor_slower_than_a_block_holds_the_attitude(rate):
    params = AttitudeParams(sensor_delay=0.0, mag_delay=0.0)
    ship = rolling_ship(ShipParams(rate=rate, duration=200.0), seed=0)
    late = slice(round(60 * rate), None)
    for jitter in (0.0, 2e-3):
        moved = np.random.default_rng(0).normal(0.0, jitter * 1e9, len(ship.stamp)).astype(np.int64)
        out = filter_batch(ship.stamp + moved, ship.gyr, ship.acc, ship.mag, params=params)
        _, heading, inclination = errors(out.orientation, ship.orientation)[late].T
        assert rms(inclination) < 0.5
        assert rms(heading) < 2.0
        variance = out.covariance[late, 0] + out.covariance[late, 3]
        assert np.mean(np.radians(inclination) ** 2 / variance) < 2.0


def test_fields_between_the_samples_of_a_slow_gyro_are_taken_where_they_were_measured():
    # 5 samples a second of a turn at 0.6 rad/s, the field halfway between them: half a sample is 3.4 degrees.
    n, rate = 300, 5.0
    stamp = 10**9 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
    truth = Rotation.from_rotvec(np.outer(0.6 * np.arange(n) / rate, [0.0, 0.0, 1.0]))
    between = truth * Rotation.from_rotvec([0.0, 0.0, 0.06])
    params = AttitudeParams(sensor_delay=0.0, mag_delay=0.0, block=0.02)
    gyr, acc = np.tile([0.0, 0.0, 0.6], (n, 1)), np.tile([0.0, 0.0, 9.81], (n, 1))
    half = stamp + 10**8
    out = filter_batch(stamp, gyr, acc, between.inv().apply(FIELD), mag_stamp=half, params=params)
    assert (rotation(out.orientation[-1]) * truth[-1].inv()).magnitude() < math.radians(0.5)


def test_without_a_field_roll_and_pitch_hold_and_yaw_says_that_it_drifts():
    ship = rolling_ship(ShipParams(duration=120.0), seed=0)
    out = filter_batch(ship.stamp, ship.gyr, ship.acc)
    assert rms(errors(out.orientation, ship.orientation)[60 * 200 :])[2] < 0.6
    yaw = out.covariance[:, 5]
    assert yaw[-1] > yaw[100] > 1.0
    with_field_off = filter_batch(
        ship.stamp, ship.gyr, ship.acc, ship.mag, params=AttitudeParams(use_magnetometer=False)
    )
    np.testing.assert_array_equal(with_field_off.orientation, out.orientation)


def test_fields_that_are_not_asked_for_are_neither_accepted_nor_refused():
    estimator = AttitudeFilter(AttitudeParams(use_magnetometer=False))
    feed(estimator, still(Rotation.identity(), 1.0))
    mag = estimator.tally.sensor('imu/mag')
    assert (mag.accepted, mag.rejected.total(), mag.nis) == (0, 0, None)


def test_a_passing_magnet_is_rejected_and_a_lasting_one_becomes_the_reference():
    truth = Rotation.from_euler('ZYX', [0.7, 0.1, 0.2])
    estimator = AttitudeFilter()
    feed(estimator, still(truth, 30.0))
    magnet = FIELD + np.array([30e-6, 0.0, 10e-6])
    disturbed = feed(estimator, still(truth, 5.0, field=magnet, first=31 * 10**9))
    assert (rotation(disturbed.orientation) * truth.inv()).magnitude() < math.radians(1)
    assert estimator.tally.sensors['imu/mag'].rejected['disturbed field'] > 900
    later = feed(estimator, still(truth, 40.0, field=magnet, first=36 * 10**9))
    heading = math.atan2(magnet[0], magnet[1])
    expected = Rotation.from_rotvec([0, 0, heading]) * truth
    assert (rotation(later.orientation) * expected.inv()).magnitude() < math.radians(3)


def test_a_gap_starts_attitude_anew_and_keeps_the_bias():
    bias = (0.02, -0.01, 0.015)
    estimator = AttitudeFilter()
    feed(estimator, still(Rotation.identity(), 5.0, gyr=bias))
    other = Rotation.from_euler('ZYX', [1.0, 0.5, -1.0])
    last = feed(estimator, still(other, 2.0, gyr=bias, first=8 * 10**9))
    assert estimator.tally.restarts == ['attitude from one sample after a gap']
    assert (rotation(last.orientation) * other.inv()).magnitude() < math.radians(2)
    np.testing.assert_allclose(estimator.state[layout.BIAS : layout.BIAS + 3], bias, atol=2e-4)


def test_a_dead_accelerometer_is_no_free_fall():
    estimator, healthy = AttitudeFilter(), AttitudeFilter()
    tilted = Rotation.from_euler('x', 20.0, degrees=True)
    pairs = list(still(tilted, 5.0))
    last = [feed(estimator, dead(pairs)), feed(healthy, pairs)]
    assert estimator.tally.sensors['imu/data_raw'].rejected['zero specific force'] == len(pairs) // 3
    apart = rotation(last[0].orientation) * rotation(last[1].orientation).inv()
    assert math.degrees(apart.magnitude()) < 0.1


def dead(pairs):
    """Yield the samples, every third without any force."""
    for i, (imu, mag) in enumerate(pairs):
        yield (ImuSample(imu.stamp, imu.gyr, (0.0, 0.0, 0.0)) if i % 3 == 2 else imu), mag


def test_single_wild_samples_are_bridged_and_a_lasting_step_is_believed():
    estimator = AttitudeFilter()
    feed(estimator, still(Rotation.identity(), 5.0))
    spike = ImuSample(6 * 10**9, (90.0, -90.0, 90.0), (0.0, 300.0, 0.0))
    (estimate,) = (e for e in estimator.on_imu(spike) if type(e) is Attitude)
    assert estimator.tally.sensors['imu/data_raw'].rejected['wild jump'] == 1
    assert rotation(estimate.orientation).magnitude() < math.radians(1)
    gyr = (0.0, 0.0, 30.0)
    for i in range(4):
        estimator.on_imu(ImuSample(6 * 10**9 + (i + 1) * DT, gyr, (0.0, 0.0, 9.81)))
    assert estimator.state[layout.RATE + 2] == pytest.approx(30.0, abs=0.01)


def test_an_attitude_that_contradicts_gravity_is_given_up():
    estimator = AttitudeFilter()
    feed(estimator, still(Rotation.identity(), 5.0))
    over = Rotation.from_euler('x', 170, degrees=True)
    last = feed(estimator, still(over, 2.0, first=6 * 10**9))
    assert (rotation(last.orientation) * over.inv()).magnitude() < math.radians(3)
    assert 'attitude contradicted gravity' in estimator.tally.restarts


@pytest.mark.parametrize('estimate', [filter_batch, smooth])
def test_error_is_what_the_covariance_says(estimate):
    params, seeds = matched_params(), 30
    nees = []
    for seed in range(seeds):
        world = matched_world(params, seed, duration=100.0)
        out = estimate(world.stamp, world.gyr, world.acc, world.mag, params=params)
        # Late for the filter, with half of the recording still to come for the smoother.
        at = len(world.stamp) // 2
        error = (rotation(world.orientation[at]) * rotation(out.orientation[at]).inv()).as_rotvec()
        xx, xy, xz, yy, yz, zz = out.covariance[at]
        cov = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        nees.append(error @ np.linalg.solve(cov, error))
    low, high = chi2.ppf((0.025, 0.975), 3 * seeds) / seeds
    assert low < np.mean(nees) < high


@pytest.mark.parametrize('field', [5e-324, 1e-170, 1e-9])
def test_a_field_too_weak_to_have_a_direction_is_none(field):
    estimator = AttitudeFilter()
    feed(estimator, still(Rotation.identity(), 2.0, field=(field, 0.0, 0.0)))
    assert np.isfinite(estimator.state).all()
    assert estimator.tally.sensors['imu/mag'].rejected['zero field'] == 400


numbers = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, width=64),
    st.floats(-100.0, 100.0),
    st.sampled_from((0.0, 5e-324, 1e-170, 1e-9, 1.1e-9)),
)
vectors = st.tuples(numbers, numbers, numbers)
steps = st.one_of(st.integers(-(10**9), 3 * 10**9), st.just(DT))


@settings(max_examples=60, deadline=None)
@example([(160_319_281, (3.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 77.0))], 0)  # a covariance left wide
@example([(171_291_241, (3.0, 11.0, 6.0), (0.0, 1.0, 44.0), (0.0, 2.0, 65.0))], 0)  # a turn hidden by a gap
@given(st.lists(st.tuples(steps, vectors, vectors, vectors), max_size=60), st.integers(0, 3))
def test_whatever_comes_no_estimate_is_ever_non_finite_and_clean_data_is_followed_within_two_seconds(
    stream, pause
):
    estimator = AttitudeFilter(AttitudeParams(lag_window=0.0))
    feed(estimator, still(Rotation.identity(), 1.0))
    stamp = newest = 2 * 10**9
    for step, gyr, acc, mag in stream:
        stamp += step
        newest = max(newest, stamp)
        for estimate in estimator.on_imu(ImuSample(stamp, gyr, acc)):
            if isinstance(estimate, Attitude):
                assert np.isfinite(estimate.values).all()
        estimator.on_mag(MagSample(stamp, mag))
    truth = Rotation.from_euler('ZYX', [0.3, 0.2, -0.4])
    last = feed(estimator, still(truth, 2.0, first=newest + DT + pause * 10**9))
    up = rotation(last.orientation).apply(truth.inv().apply([0, 0, 1]))
    assert math.degrees(math.acos(min(1.0, up[2]))) < 5.0


def test_without_compilation_the_numbers_are_the_same():
    code = (
        'import numpy as np\n'
        'from imu_kalman.scenarios import ShipParams, rolling_ship\n'
        'from imu_kalman.attitude_batch import filter_batch\n'
        's = rolling_ship(ShipParams(duration=3.0), seed=0)\n'
        'print(repr(filter_batch(s.stamp, s.gyr, s.acc, s.mag).orientation[-1].tolist()))\n'
    )
    env = {**os.environ, 'NUMBA_DISABLE_JIT': '1'}
    done = subprocess.run([sys.executable, '-c', code], env=env, capture_output=True, text=True, check=True)
    ship = rolling_ship(ShipParams(duration=3.0), seed=0)
    compiled = filter_batch(ship.stamp, ship.gyr, ship.acc, ship.mag).orientation[-1]
    np.testing.assert_allclose(compiled, eval(done.stdout), rtol=0, atol=1e-9)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r'acc has shape \(3, 2\), expected \(3, 3\)'):
        filter_batch(np.arange(3), np.zeros((3, 3)), np.zeros((3, 2)))


def recorded_trials():
    root = Path(os.environ.get('ESTIMATOR_DATA', Path(__file__).parents[4] / '..' / 'shared' / 'data'))
    return sorted((root / 'imu').glob('broad_*.npz'))


@pytest.mark.skipif(not recorded_trials(), reason='ESTIMATOR_DATA has no imu/broad_*.npz')
def test_recorded_trials_come_out_better_than_the_published_peer_does():
    found = []
    for path in recorded_trials():
        trial = np.load(path)
        gyr, acc, mag = (trial[name].astype(float) for name in ('gyr', 'acc', 'mag'))
        stamp = 10**9 + np.round(np.arange(len(gyr)) * 1e9 / float(trial['fs'])).astype(np.int64)
        out = filter_batch(stamp, gyr, acc, mag * 1e-6, covariance=False)
        scored = trial['movement'].astype(bool) & np.isfinite(trial['quat']).all(axis=1)
        found.append(rms(errors(out.orientation[scored], trial['quat'][scored].astype(float))))
    # VQF 2.1.2 on the same ten trials, as the benchmark measures it: 2.00, 1.83, 0.73 degrees.
    assert (np.mean(found, axis=0) < (2.00, 1.82, 0.72)).all()
