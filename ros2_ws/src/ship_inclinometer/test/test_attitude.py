# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from attitude_tools import errors, events_of, feed, run_batch
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.consistency import chi2_band
from kalman_core.rotation import quat_multiply
from ship_inclinometer import attitude_layout as k
from ship_inclinometer.attitude_estimator import AttitudeEstimator
from ship_inclinometer.attitude_kernels import imu_step, propagate
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import (
    DEGRADED,
    INVALID,
    VALID,
    Angles,
    Attitude,
    ImuSample,
    MagSample,
    SettledAttitude,
    SpeedSample,
    Validity,
    VelocitySample,
)
from ship_inclinometer.simulation import scenario, simulate

START = 10**18
UP = (0.0, 0.0, 9.8)
SEEDS = range(4)


def rmse(error, after):
    return np.sqrt(np.mean(error[after] ** 2, axis=0))


@pytest.mark.parametrize(
    ('name', 'bar', 'params'),
    [
        ('beam', 0.25, {}),
        ('swell', 0.25, {}),
        ('quartering', 0.25, {}),
        ('head', 0.25, {}),
        ('storm', 0.30, {}),
        ('turns_gnss', 0.10, {'antenna_lever_arm': (10.0, 3.0, 10.0)}),
        ('sine', 0.40, {}),
        ('paper', 0.40, {}),
    ],
)
def test_roll_and_pitch_stay_within_the_bar(name, bar, params):
    worst = []
    for seed in SEEDS:
        recording = simulate(scenario(name, duration=360.0), seed)
        error, _ = errors(recording, run_batch(recording, AttitudeParams(**params)))
        worst.append(rmse(error, recording.truth.t > 60.0))
    assert np.max(np.sqrt(np.mean(np.square(worst), axis=0))[:2]) < bar


def test_a_turn_without_speed_is_declared_and_with_a_log_is_not():
    recording = simulate(scenario('turns', duration=300.0, turn_starts=(120.0, -1.0)), 3)
    for with_log in (False, True):
        estimator = AttitudeEstimator()
        out = feed(estimator, events_of(recording, with_log=with_log))
        states = [(e.stamp - START) / 1e9 for e in out if isinstance(e, Validity) and e.validity == DEGRADED]
        turning = [t for t in states if 130.0 < t < 200.0]
        assert bool(turning) is not with_log
        angles = [e for e in out if isinstance(e, Angles) and e.stamp - START > 60 * 10**9]
        times = np.array([(e.stamp - START) / 1e9 for e in angles])
        roll = np.interp(times, recording.truth.t, recording.truth.angles[:, 0])
        error = np.degrees(np.abs(np.array([e.angles[0] for e in angles]) - roll))
        valid = np.array([e.validity == VALID for e in angles])
        assert np.max(error[valid]) < 1.0


def test_valid_within_60_s_of_a_start_in_motion_with_a_bias_of_5_deg_s():
    recording = simulate(scenario('hot_start', duration=90.0), 2)
    out = feed(AttitudeEstimator(), events_of(recording))
    valid = [e for e in out if isinstance(e, Validity) and e.validity == VALID]
    assert (valid[0].stamp - START) / 1e9 < 60.0
    error, _ = errors(recording, run_batch(recording, AttitudeParams()))
    assert np.max(np.abs(error[recording.truth.t > 60.0, :2])) < 1.0


def test_a_start_at_any_tilt_finds_the_heading():
    # Steep waves: the first specific force may be 30° off the vertical, and the dip makes any heading of it.
    steep = {'peak_period': 6.0, 'duration': 90.0}
    for seed in (1003, *range(2000, 2006)):
        recording = simulate(scenario('beam', **steep), seed)
        error, _ = errors(recording, run_batch(recording, AttitudeParams()))
        assert np.max(np.abs(error[recording.truth.t > 60.0])) < 4.0


def test_a_heading_that_was_lost_is_found_again():
    recording = simulate(scenario('beam', duration=300.0), 0)
    estimator = AttitudeEstimator()
    events = events_of(recording)
    split = sum(e[0] < START + 60 * 10**9 for e in events)
    feed(estimator, events[:split])
    turned = np.array([np.cos(1.0), 0.0, 0.0, np.sin(1.0)])
    estimator.state[k.S_Q : k.S_Q + 4] = quat_multiply(turned, estimator.state[k.S_Q : k.S_Q + 4])
    out = feed(estimator, events[split:])
    last = [e for e in out if isinstance(e, Angles)][-1]
    error = np.array(last.angles) - recording.truth.angles[-1]
    error = np.degrees((error + np.pi) % (2.0 * np.pi) - np.pi)
    assert np.all(np.abs(error) < (1.5, 1.5, 6.0))


def test_error_is_what_the_covariance_says():
    runs = 12
    for name, params in (('beam', {}), ('turns_gnss', {'antenna_lever_arm': (10.0, 3.0, 10.0)})):
        values = []
        for seed in range(100, 100 + runs):
            recording = simulate(scenario(name, duration=300.0), seed)
            _, nees = errors(recording, run_batch(recording, AttitudeParams(**params)))
            values.append(np.mean(nees[recording.truth.t > 100.0]))
        low, high = chi2_band(0.99, 2, runs)
        assert low < np.mean(values) < high, name


def test_streaming_equals_batch_to_the_last_bit():
    recording = simulate(scenario('turns_gnss', duration=40.0), 5)
    params = AttitudeParams(align_time=10.0)
    batch = run_batch(recording, params)
    out = feed(AttitudeEstimator(params), events_of(recording))
    streamed = {e.stamp: e.q for e in out if isinstance(e, Attitude)}
    compared = 0
    for t, row in zip(recording.truth.t, batch):
        q = streamed.get(START + round(t * 1e9))
        if q is not None:
            np.testing.assert_array_equal(q, row[:4])
            compared += 1
    assert compared > 5000


def test_settled_estimates_do_not_depend_on_the_order_of_arrival():
    recording = simulate(scenario('turns_gnss', duration=26.0), 5)
    params = AttitudeParams(align_time=10.0, settled_output=True)
    events = events_of(recording)
    rng = np.random.default_rng(0)
    delayed = [e[0] + (int(rng.uniform(0.0, 0.3) * 1e9) if e[1] else 0) for e in events]
    shuffled = [events[i] for i in np.argsort(delayed, kind='stable')]
    results = []
    for order in (events, shuffled):
        out = feed(AttitudeEstimator(params), order)
        results.append({e.stamp: e.q.tobytes() for e in out if isinstance(e, SettledAttitude)})
    common = set(results[0]) & set(results[1])
    assert len(common) > 2500
    assert all(results[0][stamp] == results[1][stamp] for stamp in common)


def test_turning_the_world_turns_the_heading_alone():
    base = simulate(scenario('beam', duration=120.0, course=30.0), 4)
    turned = simulate(scenario('beam', duration=120.0, course=120.0), 4)
    first, second = (errors(r, run_batch(r, AttitudeParams()))[0] for r in (base, turned))
    # The residual iron differs by heading; tilt may not see that.
    np.testing.assert_allclose(first[12000:, :2], second[12000:, :2], atol=0.1)


def test_a_magnetic_disturbance_moves_no_tilt_and_is_declared():
    changes = {'duration': 200.0, 'disturbance_start': 100.0, 'disturbance_time': 40.0}
    clean = simulate(scenario('beam', duration=200.0), 6)
    recording = simulate(scenario('disturbed', **changes), 6)
    error, _ = errors(recording, run_batch(recording, AttitudeParams()))
    undisturbed, _ = errors(clean, run_batch(clean, AttitudeParams()))
    np.testing.assert_allclose(error[:, :2], undisturbed[:, :2], atol=0.1)
    out = feed(AttitudeEstimator(), events_of(recording))
    during = [e for e in out if isinstance(e, Validity) and 110 < (e.stamp - START) / 1e9 < 139]
    assert all(not e.heading_valid and e.reason == 'magnetic disturbance' for e in during)
    after = [e for e in out if isinstance(e, Validity) and (e.stamp - START) / 1e9 > 150]
    assert all(e.heading_valid for e in after)


def test_a_field_that_stays_changed_is_learned_anew():
    changes = {'duration': 200.0, 'disturbance_start': 60.0, 'disturbance_time': 1e6}
    recording = simulate(scenario('disturbed', **changes), 6)
    estimator = AttitudeEstimator(AttitudeParams(magnetic_lockout=30.0))
    feed(estimator, events_of(recording))
    assert estimator.tally.sensor('imu/mag').rejected['field learned anew after a lasting change'] >= 1
    assert estimator.tally.sensor('imu/mag').last_stamp > START + 195 * 10**9


def test_a_gap_restarts_and_says_so_and_keeps_the_bias():
    recording = simulate(scenario('beam', duration=120.0), 1)
    estimator = AttitudeEstimator()
    events = [e for e in events_of(recording) if not 60.0 < (e[0] - START) / 1e9 < 62.0]
    out = feed(estimator, events)
    assert any('no IMU sample' in reason for reason in estimator.tally.restarts)
    valid = [(e.stamp - START) / 1e9 for e in out if isinstance(e, Validity) and e.validity == VALID]
    assert max(valid) > 110.0


def test_time_that_goes_back_restarts_the_filter():
    recording = simulate(scenario('beam', duration=30.0), 1)
    estimator = AttitudeEstimator()
    feed(estimator, events_of(recording))
    feed(estimator, events_of(recording))
    assert len(estimator.tally.restarts) == 1
    assert 'back' in estimator.tally.restarts[0]


def test_old_aiding_samples_in_a_row_restart_nothing():
    estimator = AttitudeEstimator()
    for n in range(400):
        estimator.on_imu(ImuSample(START + n * 5_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    for n in range(50):
        estimator.on_mag(MagSample(START + n * 1000, (2e-5, 0.0, -4e-5)))
    assert estimator.tally.restarts == []
    assert estimator.tally.sensor('imu/mag').rejected['older than the lag window'] == 50


BAD = (math.nan, math.inf, -math.inf, 0.0, 1e30, 1.0)
TRIPLE = st.tuples(*[st.sampled_from(BAD)] * 3)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), TRIPLE, TRIPLE, st.integers(-(10**9), 10**9)), max_size=60))
def test_nothing_bad_comes_out_whatever_goes_in(samples):
    estimator = AttitudeEstimator(AttitudeParams(align_time=2.0))
    stamp = START
    out = []
    for n in range(100):
        out += estimator.on_imu(ImuSample(START + n * 5_000_000, (0.0, 0.0, 0.0), (0.1, 0.0, 9.8)))
    for port, first, second, shift in samples:
        stamp += 5_000_000
        if port == 0:
            out += estimator.on_imu(ImuSample(stamp + 5 * 10**8 + shift, first, second))
        elif port == 1:
            estimator.on_mag(MagSample(stamp + shift, first))
        elif port == 2:
            estimator.on_gnss(VelocitySample(stamp + shift, first, second))
        else:
            estimator.on_log(SpeedSample(stamp + shift, first[0]))
    for estimate in out:
        if isinstance(estimate, Attitude):
            assert np.all(np.isfinite(estimate.q))
            assert np.all(np.isfinite(estimate.covariance))


def test_it_recovers_from_a_burst_of_wild_but_plausible_samples():
    recording = simulate(scenario('beam', duration=300.0), 1)
    events = events_of(recording)
    wild = []
    for stamp, port, sample in events:
        if port == 0 and 100.0 < (stamp - START) / 1e9 < 100.5:
            sample = sample._replace(force=(30.0, -40.0, 60.0), gyro=(3.0, -3.0, 2.0))
        wild.append((stamp, port, sample))
    estimator = AttitudeEstimator()
    out = feed(estimator, wild)
    last = [e for e in out if isinstance(e, Angles)][-1]
    truth = np.interp((last.stamp - START) / 1e9, recording.truth.t, recording.truth.angles[:, 0])
    assert abs(math.degrees(last.angles[0] - truth)) < 1.0


def test_transitions_are_those_of_numerical_derivatives():
    """The chain of elementary transitions against the nominal step itself, perturbed state by state."""
    recording = simulate(scenario('turns', duration=60.0, turn_starts=(20.0, -1.0)), 1)
    params = AttitudeParams(align_time=5.0, aiding_interval=5.0)
    estimator = AttitudeEstimator(params)
    feed(estimator, events_of(recording)[: 40 * 275])
    model = estimator.model
    base = model.state.copy()
    base[k.S_AIDED] = base[k.S_PATH] = base[k.S_TIME]  # no aiding within the step
    dt, gyro, force = 0.005, np.array([0.1, -0.05, 0.03]), np.array([0.5, 1.0, 9.6])
    base[k.S_RATE : k.S_RATE + 3] = gyro - base[k.S_BG : k.S_BG + 3]
    base[k.S_FORCE : k.S_FORCE + 3] = force - base[k.S_BA : k.S_BA + 3]
    from ship_inclinometer.attitude_update import inject

    def moved(index, size):
        state = base.copy()
        error = np.zeros(k.N)
        error[index] = size
        inject(state, error)
        state[k.S_RATE : k.S_RATE + 3] = gyro - state[k.S_BG : k.S_BG + 3]
        state[k.S_FORCE : k.S_FORCE + 3] = force - state[k.S_BA : k.S_BA + 3]
        imu_step(state, model._settings, base[k.S_TIME] + dt, gyro, force, np.zeros(2))
        return state

    from kalman_core.rotation import quat_conjugate, quat_multiply, rotvec_from_quat

    def difference(a, b):
        out = np.zeros(k.N)
        relative = quat_multiply(a[k.S_Q : k.S_Q + 4], quat_conjugate(b[k.S_Q : k.S_Q + 4]))
        out[:3] = rotvec_from_quat(relative)
        pairs = ((k.BG, k.S_BG, 3), (k.BA, k.S_BA, 3), (k.V, k.S_V, 3), (k.P_, k.S_P, 3))
        for to, source, count in (*pairs, (k.VP, k.S_VP, 2), (k.X1, k.S_X1, 3), (k.X2, k.S_X2, 3)):
            out[to : to + count] = a[source : source + count] - b[source : source + count]
        return out

    step = 1e-4
    numeric = np.column_stack(
        [difference(moved(i, step), moved(i, -step)) / (2 * step) for i in range(k.N - 1)]
    )
    # The covariance of independent unit errors is F Fᵀ, noise apart: read F from its products.
    quiet = model._settings.copy()
    for index in (
        k.C_GYRO_NOISE,
        k.C_BIAS_WALK,
        k.C_ACC_NOISE,
        k.C_ACC_BIAS_WALK,
        k.C_PATH_WALK,
        k.C_PATH_TURN,
    ):
        quiet[index] = 0.0
    state = base.copy()
    state[k.S_VIBRATION] = state[k.S_DRIVE] = state[k.S_DRIVE + 1] = 0.0
    from kalman_core.rotation import matrix_from_quat

    mat = matrix_from_quat(base[k.S_Q : k.S_Q + 4])
    rate = gyro - base[k.S_BG : k.S_BG + 3]
    for i in range(k.N - 1):
        cov = np.zeros((k.N, k.N))
        cov[i, i] = 1.0
        propagate(state, cov, quiet, mat, mat @ (force - base[k.S_BA : k.S_BA + 3]), float(mat[2] @ rate), dt)
        column = cov[:, i] / math.sqrt(cov[i, i]) if cov[i, i] > 0 else np.zeros(k.N)
        np.testing.assert_allclose(column, numeric[:, i], atol=2e-3)


def test_invalid_is_said_first_and_no_attitude_comes_with_it():
    estimator = AttitudeEstimator()
    out = estimator.on_imu(ImuSample(START, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    assert [type(e) for e in out] == [Validity]
    assert out[0].validity == INVALID


@pytest.mark.parametrize(
    ('feed_one', 'sensor', 'reason'),
    [
        (
            lambda e, t: e.on_imu(ImuSample(t, (0.0,) * 3, (0.0,) * 3, 'imu')),
            'imu/data_raw',
            'zero specific force',
        ),
        (
            lambda e, t: e.on_imu(ImuSample(t, (math.nan, 0.0, 0.0), UP, 'imu')),
            'imu/data_raw',
            'angular velocity out of range',
        ),
        (
            lambda e, t: e.on_imu(ImuSample(t, (0.0,) * 3, (1e9, 0.0, 9.8), 'imu')),
            'imu/data_raw',
            'specific force out of range',
        ),
        (lambda e, t: e.on_imu(ImuSample(t, (0.0,) * 3, UP, 'camera')), 'imu/data_raw', 'foreign frame'),
        (lambda e, t: e.on_mag(MagSample(t, (math.inf, 0.0, 0.0))), 'imu/mag', 'field out of range'),
        (lambda e, t: e.on_mag(MagSample(t, (0.0,) * 3)), 'imu/mag', 'zero field'),
        (
            lambda e, t: e.on_gnss(VelocitySample(t, (1e6, 0.0, 0.0), (1.0,) * 3)),
            'gnss/velocity',
            'velocity out of range',
        ),
        (
            lambda e, t: e.on_gnss(VelocitySample(t, (1.0, 0.0, 0.0), (math.nan,) * 3)),
            'gnss/velocity',
            'variance not finite',
        ),
        (lambda e, t: e.on_log(SpeedSample(t, math.nan)), 'log/speed', 'speed out of range'),
        (lambda e, t: e.on_log(SpeedSample(t - 10**10, 1.0)), 'log/speed', 'older than the lag window'),
        (lambda e, t: e.on_log(SpeedSample(t + 10**10, 1.0)), 'log/speed', 'ahead of the IMU'),
    ],
)
def test_what_is_no_measurement_is_refused_by_name_and_changes_nothing(feed_one, sensor, reason):
    estimator = AttitudeEstimator(AttitudeParams(frame_id='imu'))
    for i in range(400):
        estimator.on_imu(ImuSample(START + i * 5_000_000, (0.0,) * 3, UP, 'imu'))
    before = estimator.state.copy()
    stamp = START + 400 * 5_000_000
    assert feed_one(estimator, stamp) == []
    assert estimator.tally.sensor(sensor).rejected == {reason: 1}
    np.testing.assert_array_equal(estimator.state, before)


def at_rest(seconds, schedule='full'):
    """Return an estimator after `seconds` at rest, and its outputs."""
    estimator = AttitudeEstimator(AttitudeParams(schedule=schedule, align_time=2.0))
    return estimator, feed(estimator, still(seconds))


def still(seconds, start=START):
    """Return the events of a craft at rest: IMU and field at 50 Hz."""
    events = []
    for i in range(round(seconds * 50)):
        stamp = start + i * 20_000_000
        events.append((stamp, 0, ImuSample(stamp, (0.001, -0.002, 0.003), (0.3, -0.2, 9.8))))
        events.append((stamp, 1, MagSample(stamp, (2e-5, 1e-6, -4e-5))))
    return events


@pytest.mark.parametrize('schedule', ['full', 'published'])
def test_a_reset_forgets_everything(schedule):
    estimator, first = at_rest(6.0, schedule=schedule)
    estimator.reset()
    again = feed(estimator, still(6.0))
    before, after = ([e for e in out if isinstance(e, Attitude)] for out in (first, again))
    assert len(before) > 100
    assert [(e.stamp, *e.q, e.validity) for e in after] == [(e.stamp, *e.q, e.validity) for e in before]


def test_a_calibration_is_applied_to_the_raw_samples():
    rng = np.random.default_rng(5)
    matrix = {n: np.eye(3) + 0.05 * rng.standard_normal((3, 3)) for n in ('force', 'field')}
    offset = {'gyro': 0.01 * rng.standard_normal(3), 'force': rng.standard_normal(3)}
    offset['field'] = 1e-5 * rng.standard_normal(3)

    def raw(name, values):
        return tuple(np.linalg.solve(matrix.get(name, np.eye(3)), values) + offset[name])

    events = [
        (t, 0, s._replace(gyro=raw('gyro', s.gyro), force=raw('force', s.force)))
        if port == 0
        else (t, 1, s._replace(field=raw('field', s.field)))
        for t, port, s in still(6.0)
    ]
    calibrated = AttitudeEstimator(
        AttitudeParams(
            align_time=2.0,
            gyro_offset=tuple(offset['gyro']),
            accelerometer_offset=tuple(offset['force']),
            accelerometer_matrix=tuple(matrix['force'].ravel()),
            magnetometer_offset=tuple(offset['field']),
            magnetometer_matrix=tuple(matrix['field'].ravel()),
        )
    )
    found = [e.q for e in feed(calibrated, events) if isinstance(e, Attitude)]
    expected = [e.q for e in at_rest(6.0)[1] if isinstance(e, Attitude)]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_speed_log_that_is_refused_for_long_is_believed_by_and_by():
    estimator, _ = at_rest(6.0)
    log = estimator.tally.sensor('log/speed')
    refused, last = 0, START
    for second in range(6, 24):
        last = START + second * 10**9
        feed(estimator, still(1.0, last))
        estimator.on_log(SpeedSample(last + 900_000_000, 0.0 if second < 8 else 12.0))
        refused += second == 8 and log.rejected['innovation']
    assert refused == 1
    assert 10 <= log.rejected['innovation'] <= 15
    assert log.last_stamp > last


def test_what_comes_before_the_first_imu_sample_is_refused():
    estimator = AttitudeEstimator()
    estimator.on_mag(MagSample(START, (2e-5, 0.0, -4e-5)))
    estimator.on_log(SpeedSample(START, 3.0))
    assert not estimator.state.any()
    assert estimator.tally.sensor('imu/mag').rejected.total() == 1
    assert estimator.tally.sensor('log/speed').rejected.total() == 1
