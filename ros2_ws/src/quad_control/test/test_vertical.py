# SPDX-License-Identifier: Apache-2.0
"""Climb rate without a height sensor, and the descent that flies on it."""

import math

import numpy as np
import pytest

from quad_control.arming import DESCENT
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, ImuErrorParams
from quad_control.fault_injection import FASTEST_SINK, SINKING, lose_link_climbing
from quad_control.flight import fly
from quad_control.params import GRAVITY, ControllerParams
from quad_control.samples import RangeSample, Setpoint
from quad_control.simulation import QuadSimulator
from quad_control.vertical import SIZE, VerticalFilter

DT = 0.005
INFLOW = ControllerParams().inflow


def new():
    return VerticalFilter(np.zeros(SIZE))


def stand(f, seconds, bias=0.0):
    for _ in range(round(seconds / DT)):
        f.rest(GRAVITY + bias, DT)


def fly_level(f, force, thrust, seconds, *, climb=None, expected=True):
    for _ in range(round(seconds / DT)):
        f.step(force, force, 1.0, thrust, DT, climb, expected, INFLOW)


def take_off(f, thrust=0.2):
    fly_level(f, GRAVITY + 1.0, thrust, 1.0)


# The filter ---------------------------------------------------------------------------------------------


def test_the_bias_of_the_accelerometer_is_learnt_at_rest_and_not_while_falling():
    f = new()
    stand(f, 3.0, bias=0.3)
    assert f.state[1] == pytest.approx(0.3, abs=0.02)
    stand(f, 3.0, bias=-GRAVITY)
    assert f.state[1] == pytest.approx(0.3, abs=0.02)
    assert f.climb == 0.0


def test_thrust_on_the_ground_is_no_hover_thrust():
    f = new()
    stand(f, 2.0)
    fly_level(f, GRAVITY, 0.12, 20.0)
    assert not f.known
    fly_level(f, GRAVITY + 1.0, 0.22, 1.0)
    assert f.known
    assert f.hover == pytest.approx(0.2, rel=0.1)


def flight(seed, climb=2.0):
    """A rise at 1 m/s, a hover, a steady climb, all with errors; ends in the climb. Error and σ (m/s)."""
    rng = np.random.default_rng(seed)
    gain, inflow = GRAVITY / 0.15 * rng.uniform(0.8, 1.2), rng.uniform(0.4, 0.8)
    bias, moved = 0.2 * rng.standard_normal(), 0.03 * rng.standard_normal()
    f = new()
    stand(f, 3.0, bias)
    v = gust = 0.0
    decay = math.exp(-DT / 2.0)
    for i in range(round(60.0 / DT)):
        t = i * DT
        goal = 1.0 if t < 3.0 else 0.0 if t < 40.0 else climb
        gust = decay * gust + math.sqrt(1.0 - decay**2) * rng.standard_normal()
        thrust = max((GRAVITY + 2.0 * (goal - v) + inflow * v) / gain, 0.02)
        force = gain * thrust - inflow * (v - gust)
        v += DT * (force - GRAVITY)
        felt = force + bias + moved + 0.06 / math.sqrt(DT) * rng.standard_normal()
        f.step(felt, felt, 1.0, thrust, DT, None, True, INFLOW)
    return f.climb - v, f.sigma


def test_a_steady_climb_is_known_as_well_as_its_sigma_says():
    results = np.array([flight(seed) for seed in range(1000, 1020)])
    assert np.mean((results[:, 0] / results[:, 1]) ** 2) < 1.57  # chi-square 95 %, 20 runs
    assert np.sqrt(np.mean(results[:, 0] ** 2)) < 1.2
    assert results[:, 1].max() < 1.6


def test_a_measured_climb_rate_outweighs_the_guess():
    f = new()
    f.start(0.15)
    fly_level(f, GRAVITY, 0.16, 5.0, climb=1.0)
    assert f.climb == pytest.approx(1.0, abs=0.1)
    assert f.sigma < 0.3


def test_an_idle_craft_that_is_carried_has_landed_and_one_that_falls_has_not():
    for force, landed in ((GRAVITY, True), (0.5, False)):
        f = new()
        stand(f, 1.0)
        take_off(f)
        fly_level(f, force, 0.01, 2.0)
        assert f.known != landed


def test_a_force_that_no_flight_makes_leaves_nothing_behind():
    f = new()
    f.start(0.15)
    before = f.state.copy()
    fly_level(f, 1e300, 0.15, DT)
    assert np.array_equal(f.state, before)


def test_a_descent_neither_falls_nor_climbs_away():
    f = new()
    f.start(0.15)
    for climb, share in ((50.0, 0.6), (-50.0, 1.2)):
        f.state[0] = climb
        assert f.sink(0.7, 0.06, INFLOW) == pytest.approx(share * f.hover)


# The craft ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('seed', 'scale', 'payload'),
    [(1000, 0.85, 0.0), (1001, 1.0, 0.0), (1002, 1.15, 0.0), (1003, 0.85, 3.2), (1004, 1.15, 3.2)],
)
def test_a_climbing_craft_that_loses_its_link_sinks_within_3_s_and_slowly(seed, scale, payload):
    descent = lose_link_climbing(seed, scale, payload)
    assert descent.sinking <= SINKING
    assert descent.fastest < FASTEST_SINK


def test_a_climb_of_half_a_minute_is_still_known_to_be_one():
    descent = lose_link_climbing(1005, climbing=30.0)
    assert descent.sinking <= SINKING
    assert descent.fastest < FASTEST_SINK


def test_a_height_sensor_that_falls_silent_leaves_its_climb_rate_behind():
    plant = QuadSimulator(CraftParams(), ImuErrorParams(), seed=5, height=5.0, hovering=True)
    f, controller = AttitudeFilter(), AttitudeController()
    f.start(plant.x[6:10].copy(), plant.imu.gyro_bias)
    controller.start_flying(tuple(plant.x[6:10]), 0.2)
    rates = []

    def pilot(time):
        if round(time / DT) % 10 == 0 and time < 10.0:
            controller.on_range(RangeSample(plant.stamp, float(plant.x[2])))
        if controller.arming.mode == DESCENT:
            rates.append(float(plant.x[5]))
        throttle = 0.17 + 0.05 * (2.0 - plant.x[5])
        return Setpoint(plant.stamp, 0.0, 0.0, 0.0, throttle, True) if time < 12.0 else None

    fly(plant, f, controller, 25.0, pilot)
    assert rates[0] > 1.5
    assert max(rates[round(3.0 / DT) :]) < 0.0
