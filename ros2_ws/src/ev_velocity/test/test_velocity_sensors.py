# SPDX-License-Identifier: Apache-2.0
"""What sensors of real cars do: count down, stand in neutral, come late, fall silent."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ev_velocity import velocity_batch
from ev_velocity import velocity_memory as mem
from ev_velocity.fusion import FusionEstimator
from ev_velocity.params import VelocityParams
from ev_velocity.samples import (
    AngleSample,
    ForceSample,
    GearSample,
    GpsSample,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.scenarios import GRAVITY, PULSES, SCENARIOS, WHEEL_RADIUS, simulate
from ev_velocity.velocity import VelocityEstimator

START = 10**18
RADIANS = 2.0 * math.pi / PULSES
RATE = 100  # Hz


def stamp_of(t):
    return START + round(t * 1e9)


def rmse(error):
    return float(np.sqrt(np.mean(np.square(error))))


def speed_of(result):
    return (result[0] if isinstance(result, list) else result).speed


def slow(drive, rate=RATE):
    """Return stamps (s) and readings of an accelerometer of `rate`: means over its intervals."""
    every = round(500 / rate)
    count = (drive.t.size - 1) // every
    return drive.t[every::every][:count], drive.accelerometer[1 : 1 + count * every].reshape(count, -1).mean(
        1
    )


def backwards_up_a_ramp(kind, sense):
    """Return the errors (m/s) of a drive in reverse without GPS whose encoder counts up or down."""
    rng = np.random.default_rng(1)
    estimator = kind()
    estimator.on_gear(GearSample(START, -1))
    x = v = 0.0
    errors = []
    for k in range(1, 25 * RATE):
        t = k / RATE
        a = -1.0 if 5.0 <= t < 6.5 else 0.0
        x, v = x + v / RATE, v + a / RATE
        ramp = 0.05 * GRAVITY * min(max((-x - 5.0) / 3.0, 0.0), 1.0)
        force = a + 0.1 - ramp + 0.07 * rng.standard_normal()
        errors.append(speed_of(estimator.on_force(ForceSample(stamp_of(t), force))) - v)
        if k % 10 == 0:
            teeth = math.floor(-x / WHEEL_RADIUS / RADIANS)
            estimator.on_angle(AngleSample(stamp_of(t) + 1, sense * teeth * RADIANS))
    return errors[8 * RATE :]


@pytest.mark.parametrize(('kind', 'bar'), [(VelocityEstimator, 0.06), (FusionEstimator, 2.5)])
def test_an_encoder_that_counts_down_in_reverse_is_as_good_as_one_that_counts_up(kind, bar):
    up, down = backwards_up_a_ramp(kind, 1), backwards_up_a_ramp(kind, -1)
    np.testing.assert_array_equal(down, up)
    assert rmse(down) < bar


def test_an_encoder_may_turn_round_and_begin_anew():
    """Out, back and out again by the gears, without GPS; the counter is set to 0 in between."""
    estimator = VelocityEstimator()
    rng = np.random.default_rng(2)
    legs = ((2, 5, 1.0), (10, 13, -1.0), (16, 18, -1.0), (22, 24, 1.0), (27, 29, 2.0))
    x = v = 0.0
    errors = []
    for k in range(1, 40 * RATE):
        t = k / RATE
        a = sum(a for start, end, a in legs if start <= t < end)
        x, v = x + v / RATE, v + a / RATE
        if t in (15.0, 26.0):
            estimator.on_gear(GearSample(stamp_of(t) - 1, -1 if t == 15.0 else 1))
        force = a + 0.1 + 0.07 * rng.standard_normal()
        errors.append(speed_of(estimator.on_force(ForceSample(stamp_of(t), force))) - v)
        if k % 10 == 0:
            teeth = math.floor(x / WHEEL_RADIUS / RADIANS) - (400 if t > 20.0 else 0)
            estimator.on_angle(AngleSample(stamp_of(t) + 1, teeth * RADIANS))
    assert estimator.tally.sensors['wheel/encoder'].rejected.total() <= 1
    assert rmse(errors[5 * RATE :]) < 0.06


@pytest.mark.parametrize('mounted', [1, -1])
def test_a_car_that_rolls_back_at_a_hill_start_goes_backwards(mounted):
    """Out, a stop, back by 1 m in a forward gear, and on; the counts follow the wheel, no GPS."""
    estimator = VelocityEstimator()
    rng = np.random.default_rng(3)
    legs = ((2, 6, 1.0), (10, 14, -1.0), (20, 21, -0.8), (21.5, 22.5, 0.8), (23, 26, 1.0))
    x = v = 0.0
    errors = []
    for k in range(1, 32 * RATE):
        t = k / RATE
        a = sum(a for start, end, a in legs if start <= t < end)
        x, v = x + v / RATE, v + a / RATE
        force = a + 0.1 + 0.07 * rng.standard_normal()
        errors.append(speed_of(estimator.on_force(ForceSample(stamp_of(t), force))) - v)
        if k % 10 == 0:
            teeth = mounted * math.floor(x / WHEEL_RADIUS / RADIANS)
            estimator.on_angle(AngleSample(stamp_of(t) + 1, teeth * RADIANS))
    assert np.abs(errors[6 * RATE :]).max() < 0.15


def test_counts_that_go_on_the_other_way_are_believed_in_the_end():
    """The first tooth went the other way: a gear that was selected late."""
    estimator = VelocityEstimator()
    for k in range(1, 20 * RATE):
        t = k / RATE
        speed = speed_of(estimator.on_force(ForceSample(stamp_of(t), 5.1 if 1.0 <= t < 2.0 else 0.1)))
        if k % 10 == 0:
            teeth = math.floor(
                (2.5 * min(max(t - 1.0, 0.0), 1.0) ** 2 + 5.0 * max(t - 2.0, 0.0)) / WHEEL_RADIUS / RADIANS
            ) - (k >= 50)
            estimator.on_angle(AngleSample(stamp_of(t), teeth * RADIANS))
    assert speed == pytest.approx(5.0, abs=0.3)
    assert estimator.tally.sensors['wheel/encoder'].nis is not None


@pytest.mark.parametrize('kind', [VelocityEstimator, FusionEstimator])
def test_in_neutral_the_car_goes_on_in_the_sense_it_had(kind):
    estimator = kind()
    estimator.on_gear(GearSample(START, -1))
    v = 0.0
    for k in range(1, 20 * RATE):
        a = -1.0 if 2 * RATE <= k < 5 * RATE else 0.0
        v += a / RATE
        if k == 10 * RATE:
            estimator.on_gear(GearSample(stamp_of(k / RATE) - 1, 0))
        speed = speed_of(estimator.on_force(ForceSample(stamp_of(k / RATE), a)))
        if k % 10 == 5:
            estimator.on_gps(GpsSample(stamp_of(k / RATE) + 1, abs(v), 0.0025))
            estimator.on_wheel_speed(WheelSpeedSample(stamp_of(k / RATE) + 2, abs(v), 0.0025))
    assert speed == pytest.approx(-3.0, abs=0.1)


def test_in_neutral_the_batch_keeps_the_sense_too():
    t = np.arange(1, 10 * RATE) / RATE
    v = np.maximum(-3.0, -t)
    result = velocity_batch.run(
        VelocityParams(), (t, np.where(t < 3.0, -1.0, 0.0)), gps=(t[5::10], np.abs(v[5::10])),
        gear=(np.array([0.0, 5.0]), np.array([-1.0, 0.0])),
    )  # fmt: skip
    assert result.speed[-1] == pytest.approx(-3.0, abs=0.1)


@pytest.mark.parametrize('rate', [100.0, 50.0])
@pytest.mark.parametrize('share', [0.0, 0.5, 0.9, 0.99])
def test_the_output_is_as_good_as_the_filter_whenever_the_wheels_speak(rate, share):
    """`share`: where between two accelerometer readings a wheel speed is stamped."""
    outputs, states = [], []
    for seed in range(2):
        drive = simulate(SCENARIOS['good_road_10hz'], seed, 30.0)
        t, force = slow(drive, rate)
        at = t[:-1] + share / rate
        noise = 0.05 * np.random.default_rng(seed + 99).standard_normal(at.size)
        wheel = np.abs(np.interp(at - 0.05, drive.t, drive.wheel_speed) + noise)
        result = velocity_batch.run(
            VelocityParams(), (t, force), (drive.gps_t, drive.gps_v), wheel_speed=(at, wheel), gps_sigma=0.05,
            wheel_speed_sigma=0.05,
        )  # fmt: skip
        truth = np.interp(t, drive.t, drive.v)
        outputs.append((result.speed - truth)[t > 2.0])
        states.append((result.states[:, mem.V] - truth)[t > 2.0])
    assert rmse(outputs) <= 1.05 * rmse(states)


@pytest.mark.parametrize(('silence', 'sigma'), [(1.0, 1.3), (3.0, 2.5), (9.0, 4.4)])
def test_one_reading_after_a_silence_says_nothing_of_the_silence(silence, sigma):
    estimator = VelocityEstimator()
    for k in range(1, 10 * RATE):
        estimator.on_force(ForceSample(stamp_of(k / RATE), 0.0))
        if k % 10 == 5:
            estimator.on_gps(GpsSample(stamp_of(k / RATE) + 1, 20.0, 0.0025))
    speed = estimator.on_force(ForceSample(stamp_of(10.0 + silence), 6.0))[0]
    assert speed.speed == pytest.approx(20.0, abs=0.1)
    assert math.sqrt(speed.variance) == pytest.approx(sigma, abs=0.1)


def test_a_first_reading_says_nothing_of_the_time_before_it():
    estimator = VelocityEstimator()
    for k in range(1, 11):
        estimator.on_gps(GpsSample(stamp_of(k), 20.0, 0.0025))
    assert estimator.on_force(ForceSample(stamp_of(10.9), 6.0))[0].speed == pytest.approx(20.0, abs=0.3)


def test_a_sample_that_was_not_compared_has_no_nis():
    """A standing car: GPS below its noise and zeros of the speed signal say nothing to the filter."""
    estimator = VelocityEstimator()
    estimator.on_angle(AngleSample(START, 5.0))
    assert estimator.tally.sensors['wheel/encoder'].nis is None
    for k in range(1, 3 * RATE):
        t = k / RATE
        estimator.on_force(ForceSample(stamp_of(t), 0.0))
        if k % 10 == 0:
            estimator.on_angle(AngleSample(stamp_of(t), 5.0))
        if k % 10 == 5 and t > 2.0:
            estimator.on_gps(GpsSample(stamp_of(t), 0.03, 0.0025))
    sensors = estimator.tally.sensors
    assert sensors['wheel/encoder'].nis is not None
    assert sensors['gps/speed'].accepted == 10
    assert sensors['gps/speed'].nis is None


def drive_with(seed, obd=None, gps=True):
    """Return the RMSE (m/s) after 3 s and the estimator; `obd`: delay (s) of a speedometer in km/h steps."""
    drive = simulate(SCENARIOS['good_road_10hz'], seed)
    t, force = slow(drive)
    events = [(at, 0, ForceSample(stamp_of(at), float(f))) for at, f in zip(t, force)]
    if gps:
        events += [
            (at, 1, GpsSample(stamp_of(at), float(v), 0.0025)) for at, v in zip(drive.gps_t, drive.gps_v)
        ]
    events += [
        (at, 2, AngleSample(stamp_of(at), float(c) * RADIANS)) for at, c in zip(drive.wheel_t, drive.counts)
    ]
    if obd is not None:
        for at in np.arange(0.3, 60.0, 0.1):
            kmh = round(3.6 * float(np.interp(at - obd, drive.t, drive.wheel_speed)))
            events.append((at, 3, WheelSpeedSample(stamp_of(at), kmh / 3.6)))
    estimator = VelocityEstimator()
    handlers = (estimator.on_force, estimator.on_gps, estimator.on_angle, estimator.on_obd_speed)
    errors = []
    for at, kind, sample in sorted(events):
        out = handlers[kind](sample)
        if kind == 0 and at > 3.0:
            errors.append(out[0].speed - float(np.interp(at, drive.t, drive.v)))
    return rmse(errors), estimator


@pytest.mark.parametrize('gps', [True, False])
def test_a_late_speedometer_beside_an_encoder_does_no_harm(gps):
    for seed in (0, 3):
        alone, _ = drive_with(seed, gps=gps)
        both, estimator = drive_with(seed, obd=0.3, gps=gps)
        assert both < 1.1 * alone
        assert estimator.tally.sensors['wheel/encoder'].rejected.total() < 5
        learned = estimator.diagnostics()
        assert learned['wheel_delay'] == pytest.approx(0.0, abs=0.01)
        assert learned['speed_delay'] == pytest.approx(0.3, abs=0.05)


def test_a_speedometer_of_another_scale_is_learned_after_the_lock_out():
    """Wheels 12 % off beside a GPS: refused for the lock-out, then scale and delay are learned."""
    estimator = VelocityEstimator()
    for k in range(1, 45 * RATE):
        t = k / RATE
        speed = 15.0 + 3.0 * math.sin(0.5 * t)
        estimator.on_force(ForceSample(stamp_of(t), 1.5 * math.cos(0.5 * t)))
        if k % 10 == 0:
            estimator.on_gps(GpsSample(stamp_of(t), speed, 0.0025))
            if t > 5.0:
                estimator.on_wheel_rates(WheelRateSample(stamp_of(t), (1.12 * speed / WHEEL_RADIUS,) * 4))
    assert estimator.tally.sensors['wheel/states'].rejected['gate (slip)'] > 50
    assert any('scale learned anew' in text for text in estimator.tally.restarts)
    assert estimator.learned()['scale'] == pytest.approx(0.12, abs=0.02)


def test_without_gps_wheels_that_insist_move_the_speed():
    estimator = VelocityEstimator(replace(VelocityParams(), lockout_time=5.0))
    for k in range(1, 20 * RATE):
        t = k / RATE
        speed = speed_of(estimator.on_force(ForceSample(stamp_of(t), 0.0)))
        if k % 10 == 0:
            # A jump that no accelerometer saw.
            estimator.on_wheel_speed(WheelSpeedSample(stamp_of(t), 10.0 if t < 8.0 else 14.0, 0.0025))
        if t == 9.0:
            assert speed == pytest.approx(10.0, abs=0.3)
    assert speed == pytest.approx(14.0, abs=0.3)
    assert any('scale learned anew' in text for text in estimator.tally.restarts)


@pytest.mark.parametrize(
    ('handler', 'sample'),
    [
        ('on_force', ForceSample(START, 60.0)),
        ('on_gps', GpsSample(START, -1.0)),
        ('on_gps', GpsSample(START, 1.0, math.inf)),
        ('on_angle', AngleSample(START, math.inf)),
        ('on_wheel_speed', WheelSpeedSample(START, 200.0)),
        ('on_wheel_rates', WheelRateSample(START, ())),
    ],
)
def test_what_no_car_does_is_refused(handler, sample):
    estimator = VelocityEstimator()
    before = estimator.state.copy()
    assert getattr(estimator, handler)(sample) is None
    np.testing.assert_array_equal(estimator.state, before)
    assert sum(entry.rejected.total() for entry in estimator.tally.sensors.values()) == 1
