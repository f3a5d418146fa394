# SPDX-License-Identifier: Apache-2.0
"""The driver: readings, stamps, pacing, parameters."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpu6050_rig import DEG, FORCE, RATE, SECOND, Rig, constant, mean_of, stamps_of, still

from imu_kalman import mpu6050_registers as reg
from imu_kalman.mpu6050_params import Mpu6050Params
from kalman_core.parameters import ParameterError, build


@pytest.mark.parametrize('pacing', ['fifo', 'data_ready'])
@pytest.mark.parametrize(
    'values',
    [
        {},
        {'gyro_range': 250, 'accel_range': 2, 'rate': 100.0, 'bandwidth': 42},
        {'gyro_range': 2000, 'accel_range': 16, 'rate': 50.0, 'bandwidth': 256},
        {'address': 0x68, 'rate': 333.0, 'bandwidth': 188},
    ],
)
def test_readings_are_the_motion_in_si_units(pacing, values):
    rig = Rig(pacing=pacing, calibrate_at_start=False, **values)
    readings = rig.run(3.0)
    n = len(readings)
    assert n == pytest.approx(2.8 * rig.params.sample_rate, rel=0.05)
    np.testing.assert_allclose(mean_of(readings, 'gyro'), RATE, atol=2e-3)
    np.testing.assert_allclose(mean_of(readings, 'accel'), FORCE, atol=0.02)
    assert readings[-1].temperature == pytest.approx(27.0, abs=0.01)
    variances = rig.driver.variances
    accel = np.var([r.accel for r in readings], axis=0).mean()
    assert accel == pytest.approx(variances.accel, rel=0.25)


def test_the_variance_of_the_gyro_is_noise_once_the_bias_is_known():
    rig = Rig(still, chip={'gyro_bias': (0.02, -0.03, 0.05)})
    before = rig.driver.variances.gyro
    readings = rig.run(10.0)[1000:]
    after = rig.driver.variances.gyro
    assert before > (10.0 * DEG) ** 2 > after
    assert np.var([r.gyro for r in readings], axis=0).mean() == pytest.approx(after, rel=0.1)


def test_mounting_turns_chip_axes_into_body_axes():
    rig = Rig(mounting=(math.pi, 0.0, math.pi / 2), calibrate_at_start=False)
    readings = rig.run(1.0)
    # Upside down about x, then x forward turned to the left: (x, y, z) -> (y, x, -z).
    np.testing.assert_allclose(mean_of(readings, 'accel'), [FORCE[1], FORCE[0], -FORCE[2]], atol=0.02)


@pytest.mark.parametrize('clock_error', [-0.02, 0.0, 0.013])
@pytest.mark.parametrize('pacing', ['fifo', 'data_ready'])
def test_stamps_are_when_the_sample_was_taken(clock_error, pacing):
    jitter = 0.3 if pacing == 'fifo' else 0.0
    rig = Rig(chip={'clock_error': clock_error}, pacing=pacing, calibrate_at_start=False)
    readings = rig.run(20.0, jitter=jitter)
    stamps = stamps_of(readings)
    assert (np.diff(stamps) > 0).all()
    truth = np.array(rig.chip.sample_times[-400:]) - round(reg.GYRO_DELAYS[2] * SECOND)
    nearest = np.abs(stamps[-300:, None] - truth).min(axis=1)
    period = rig.chip.period
    assert nearest.max() < 0.12 * period
    assert np.diff(stamps[-300:]).std() < 0.03 * period
    assert rig.driver.diagnostics()['sample_period_s'] * 1e9 == pytest.approx(period, rel=2e-3)


def test_nothing_is_lost_in_the_fifo_when_polls_come_late():
    rig = Rig(calibrate_at_start=False)
    rig.run(1.0)
    taken, made = rig.driver.readings, rig.chip.samples
    rig.run(20.0, jitter=3.0)
    rig.driver.poll()
    assert rig.driver.readings - taken == pytest.approx(rig.chip.samples - made, abs=2)
    assert rig.driver.overflows == 0


def test_an_overflow_is_counted_and_what_follows_is_aligned():
    rig = Rig(calibrate_at_start=False)
    rig.run(1.0)
    rig.clock.advance(1.3 * SECOND)
    readings = rig.run(1.0)
    assert rig.driver.overflows == 1
    assert len(readings) > 190
    assert np.abs(np.array([r.gyro for r in readings]) - RATE).max() < 0.02
    assert np.abs(np.array([r.accel for r in readings]) - FORCE).max() < 0.5


def test_saturation_is_counted():
    rig = Rig(constant(rate=(6.0, 0.0, 0.0)), gyro_range=250, calibrate_at_start=False)
    rig.run(1.0)
    assert rig.driver.diagnostics()['saturated'] > 100


@pytest.mark.parametrize(
    ('values', 'named'),
    [
        ({'bandwidth': 100}, 'bandwidth'),
        ({'gyro_range': 300}, 'gyro_range'),
        ({'accel_range': 3}, 'accel_range'),
        ({'bus': 'i2c-1'}, 'bus'),
        ({'address': 0x40}, 'address'),
        ({'first_delay': 2.0, 'longest_delay': 1.0}, 'longest_delay'),
    ],
)
def test_bad_parameters_are_named(values, named):
    with pytest.raises(ParameterError, match=named):
        build(Mpu6050Params, values)


@settings(max_examples=50, deadline=None)
@given(rate=st.floats(4.0, 1000.0), bandwidth=st.sampled_from(reg.BANDWIDTHS))
def test_the_rate_is_the_nearest_the_chip_can_make(rate, bandwidth):
    params = build(Mpu6050Params, {'rate': rate, 'bandwidth': bandwidth})
    internal = 8000.0 if bandwidth == 256 else 1000.0
    possible = internal / np.arange(1, 257)
    best = np.abs(internal / possible - internal / rate).min()
    assert abs(internal / params.sample_rate - internal / rate) == pytest.approx(best)
