# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from quad_control import plant
from quad_control.craft import CraftParams, ImuErrorParams, benchmark_craft, benchmark_imu
from quad_control.params import GRAVITY
from quad_control.simulation import QuadSimulator

PERFECT = benchmark_imu(gyro_noise=0.0, accelerometer_noise=0.0, white_vibration=0.0)


def test_a_perfect_imu_at_rest_reads_g_upwards_and_no_rate():
    craft = QuadSimulator(CraftParams(pinned=True), PERFECT)
    sample = craft.sense()
    assert sample.force == pytest.approx((0.0, 0.0, GRAVITY))
    assert sample.rate == pytest.approx((0.0, 0.0, 0.0))


def test_an_imu_off_the_centre_sees_the_centripetal_acceleration():
    craft = QuadSimulator(benchmark_craft(imu_position=(0.1, 0.0, 0.0)), PERFECT, height=5.0)
    craft.x[plant.RATES] = (0.0, 0.0, 4.0)
    assert craft.sense().force[0] == pytest.approx(-0.1 * 16.0, abs=1e-9)


def test_noise_has_the_spread_that_its_density_says():
    errors = benchmark_imu(gyro_noise=0.01, accelerometer_noise=0.1, white_vibration=0.0)
    craft = QuadSimulator(CraftParams(pinned=True), errors, rate=200.0)
    samples = [craft.sense() for _ in range(4000)]
    assert np.std([s.rate for s in samples]) == pytest.approx(0.01 * math.sqrt(200.0), rel=0.05)
    assert np.std([s.force[:2] for s in samples]) == pytest.approx(0.1 * math.sqrt(200.0), rel=0.05)


def test_motors_shake_the_imu_and_stopped_motors_do_not():
    def spread(hovering):
        craft = QuadSimulator(
            benchmark_craft(pinned=True), benchmark_imu(rotor_vibration=1.0, white_vibration=0.0),
            hovering=hovering,
        )  # fmt: skip
        out = []
        for _ in range(400):
            out.append(craft.sense().force[0])
            craft.advance(None)
        return np.std(out)

    assert spread(True) > 0.3
    assert spread(False) < 0.2


def test_one_seed_gives_one_flight_and_another_seed_another():
    def flight(seed):
        craft = QuadSimulator(CraftParams(gust=1.0), ImuErrorParams(), seed=seed, hovering=True, height=5.0)
        out = []
        for _ in range(50):
            out.append(craft.sense())
            craft.advance((1400.0, 1400.0, 1400.0, 1400.0))
        return out

    assert flight(1) == flight(1)
    assert flight(1) != flight(2)


@pytest.mark.parametrize('delay', [0.0, 0.005, 0.012])
def test_a_command_acts_after_its_delay(delay):
    craft = QuadSimulator(benchmark_craft(command_delay=delay), PERFECT, rate=1000.0, height=5.0)
    steps = 0
    while craft.x[plant.ROTORS][0] == 0.0:
        craft.advance((1500.0,) * 4)
        steps += 1
    assert steps == round(delay * 1000) + 1


def test_a_pulse_that_is_not_finite_is_refused():
    craft = QuadSimulator(CraftParams(), PERFECT)
    with pytest.raises(ValueError, match='expected four finite numbers'):
        craft.advance((1500.0, math.nan, 1500.0, 1500.0))


def test_the_mpu6050_has_steps_and_a_range():
    errors = ImuErrorParams(gyro_bias=0.0, misalignment=0.0)
    craft = QuadSimulator(CraftParams(), errors, height=5.0)
    craft.x[plant.RATES] = (20.0, 0.0, 0.0)
    sample = craft.sense()
    assert sample.rate[0] == pytest.approx(math.radians(500.0))
    step = math.radians(1.0 / 65.5)
    assert sample.rate[1] / step == pytest.approx(round(sample.rate[1] / step), abs=1e-6)
