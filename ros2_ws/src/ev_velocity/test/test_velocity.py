# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ev_velocity import velocity_memory as mem
from ev_velocity.codec import VELOCITY_PORTS
from ev_velocity.fusion import FusionEstimator
from ev_velocity.params import VelocityParams
from ev_velocity.samples import (
    AngleSample,
    ForceSample,
    GearSample,
    GpsSample,
    PedalSample,
    SettledSpeed,
    SlipEstimate,
    SpeedEstimate,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.scenarios import PULSES, SCENARIOS, scenario, simulate
from ev_velocity.velocity import VelocityEstimator
from ev_velocity.velocity_batch import run_drive

START = 10**18
RADIANS = 2.0 * math.pi / PULSES


def events(drive, start=START):
    """Return (stamp, order, handler, sample) of a drive in event order."""

    def ns(t):
        return start + round(float(t) * 1e9)

    sigma = drive.settings.gps_noise
    out = [(ns(t), 0, 'on_force', ForceSample(ns(t), float(f))) for t, f in zip(drive.t, drive.accelerometer)]
    out += [
        (ns(t), 1, 'on_gps', GpsSample(ns(t), float(v), sigma * sigma))
        for t, v in zip(drive.gps_t, drive.gps_v)
    ]
    out += [
        (ns(t), 2, 'on_angle', AngleSample(ns(t), float(c) * RADIANS))
        for t, c in zip(drive.wheel_t, drive.counts)
    ]
    return sorted(out, key=lambda event: event[:2])


def feed(estimator, sequence, kind=SpeedEstimate):
    out = []
    for _, _, handler, sample in sequence:
        out += [e for e in getattr(estimator, handler)(sample) or [] if isinstance(e, kind)]
    return out


def rmse(values):
    return float(np.sqrt(np.mean(np.square(values))))


def errors_of(name, seeds, params=None):
    """Return the root mean square error and the mean normalised error squared over seeds."""
    squares, normalised = [], []
    for seed in seeds:
        drive = scenario(name, seed)
        result = run_drive(params or VelocityParams(), drive)
        error = result.speed - drive.v
        squares.append(np.mean(error**2))
        normalised.append(np.mean(error[500:] ** 2 / result.variance[500:]))
    return float(np.mean(squares) ** 0.5), float(np.mean(normalised))


@pytest.mark.parametrize(
    ('name', 'bar'), [('good_road_10hz', 0.03), ('good_road_1hz', 0.055), ('gps_outage', 0.05)]
)
def test_the_error_is_small_and_what_the_covariance_says(name, bar):
    error, nees = errors_of(name, range(60))
    assert error < bar
    assert 0.8 < nees < 1.2


@pytest.mark.parametrize(('name', 'bar'), [('oil_patch_10hz', 0.10), ('oil_patch_1hz', 0.13)])
def test_wheel_spin_does_not_reach_the_speed(name, bar):
    for seed in range(10):
        drive = scenario(name, seed)
        error = run_drive(VelocityParams(), drive).speed - drive.v
        slip = (drive.t >= drive.spin[0]) & (drive.t <= drive.spin[1] + 0.5)
        assert np.abs(error[slip]).max() < bar


def test_multipath_is_refused_while_the_wheels_vouch():
    error, _ = errors_of('multipath', range(8))
    assert error < 0.06


@pytest.mark.parametrize('delay', [0.0, 0.15, 0.3])
def test_an_unknown_delay_is_found(delay):
    for seed in range(4):
        drive = simulate(replace(SCENARIOS['good_road_10hz'], gps_delay=delay), seed, 30.0)
        found = run_drive(VelocityParams(), drive).states[-1, mem.TG]
        assert found == pytest.approx(delay, abs=0.02)


def test_a_scale_learned_in_one_drive_serves_the_next_without_gps():
    for seed in range(3):
        before = run_drive(VelocityParams(), scenario('good_road_10hz', 100 + seed, car=seed))
        drive = scenario('no_gps', seed, car=seed)
        learned = replace(VelocityParams(), **before.learned())
        assert learned.scale == pytest.approx(1.0 / (1.0 + drive.radius_error) - 1.0, abs=0.003)
        with_scale = rmse(run_drive(learned, drive).speed - drive.v)
        assert with_scale < 0.05
        assert with_scale < 0.6 * rmse(run_drive(VelocityParams(), drive).speed - drive.v)


def test_the_output_never_steps():
    for name in ('good_road_1hz', 'oil_patch_10hz', 'multipath'):
        drive = scenario(name, 0)
        result = run_drive(VelocityParams(), drive)
        assert np.abs(np.diff(result.speed) - drive.a[1:] / 500.0).max() < 0.015


def test_streaming_gives_the_bits_of_the_batch():
    drive = scenario('oil_patch_10hz', 3)
    streamed = feed(VelocityEstimator(), events(drive))
    np.testing.assert_array_equal([e.speed for e in streamed], run_drive(VelocityParams(), drive).speed)


def test_nothing_depends_on_when_the_drive_began():
    sequence = events(scenario('good_road_10hz', 5))[:5000]
    shifted = events(scenario('good_road_10hz', 5), START + 7 * 86_400 * 10**9)[:5000]
    first, second = feed(VelocityEstimator(), sequence), feed(VelocityEstimator(), shifted)
    assert [e.speed for e in first] == [e.speed for e in second]


def test_the_order_of_arrival_within_the_window_changes_no_bit():
    sequence = events(scenario('good_road_10hz', 6))[:6000]
    rng = np.random.default_rng(1)
    delay = {'on_force': 0, 'on_gps': 300_000_000, 'on_angle': 80_000_000}
    late = sorted(sequence, key=lambda e: e[0] + delay[e[2]] + int(rng.integers(0, 100_000_000)))
    assert [e[0] for e in late] != [e[0] for e in sequence]
    params = replace(VelocityParams(), settled_output=True)
    first, second = VelocityEstimator(params), VelocityEstimator(params)
    settled, other = feed(first, sequence, SettledSpeed), feed(second, late, SettledSpeed)
    count = min(len(settled), len(other))
    assert count > 4000
    assert settled[:count] == other[:count]
    np.testing.assert_array_equal(first.state, second.state)


def test_a_gps_that_arrives_late_by_its_stamp_does_no_harm():
    drive = scenario('good_road_10hz_no_delay', 4)
    sequence = sorted(events(drive), key=lambda e: (e[0] + (200_000_000 if e[2] == 'on_gps' else 0), e[1]))
    estimator = VelocityEstimator()
    estimates = feed(estimator, sequence)
    stamps = np.array([e.stamp - START for e in estimates]) * 1e-9
    error = np.array([e.speed for e in estimates]) - np.interp(stamps, drive.t, drive.v)
    assert rmse(error) < 0.04


ANY = st.floats(allow_nan=True, allow_infinity=True)
HANDLERS = st.one_of(
    st.builds(lambda s, v: ('on_force', ForceSample(s, v)), st.integers(-(10**9), 10**10), ANY),
    st.builds(lambda s, v, r: ('on_gps', GpsSample(s, v, r)), st.integers(0, 10**10), ANY, ANY),
    st.builds(lambda s, v: ('on_angle', AngleSample(s, v)), st.integers(0, 10**10), ANY),
    st.builds(
        lambda s, v, r: ('on_wheel_speed', WheelSpeedSample(s, v, r)), st.integers(0, 10**10), ANY, ANY
    ),
    st.builds(lambda s, v: ('on_wheel_rates', WheelRateSample(s, (v,))), st.integers(0, 10**10), ANY),
    st.builds(lambda s, a, b: ('on_pedals', PedalSample(s, a, b)), st.integers(0, 10**10), ANY, ANY),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(HANDLERS, max_size=40))
@example([('on_wheel_speed', WheelSpeedSample(0, 1.0, math.inf))])
@example([('on_wheel_speed', WheelSpeedSample(0, 1.0, 1e308))])
def test_whatever_comes_the_state_stays_finite(sequence):
    estimator = VelocityEstimator()
    for handler, sample in sequence:
        for estimate in getattr(estimator, handler)(sample._replace(stamp=START + sample.stamp)) or []:
            if isinstance(estimate, SpeedEstimate):
                assert math.isfinite(estimate.speed + estimate.variance)
                assert estimate.variance > 0.0
    assert np.all(np.isfinite(estimator.state))


def test_a_gps_that_insists_alone_is_believed_in_the_end():
    params = VelocityParams()
    estimator = VelocityEstimator(params)
    seen = []
    for i in range(1, 500 * 40):
        stamp = START + i * 2_000_000
        if i % 50 == 0:
            # 10 m/s, and from 10 s on a true speed that the accelerometer did not see come.
            estimator.on_gps(GpsSample(stamp, 10.0 if i < 5000 else 14.0, 0.05**2))
        seen.append(estimator.on_force(ForceSample(stamp, 0.0))[0].speed)
    assert seen[5000 + 500 * 3] == pytest.approx(10.0, abs=0.2)
    assert seen[-1] == pytest.approx(14.0, abs=0.1)
    assert estimator.tally.sensors['gps/speed'].rejected['gate'] > 50


def test_a_wheel_of_another_size_is_learned_after_the_lock_out():
    drive = simulate(replace(SCENARIOS['good_road_10hz'], radius_error=0.08), 1)
    result = run_drive(VelocityParams(), drive)
    scale = 1.0 / (1.0 + drive.radius_error) - 1.0
    assert result.states[45 * 500, mem.S] == pytest.approx(scale, abs=0.01)
    assert rmse((result.speed - drive.v)[30 * 500 : 47 * 500]) < 0.06


def test_a_silent_accelerometer_coasts_and_says_so():
    drive = scenario('good_road_10hz', 2)
    estimator = VelocityEstimator()
    feed(estimator, [e for e in events(drive) if e[0] <= START + 10 * 10**9])
    rest = [e for e in events(drive) if START + 10 * 10**9 < e[0] < START + 14 * 10**9 and e[2] != 'on_force']
    estimates = feed(estimator, rest)
    assert len(estimates) > 60
    truth = np.interp([(e.stamp - START) * 1e-9 for e in estimates], drive.t, drive.v)
    error = np.array([e.speed for e in estimates]) - truth
    assert np.abs(error).max() < 0.3
    assert min(e.variance for e in estimates[10:]) > 5e-4


def test_slip_is_named_while_it_lasts():
    drive = scenario('oil_patch_10hz', 2)
    slips = [e for e in feed(VelocityEstimator(), events(drive), SlipEstimate) if e.slipping]
    times = np.array([(e.stamp - START) * 1e-9 for e in slips])
    assert len(slips) >= 3
    assert np.all((times > drive.spin[0]) & (times < drive.spin[1] + 0.2))
    assert max(e.slip for e in slips) > 0.2


def test_reverse_gear_turns_the_sign():
    estimator = VelocityEstimator()
    estimator.on_gear(GearSample(START, -1))
    speed, angle = 0.0, 0.0
    for i in range(1, 500 * 8):
        stamp = START + i * 2_000_000
        a = -1.0 if 500 < i < 1500 else 0.0
        speed += a * 0.002
        angle += abs(speed) * 0.002 / 0.285
        if i % 50 == 0:
            estimator.on_angle(AngleSample(stamp, math.floor(angle / RADIANS) * RADIANS))
            estimator.on_gps(GpsSample(stamp, abs(speed), 0.05**2))
        last = estimator.on_force(ForceSample(stamp, a))[0]
    assert last.speed == pytest.approx(speed, abs=0.1)
    assert estimator.tally.sensors['wheel/encoder'].rejected.total() == 0


def test_a_wheel_that_is_locked_by_the_brake_is_refused():
    drive = scenario('oil_patch_10hz', 4)
    counts = drive.counts.copy()
    locked = (drive.wheel_t > 25.0) & (drive.wheel_t < 26.0)
    counts[locked] = counts[locked][0]
    after = drive.wheel_t >= 26.0
    counts[after] -= counts[after][0] - counts[locked][0] - 16.0
    drive = replace(drive, counts=counts)
    error = run_drive(VelocityParams(), drive).speed - drive.v
    assert np.abs(error[(drive.t > 25.0) & (drive.t < 27.0)]).max() < 0.15


def test_a_reset_forgets_everything():
    estimator = VelocityEstimator()
    fresh = estimator.state.copy()
    feed(estimator, events(scenario('good_road_10hz', 1))[:2000])
    estimator.reset()
    np.testing.assert_array_equal(estimator.state, fresh)


def test_live_parameters_take_effect_without_a_restart():
    estimator = VelocityEstimator()
    sequence = events(scenario('good_road_10hz', 1))[:4000]
    feed(estimator, sequence[:3000])
    speed = estimator.state[mem.X + mem.V]
    estimator.set_params(replace(estimator.params, gate=1.0))
    assert estimator.state[mem.X + mem.V] == speed
    feed(estimator, sequence[3000:])
    assert estimator.tally.sensors['gps/speed'].rejected['gate'] > 0


def test_single_outliers_while_standing_do_not_add_up_to_a_lock_out():
    estimator = VelocityEstimator()
    for i in range(1, 500 * 60):
        stamp = START + i * 2_000_000
        if i % 50 == 0:
            estimator.on_angle(AngleSample(stamp, 0.0))
            estimator.on_gps(GpsSample(stamp, 0.4 if i % 10_000 == 0 else 0.03, 0.05**2))
        estimator.on_force(ForceSample(stamp, 0.02))
    assert estimator.tally.sensors['gps/speed'].rejected['gate'] == 2
    assert not estimator.tally.restarts
    assert estimator.learned()['scale_sigma'] == pytest.approx(estimator.params.scale_sigma, rel=0.01)


def test_every_sample_is_counted_under_its_topic():
    ports = VELOCITY_PORTS
    samples = {
        'imu/data_raw': ForceSample(START, 0.1), 'gps/speed': GpsSample(START, 9.0),
        'wheel/encoder': AngleSample(START, 1.0), 'wheel/states': WheelRateSample(START, (30.0, 31.0)),
        'vehicle/speed': WheelSpeedSample(START, 8.9), 'obd/speed': WheelSpeedSample(START, 8.8),
        'vehicle/pedals': PedalSample(START, 0.2, 0.0), 'vehicle/gear': GearSample(START, 1),
    }  # fmt: skip
    assert {port.topic for port in ports.inputs} == set(samples)
    for kind in (VelocityEstimator, FusionEstimator):
        estimator = kind()
        for i, port in enumerate(ports.inputs):
            getattr(estimator, port.handler)(samples[port.topic]._replace(stamp=START + i))
        assert {name: entry.accepted for name, entry in estimator.tally.sensors.items()} == dict.fromkeys(
            samples, 1
        )
