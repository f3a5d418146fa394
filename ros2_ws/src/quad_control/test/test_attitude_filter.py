# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.rotation import euler_from_quat, quat_from_euler, quat_rotate_inverse
from quad_control.attitude_filter import AttitudeFilter, tilt_error
from quad_control.params import GRAVITY, AttitudeParams
from quad_control.samples import Attitude, ImuSample, RawAngle, SettledAttitude

START = 10**9
STEP = 5_000_000


def still(n, roll=0.0, pitch=0.0, bias=(0.0, 0.0, 0.0), seed=0, start=START):
    rng = np.random.default_rng(seed)
    up = quat_rotate_inverse(quat_from_euler(roll, pitch, 0.0), np.array([0.0, 0.0, GRAVITY]))
    return [
        ImuSample(
            start + i * STEP,
            tuple(np.array(bias) + 1e-3 * rng.standard_normal(3)),
            tuple(up + 0.05 * rng.standard_normal(3)),
        )
        for i in range(n)
    ]


def prompt(out):
    return [e for e in out or [] if type(e) is Attitude]


def run(filter_, samples):
    return [e for s in samples for e in prompt(filter_.on_imu(s))]


@pytest.mark.parametrize('name', ['published', 'corrected', 'gyro_driven'])
def test_settles_on_the_tilt_of_a_craft_at_rest(name):
    out = run(AttitudeFilter(AttitudeParams(filter=name)), still(600, roll=0.3, pitch=-0.2))
    roll, pitch, _ = euler_from_quat(np.array(out[-1].quaternion))
    assert (roll, pitch) == pytest.approx((0.3, -0.2), abs=0.01)


def test_a_still_second_gives_the_bias_and_removes_it_from_the_rates():
    bias = (0.05, -0.03, 0.02)
    f = AttitudeFilter()
    out = run(f, still(300, bias=bias))
    assert f.calibrated
    assert f.bias == pytest.approx(bias, abs=5e-4)
    assert max(out[0].rate_variance) > 0.05**2 * 0.9
    assert max(out[-1].rate_variance) < 0.02**2


def test_a_turning_craft_is_not_calibrated():
    samples = [s._replace(rate=(0.3, 0.0, 0.0)) for s in still(300)]
    f = AttitudeFilter()
    run(f, samples)
    assert not f.calibrated


def test_a_frozen_sensor_is_told_by_its_variance_and_forgiven_when_it_moves_again():
    f = AttitudeFilter()
    samples = still(300)
    run(f, samples)
    last = samples[-1]
    frozen = [last._replace(stamp=last.stamp + (i + 1) * STEP) for i in range(20)]
    out = run(f, frozen)
    flagged = [max(e.rate_variance) > 1.0 for e in out]
    # The eighth equal sample: 40 ms after the last true one at 200 Hz.
    assert flagged.index(True) == 6
    assert all(flagged[6:])
    again = run(f, still(5, start=frozen[-1].stamp + STEP, seed=9))
    assert max(again[0].rate_variance) < 1.0


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'rate': (math.nan, 0.0, 0.0)}, 'not finite'),
        ({'force': (0.0, math.inf, 9.8)}, 'not finite'),
        ({'rate': (1e6, 0.0, 0.0)}, 'beyond the sensor range'),
        ({'force': (0.0, 0.0, 0.0)}, 'zero specific force'),
        ({'frame': 'camera'}, "frame 'camera', expected 'base_link'"),
    ],
)
def test_bad_samples_are_refused_by_name_and_leave_nothing_behind(change, reason):
    f = AttitudeFilter()
    samples = still(50)
    run(f, samples[:40])
    state = f.state.copy()
    assert f.on_imu(samples[40]._replace(**change)) is None
    assert np.array_equal(f.state, state)
    assert f.tally.sensor('imu/data_raw').rejected[reason] == 1
    assert run(f, samples[41:])


def test_a_new_frame_is_followed_after_a_second():
    f = AttitudeFilter()
    run(f, still(50))
    moved = [s._replace(frame='other') for s in still(300, start=START + 60 * STEP)]
    assert len(run(f, moved)) > 50
    assert f.tally.restarts == ["frame is now 'other'"]


floats = st.one_of(st.floats(-1e3, 1e3), st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e300, -0.0]))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(-3, 400), floats, floats, floats, floats), max_size=12))
def test_no_sample_makes_it_raise_or_say_something_that_is_not_finite(wild):
    f = AttitudeFilter()
    run(f, still(5))
    stamp = START + 5 * STEP
    for offset, a, b, c, d in wild:
        stamp = max(1, stamp + offset * STEP)
        for e in prompt(f.on_imu(ImuSample(stamp, (a, b, 0.0), (c, d, 9.8)))):
            assert all(map(math.isfinite, (*e.quaternion, *e.rate, *e.attitude_variance)))
    after = still(400, start=stamp + STEP)
    assert len(run(f, after)) > 300


def test_a_late_sample_leaves_the_same_state_as_one_in_time():
    samples = still(100)
    ordered, shuffled = AttitudeFilter(), AttitudeFilter()
    run(ordered, samples)
    order = [*range(40), 45, 41, 44, 40, 43, 42, *range(46, 100)]
    run(shuffled, [samples[i] for i in order])
    assert np.array_equal(ordered.state, shuffled.state)


def test_settled_estimates_come_a_window_later_and_once():
    f = AttitudeFilter()
    out = [e for s in still(300) for e in f.on_imu(s) or []]
    settled = [e.stamp for e in out if type(e) is SettledAttitude]
    assert settled == [START + i * STEP for i in range(len(settled))]
    assert len(settled) == 199
    assert sum(type(e) is RawAngle for e in out) == 300


def test_a_long_gap_starts_the_tilt_anew_and_keeps_the_bias():
    f = AttitudeFilter()
    bias = (0.05, 0.0, 0.0)
    run(f, still(300, bias=bias))
    out = run(f, still(3, roll=0.5, bias=bias, start=START + 900 * STEP))
    assert euler_from_quat(np.array(out[0].quaternion))[0] == pytest.approx(0.5, abs=0.03)
    assert f.bias[0] == pytest.approx(0.05, abs=1e-3)
    assert out[0].attitude_variance[0] > 0.01


def flying(seed, roll, vibration, seconds=0.1):
    """Samples of a craft that flies banked: thrust along its own z axis, and vibration (m/s²)."""
    rng = np.random.default_rng(seed)
    thrust = np.array([0.0, 0.0, GRAVITY / math.cos(roll)])
    return [
        ImuSample(START + i * STEP, (0.0, 0.0, 0.0), tuple(thrust + vibration * rng.standard_normal(3)))
        for i in range(round(seconds / 5e-3))
    ]


def test_a_start_in_flight_is_near_level_whatever_the_vibration_says():
    # One sample of the accelerometer alone would be wrong by 5 m/s² / g = 29° in each axis.
    worst = 0.0
    for seed in range(20):
        out = run(AttitudeFilter(), flying(seed, roll=0.3, vibration=5.0))
        worst = max(worst, tilt_error(out[-1].quaternion, (1.0, 0.0, 0.0, 0.0)))
    assert worst < math.radians(10.0)


@pytest.mark.parametrize('roll', [0.5, -1.2, 2.5])
def test_a_start_on_a_slope_has_its_tilt_at_once(roll):
    out = run(AttitudeFilter(), still(3, roll=roll))
    assert tilt_error(out[-1].quaternion, quat_from_euler(roll, 0.0, 0.0)) < 0.02


@pytest.mark.parametrize('second', [(0.0, 0.0, -9.8), (1e-200, 0.0, 0.0)])
def test_forces_without_a_direction_start_level(second):
    f = AttitudeFilter()
    first, *rest = still(3)
    run(f, [first._replace(force=(0.0, 0.0, 9.8))])
    out = run(f, [rest[0]._replace(force=second)])
    assert all(map(math.isfinite, out[0].quaternion))
    # The same after a long gap, when there is one sample only.
    out = run(f, [rest[1]._replace(stamp=START + 10**10, force=second)])
    assert all(map(math.isfinite, out[0].quaternion))


def test_a_still_window_as_short_as_a_step_leaves_the_start_alone():
    f = AttitudeFilter(AttitudeParams(calibration_time=0.1, period=0.1))
    slow = [s._replace(stamp=START + 20 * i * STEP) for i, s in enumerate(still(5, roll=0.4))]
    out = run(f, slow)
    assert tilt_error(out[0].quaternion, quat_from_euler(0.4, 0.0, 0.0)) < 0.02


def hover_errors(seed, seconds=20.0):
    """Errors over σ at the end of a flight with rotor drag; the truth is made here, not by the plant."""
    rng = np.random.default_rng(seed)
    p = AttitudeParams()
    # The filter's own statistics: gyro white noise, drag noise, a velocity of order 1 m/s.
    n, dt = round(seconds / 0.005), 0.005
    angles = np.zeros(2)
    v = np.zeros(2)
    f = AttitudeFilter(p)
    error0 = 0.02 * rng.standard_normal(2)
    bias = 2e-3 * rng.standard_normal(3)
    f.start(quat_from_euler(*error0, 0.0), np.zeros(3), tilt=0.02, bias_sigma=2e-3)
    out = None
    for i in range(n):
        # A pilot who tilts against the velocity, so that it stays near zero.
        wanted = np.clip(np.array([v[1], -v[0]]) * 0.15, -0.3, 0.3) + 0.05 * np.sin(0.7 * i * dt + seed)
        rate = (wanted - angles) * 3.0
        angles = angles + rate * dt
        v = v + dt * (GRAVITY * np.array([angles[1], -angles[0]]) - p.drag * v)
        noise = p.gyro_noise / math.sqrt(dt) * rng.standard_normal(3)
        force = (
            -p.drag * v[0] + 0.1 / math.sqrt(dt) * rng.standard_normal(),
            -p.drag * v[1] + 0.1 / math.sqrt(dt) * rng.standard_normal(),
            GRAVITY,
        )
        out = prompt(
            f.on_imu(ImuSample(START + i * STEP, (*(rate + bias[:2] + noise[:2]), bias[2] + noise[2]), force))
        )
    roll, pitch, _ = euler_from_quat(np.array(out[0].quaternion))
    sigma = np.sqrt(out[0].attitude_variance[:2])
    return (np.array([roll, pitch]) - angles) / sigma


def test_the_tilt_variance_does_not_promise_more_than_the_error_shows():
    errors = np.concatenate([hover_errors(seed, 8.0) for seed in range(8)])
    # 16 values: the mean square of honest ones stays below 1.8 in 97.5 % of cases (chi-square).
    assert np.mean(errors**2) < 1.8


def test_tilt_error_is_the_angle_between_the_upward_directions():
    assert tilt_error(quat_from_euler(0.3, 0.0, 2.0), quat_from_euler(0.1, 0.0, -1.0)) == pytest.approx(0.2)


def test_no_start_from_a_force_too_small_to_have_a_direction():
    f = AttitudeFilter()
    assert f.on_imu(ImuSample(START, (0.0, 0.0, 0.0), (0.1, 0.0, 0.2))) is None
    assert f.tally.sensor('imu/data_raw').rejected == {'no specific force to start from': 1}
    assert run(f, still(1, start=START + STEP))


def test_a_state_that_is_not_finite_is_declared_and_started_anew():
    f = AttitudeFilter()
    samples = still(20)
    run(f, samples[:10])
    f.state[:] = math.nan
    assert f.on_imu(samples[10]) is None
    assert f.tally.restarts == ['state was not finite']
    roll, pitch, _ = euler_from_quat(np.array(run(f, samples[11:])[-1].quaternion))
    assert (roll, pitch) == pytest.approx((0.0, 0.0), abs=0.03)


def test_new_parameters_begin_anew():
    f = AttitudeFilter()
    run(f, still(300))
    assert f.calibrated
    f.set_params(AttitudeParams(filter='corrected'))
    assert not f.calibrated
    assert run(f, still(10))


def test_the_diagnostics_tell_a_known_bias_from_an_unknown_one():
    f = AttitudeFilter()
    samples = still(300, bias=(0.05, 0.0, 0.0))
    run(f, samples[:5])
    before = f.diagnostics()
    run(f, samples[5:])
    after = f.diagnostics()
    assert (before['calibrated'], after['calibrated']) == (False, True)
    assert after['bias_x_rad_s'] == pytest.approx(0.05, abs=1e-3)
    assert after['bias_sigma_rad_s'] < 0.1 * before['bias_sigma_rad_s']
    assert after['standing']
    assert not after['frozen']


@pytest.mark.parametrize(('shake', 'learnt'), [(0.05, 0.02), (0.3, 0.0)])
def test_a_slow_steady_turn_of_the_heading_is_a_bias_on_the_ground_alone(shake, learnt):
    f = AttitudeFilter()
    f.start((1.0, 0.0, 0.0, 0.0), bias_sigma=0.02)
    rng = np.random.default_rng(1)
    for s in still(900):
        force = np.array([0.0, 0.0, GRAVITY]) + shake * rng.standard_normal(3)
        f.on_imu(s._replace(rate=(s.rate[0], s.rate[1], s.rate[2] + 0.02), force=tuple(force)))
    assert f.bias[2] == pytest.approx(learnt, abs=1e-3)


def test_a_calibrated_accelerometer_offset_is_taken_from_the_published_force():
    f = AttitudeFilter(AttitudeParams(accelerometer_offset=(0.1, -0.2, 0.3)))
    sample = still(1)[0]
    expected = np.array(sample.force) - (0.1, -0.2, 0.3)
    assert prompt(f.on_imu(sample))[0].force == pytest.approx(tuple(expected))


@pytest.mark.parametrize('name', ['published', 'gyro_driven'])
def test_the_error_of_the_rate_is_what_its_variance_says_while_the_craft_swings(name):
    rng = np.random.default_rng(5)
    f = AttitudeFilter(AttitudeParams(filter=name, gyro_noise=1e-3))
    sigma = 1e-3 / math.sqrt(0.005)
    omega, amplitude = 2.0 * math.pi, 0.1
    nees = []
    for i in range(3000):
        t = i * 0.005
        swing = amplitude if i > 400 else 0.0
        roll, true = swing * math.sin(omega * t), swing * omega * math.cos(omega * t)
        gyro = np.array([true, 0.0, 0.0]) + sigma * rng.standard_normal(3)
        force = GRAVITY * np.array([0.0, math.sin(roll), math.cos(roll)]) + 0.05 * rng.standard_normal(3)
        (out,) = prompt(f.on_imu(ImuSample(START + i * STEP, tuple(gyro), tuple(force))))
        if i > 1000:
            nees.append((out.rate[0] - true) ** 2 / out.rate_variance[0])
    assert 0.7 < np.mean(nees) < 1.3


def turning(rng, seconds, bias=0.01):
    """A craft on a turntable: yaw rate of 0.7 rad/s RMS with a time constant of 2 s. Samples, headings."""
    n = round(seconds / 0.005)
    rate = np.zeros(n)
    decay = math.exp(-0.005 / 2.0)
    for i in range(400, n):
        rate[i] = decay * rate[i - 1] + 0.7 * math.sqrt(1.0 - decay**2) * rng.standard_normal()
    samples = still(n, bias=(bias, bias, bias), seed=int(rng.integers(1 << 30)))
    samples = [s._replace(rate=(s.rate[0], s.rate[1], s.rate[2] + r)) for s, r in zip(samples, rate)]
    return samples, np.cumsum(rate) * 0.005


@pytest.mark.parametrize('name', ['published', 'gyro_driven'])
@pytest.mark.parametrize('gap', [1.2, 3.0, 9.0])
def test_after_a_long_gap_the_heading_is_kept_as_well_as_its_variance_says(name, gap):
    rng = np.random.default_rng(round(gap * 10))
    squares, sigmas = [], []
    for _ in range(12):
        samples, heading = turning(rng, 6.0 + gap)
        f = AttitudeFilter(AttitudeParams(filter=name))
        after = 1000 + round(gap / 0.005)
        (out, *_) = run(f, samples[:1000] + samples[after : after + 100])[1000 + 20 :]
        yaw = euler_from_quat(np.array(out.quaternion))[2]
        squares.append(math.remainder(yaw - heading[after + 20], 2.0 * math.pi) ** 2)
        sigmas.append(math.sqrt(out.attitude_variance[2]))
    assert np.mean(np.array(squares) / np.square(sigmas)) < 1.83  # chi-square 95 %, 12 runs
    assert max(sigmas) < 1.9  # uniform over the circle: more would say nothing more
    assert min(sigmas) > min(gap, 1.8) * 0.9


def test_a_gap_of_a_craft_that_turns_steadily_costs_no_heading():
    samples = still(1300)
    turned = [s._replace(rate=(0.0, 0.0, 1.0)) if i > 400 else s for i, s in enumerate(samples)]
    f = AttitudeFilter()
    out = run(f, turned[:800] + turned[1100:])
    assert euler_from_quat(np.array(out[-1].quaternion))[2] == pytest.approx(
        math.remainder(899 * 0.005, 2.0 * math.pi), abs=0.1
    )
