# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from ev_velocity import fusion_batch
from ev_velocity import fusion_kernels as fk
from ev_velocity.fusion import FusionEstimator
from ev_velocity.params import FusionParams
from ev_velocity.samples import (
    AngleSample,
    ForceSample,
    FusionEstimate,
    GearSample,
    GpsSample,
    PedalSample,
    SettledFusion,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.scenarios import PULSES, scenario

START = 10**18


@settings(max_examples=50, deadline=None)
@given(*(st.floats(0.01, 10.0) for _ in range(3)))
def test_the_weights_are_inverse_variances_and_sum_to_one(s1, s2, s3):
    inverse = np.array([s1, s2, s3]) ** -2.0
    np.testing.assert_allclose(fk.weights(s1, s2, s3), inverse / inverse.sum(), rtol=1e-9)


def multirate(steps, corrected, q=0.0, r=0.04, dt=0.002):
    """One start sample, then one of 1.3 m/s at `steps` fast steps later, used over as many."""
    m = np.zeros(fk.SIZE)
    fk.multirate_sample(m, fk.GPS, 1.0, r, 0.0, dt)
    for _ in range(steps):
        fk.multirate_step(m, fk.GPS, dt, q, r, corrected)
    fk.multirate_sample(m, fk.GPS, 1.3, r, steps * dt * 1e9, dt)
    for _ in range(steps):
        fk.multirate_step(m, fk.GPS, dt, q, r, corrected)
    return m[fk.GPS : fk.GPS + fk.M_SIZE]


def reference(steps, r=0.04, dt=0.002):
    """The same two samples once each, in filterpy, carried to the same end."""
    f = KalmanFilter(dim_x=2, dim_z=1)
    f.x = np.array([[1.0], [0.0]])
    f.P = np.diag([r, fk.START_ACCEL_VARIANCE])
    f.F = np.array([[1.0, steps * dt], [0.0, 1.0]])
    f.H = np.array([[1.0, 0.0]])
    f.R = np.array([[r]])
    f.Q = np.zeros((2, 2))
    f.predict()
    f.update(1.3)
    f.predict()
    return f


@pytest.mark.parametrize('steps', [1, 10, 50, 500])
def test_a_sample_used_n_times_with_n_times_the_noise_counts_once(steps):
    f, one = multirate(steps, corrected=True), reference(steps)
    assert f[fk.M_SPEED] == pytest.approx(one.x[0, 0], rel=1e-9)
    assert f[fk.M_ACCEL] == pytest.approx(one.x[1, 0], rel=1e-9)
    assert f[fk.M_P00] == pytest.approx(one.P[0, 0], rel=1e-9)


def test_as_printed_a_sample_counts_n_times_and_the_filter_is_overconfident():
    steps = 50
    printed, one = multirate(steps, corrected=False), reference(steps)
    assert printed[fk.M_P00] < one.P[0, 0] / 3.0


def events(drive):
    """Return (stamp, handler, sample) of a drive in event order."""

    def ns(t):
        return START + round(float(t) * 1e9)

    out = [(ns(t), 0, 'on_force', ForceSample(ns(t), float(f))) for t, f in zip(drive.t, drive.accelerometer)]
    out += [(ns(t), 1, 'on_gps', GpsSample(ns(t), float(v))) for t, v in zip(drive.gps_t, drive.gps_v)]
    radians = 2.0 * math.pi / PULSES
    out += [
        (ns(t), 2, 'on_angle', AngleSample(ns(t), float(c) * radians))
        for t, c in zip(drive.wheel_t, drive.counts)
    ]
    out += [
        (ns(t), 4, 'on_pedals', PedalSample(ns(t), float(a), float(b)))
        for t, a, b in zip(drive.t[::10], drive.accelerator[::10], drive.brake[::10])
    ]
    return sorted(out, key=lambda event: event[:2])


def feed(estimator, sequence):
    speeds = []
    for _, _, handler, sample in sequence:
        result = getattr(estimator, handler)(sample)
        for estimate in result if isinstance(result, list) else [result]:
            if isinstance(estimate, FusionEstimate):
                speeds.append(estimate.speed)
    return np.array(speeds)


@pytest.mark.parametrize('variant', ['published', 'corrected'])
def test_streaming_gives_what_the_batch_gives(variant):
    drive = scenario('good_road_10hz', 1)
    params = FusionParams(variant=variant)
    streamed = feed(FusionEstimator(params), events(drive)[:16_000])
    batch = fusion_batch.run_drive(params, drive)[0][: streamed.size]
    np.testing.assert_allclose(streamed, batch, atol=1e-9)


@pytest.mark.parametrize('variant', ['published', 'corrected'])
def test_the_fused_speed_follows_the_car_and_not_the_oil(variant):
    params = FusionParams(variant=variant)
    errors, slips = [], []
    for seed in range(4):
        drive = scenario('oil_patch_10hz', seed)
        error = fusion_batch.run_drive(params, drive)[0] - drive.v
        errors.append(np.mean(error**2))
        slips.append(np.abs(error[(drive.t > drive.spin[0]) & (drive.t < drive.spin[1])]).max())
    assert np.mean(errors) ** 0.5 < 0.2
    assert max(slips) < 0.5


@pytest.mark.parametrize(
    ('name', 'low', 'high'),
    [('good_road_10hz', 0.05, 1.0), ('good_road_1hz', 0.3, 2.0), ('no_gps', 0.05, 1.0)],
)
def test_the_corrected_variance_bounds_the_error(name, low, high):
    found = []
    for seed in range(8):
        drive = scenario(name, seed)
        speed, variance = fusion_batch.run_drive(FusionParams(), drive)
        found.append(np.mean((speed - drive.v)[500:] ** 2 / variance[500:]))
    assert low < np.mean(found) < high


@pytest.mark.parametrize('variant', ['published', 'corrected'])
def test_before_a_speed_was_seen_the_variance_says_so(variant):
    estimator = FusionEstimator(FusionParams(variant=variant))
    for i in range(1, 500):
        last = estimator.on_force(ForceSample(START + i * 2_000_000, 0.1))
        assert last.variance > 100.0
    for i in range(500, 5000):
        if i % 50 == 0:
            estimator.on_gps(GpsSample(START + i * 2_000_000, 20.0))
        last = estimator.on_force(ForceSample(START + i * 2_000_000, 0.0))
    assert last.speed == pytest.approx(20.0, abs=0.1)
    assert last.variance < 0.1


def test_without_gps_the_wheel_alone_holds_the_integral():
    drive = scenario('no_gps', 0)
    speed, _ = fusion_batch.run_drive(FusionParams(wheel_scale=-drive.radius_error), drive)
    assert np.abs(speed - drive.v).max() < 1.5


def test_settled_estimates_do_not_depend_on_the_order_of_arrival():
    drive = scenario('good_road_10hz', 2)
    sequence = events(drive)[:3000]
    params = replace(FusionParams(), settled_output=True)
    late = sorted(sequence, key=lambda e: (e[0] + (120_000_000 if e[2] == 'on_gps' else 0), e[1]))

    def settled(order):
        estimator = FusionEstimator(params)
        out = []
        for _, _, handler, sample in order:
            result = getattr(estimator, handler)(sample)
            out += [e for e in result or [] if isinstance(e, SettledFusion)]
        return out, estimator.state

    first, second = settled(sequence), settled(late)
    assert len(first[0]) > 2000
    assert first[0] == second[0][: len(first[0])]
    np.testing.assert_array_equal(first[1], second[1])


def test_junk_is_refused_and_leaves_no_trace():
    estimator = FusionEstimator()
    for stamp in range(1, 200):
        estimator.on_force(ForceSample(START + stamp * 2_000_000, 0.1))
    before = estimator.state.copy()
    nan = math.nan
    estimator.on_force(ForceSample(START + 10**9, nan))
    estimator.on_gps(GpsSample(START + 10**9, math.inf))
    estimator.on_angle(AngleSample(START + 10**9, nan))
    estimator.on_wheel_speed(WheelSpeedSample(START + 10**9, nan))
    estimator.on_pedals(PedalSample(START + 10**9, 2.0, 0.0))
    np.testing.assert_array_equal(estimator.state, before)
    assert sum(sum(s.rejected.values()) for s in estimator.tally.sensors.values()) == 5


def test_wheel_rates_and_the_speedometer_are_wheel_speeds():
    speeds = []
    for handler, sample in (
        ('on_wheel_speed', WheelSpeedSample(0, 6.0)),
        ('on_obd_speed', WheelSpeedSample(0, -6.0)),
        ('on_wheel_rates', WheelRateSample(0, (0.0, 20.0, 20.0))),
    ):
        estimator = FusionEstimator(FusionParams(wheel_radius=0.3))
        for i in range(1, 2000):
            stamp = START + i * 2_000_000
            if i % 50 == 0:
                getattr(estimator, handler)(sample._replace(stamp=stamp))
            last = estimator.on_force(ForceSample(stamp, 0.0))
        speeds.append(last.speed)
    assert speeds[0] == speeds[1]
    assert speeds[2] == pytest.approx(speeds[0], abs=1e-9)
    assert estimator.on_wheel_rates(WheelRateSample(START + 10**11, ())) is None
    assert estimator.tally.sensors['wheel/states'].rejected.total() == 1


def test_live_parameters_take_effect_and_a_reset_forgets_everything():
    estimator = FusionEstimator()
    fresh = estimator.state.copy()
    for i in range(1, 1000):
        stamp = START + i * 2_000_000
        if i % 50 == 0:
            estimator.on_gps(GpsSample(stamp, 10.0))
            estimator.on_wheel_speed(WheelSpeedSample(stamp, 12.0))
        speed = estimator.on_force(ForceSample(stamp, 0.0)).speed
    assert speed < 10.5
    estimator.set_params(replace(FusionParams(), sigma_gps=(5.0,) * 4, sigma_wheel=(0.1,) * 4))
    for i in range(1000, 2000):
        stamp = START + i * 2_000_000
        if i % 50 == 0:
            estimator.on_gps(GpsSample(stamp, 10.0))
            estimator.on_wheel_speed(WheelSpeedSample(stamp, 12.0))
        speed = estimator.on_force(ForceSample(stamp, 0.0)).speed
    assert speed > 11.5
    estimator.reset()
    np.testing.assert_array_equal(estimator.state, fresh)


def test_an_output_is_not_lost_when_another_sensor_ran_ahead():
    estimator = FusionEstimator()
    estimator.on_force(ForceSample(START, 0.0))
    estimator.on_gps(GpsSample(START + 5_000_000, 5.0))
    late = estimator.on_force(ForceSample(START + 2_000_000, 0.0))
    assert late.stamp == START + 2_000_000


def test_in_reverse_the_unsigned_sensors_take_the_sign_of_the_gear():
    estimator = FusionEstimator()
    estimator.on_gear(GearSample(START, -1))
    for i in range(1, 2000):
        stamp = START + i * 2_000_000
        if i % 50 == 0:
            estimator.on_wheel_speed(WheelSpeedSample(stamp, 2.0))
            estimator.on_gps(GpsSample(stamp, 2.0))
        last = estimator.on_force(ForceSample(stamp, 0.0))
    assert last.speed == pytest.approx(-2.0, abs=0.05)


def test_the_batch_runs_without_pedals():
    drive = scenario('good_road_10hz', 1)
    wheel = (drive.t[::50], drive.wheel_speed[::50])
    speed, variance = fusion_batch.run(
        FusionParams(), (drive.t, drive.accelerometer), (drive.gps_t, drive.gps_v), wheel
    )
    assert np.sqrt(np.mean((speed - drive.v) ** 2)) < 1.0
    assert (variance > 0.0).all()
