# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kalman_core.rotation import euler_from_quat, matrix_from_quat, quat_from_euler
from quad_control import plant
from quad_control.craft import CraftParams, benchmark_craft, hover_fraction, inertia_about, lever, max_thrust
from quad_control.mixer import duty_from_thrust, mix
from quad_control.params import GRAVITY


def state(craft, roll=0.0, pitch=0.0, height=50.0, rotors=0.0):
    x = np.zeros(plant.STATE_SIZE)
    x[plant.QUATERNION] = quat_from_euler(roll, pitch, 0.0)
    x[2] = height
    x[plant.ROTORS] = rotors
    x[plant.VOLTAGE] = plant.open_circuit_voltage(0.0, craft.cells)
    return x


def run(x, craft, duty, seconds, dt=1e-3):
    p = plant.pack(craft)
    for _ in range(round(seconds / dt)):
        plant.advance(x, np.asarray(duty, dtype=float), p, dt)
    return x


def duties(roll=0.0, pitch=0.0, yaw=0.0, throttle=0.2):
    thrust, achieved = np.zeros(4), np.zeros(4)
    mix(roll, pitch, yaw, throttle, 0.0, 1.0, thrust, achieved)
    return [duty_from_thrust(t, 1.0, 1.0) for t in thrust]


@pytest.mark.parametrize('pinned', [False, True])
@pytest.mark.parametrize(('axis', 'name'), list(enumerate(('roll', 'pitch', 'yaw'))))
def test_a_positive_command_turns_the_body_the_positive_way(axis, name, pinned):
    craft = benchmark_craft(pinned=pinned)
    for sign in (1.0, -1.0):
        x = run(state(craft), craft, duties(**{name: 0.01 * sign}), 0.3)
        angles = np.array(euler_from_quat(x[plant.QUATERNION])) * sign
        assert angles[axis] > math.radians(0.5)
        assert np.abs(np.delete(angles, axis)).max() < 1e-6


def test_positive_roll_lifts_the_left_side_and_positive_pitch_lowers_the_nose():
    # Said once without a matrix: front left and rear left up is roll, rear pair up is pitch (REP-103).
    base = np.array(duties())
    x = run(state(benchmark_craft()), benchmark_craft(), base * [1.1, 1.0, 1.1, 1.0], 0.1)
    assert euler_from_quat(x[plant.QUATERNION])[0] > 0.0
    x = run(state(benchmark_craft()), benchmark_craft(), base * [1.0, 1.0, 1.1, 1.1], 0.1)
    assert euler_from_quat(x[plant.QUATERNION])[1] > 0.0


def test_hover_thrust_holds_the_height():
    craft = benchmark_craft(3.2)
    speed = math.sqrt(craft.mass * GRAVITY / (4.0 * craft.thrust_coefficient))
    x = run(state(craft, rotors=speed), craft, [math.sqrt(hover_fraction(craft))] * 4, 2.0)
    assert x[2] == pytest.approx(50.0, abs=1e-6)


def test_free_fall_without_air_is_g():
    x = run(state(benchmark_craft()), benchmark_craft(), [0.0] * 4, 1.0)
    assert x[5] == pytest.approx(-GRAVITY, abs=1e-9)


def test_torque_free_tumbling_keeps_angular_momentum_and_energy():
    craft = benchmark_craft(inertia=(0.02, 0.03, 0.045))
    x = state(craft)
    x[plant.RATES] = (3.0, 0.2, 1.0)
    inertia = np.diag(craft.inertia)

    def invariants(x):
        w = x[plant.RATES]
        return (*(matrix_from_quat(x[plant.QUATERNION]) @ inertia @ w), 0.5 * w @ inertia @ w)

    before = invariants(x)
    run(x, craft, [0.0] * 4, 3.0)
    assert invariants(x) == pytest.approx(before, rel=1e-8)


def test_a_hanging_payload_on_the_stand_swings_as_a_physical_pendulum():
    craft = CraftParams(pinned=True, payload=1.0, payload_offset=(0.0, 0.0, -0.2), stand_friction=0.0)
    x = state(craft, roll=0.3)
    run(x, craft, [0.0] * 4, 1.0)
    inertia = inertia_about(craft, np.zeros(3))[0, 0]
    oracle = solve_ivp(
        lambda _, s: (s[1], -craft.payload * GRAVITY * 0.2 * math.sin(s[0]) / inertia),
        (0.0, 1.0),
        (0.3, 0.0),
        rtol=1e-10,
        atol=1e-12,
    )
    assert euler_from_quat(x[plant.QUATERNION])[0] == pytest.approx(oracle.y[0, -1], abs=1e-6)


def test_inertia_of_the_payload_follows_the_parallel_axis_theorem():
    craft = CraftParams(payload=1.0, payload_offset=(0.0, 0.0, -0.1), payload_size=0.0)
    moment = inertia_about(craft, np.array([0.0, 0.0, -0.1]))
    assert moment[0, 0] == pytest.approx(0.022 + 2.0 * 0.01)
    assert moment[2, 2] == pytest.approx(0.038)


def test_on_the_stand_the_accelerometer_sees_tilt_and_in_free_flight_it_does_not():
    tilt = math.radians(10.0)
    out = np.zeros(6)
    for pinned, expected in ((True, GRAVITY * math.sin(tilt)), (False, 0.0)):
        craft = benchmark_craft(pinned=pinned)
        plant.specific_force(state(craft, roll=tilt, rotors=600.0), plant.pack(craft), np.zeros(3), out)
        assert out[1] == pytest.approx(expected, abs=1e-12)


def test_the_motor_reaches_63_percent_after_its_time_constant():
    craft = benchmark_craft()
    x = run(state(craft), craft, [0.5] * 4, craft.motor_time)
    assert x[13] == pytest.approx(0.5 * craft.rotor_max * (1.0 - math.exp(-1.0)), rel=1e-6)


def test_droop_leaves_full_speed_at_full_duty_and_bends_the_curve_below():
    craft = CraftParams(motor_droop=0.5)
    p = plant.pack(craft)
    full = plant.open_circuit_voltage(0.0, 6)
    assert plant.rotor_target(1.0, full, p) == pytest.approx(craft.rotor_max)
    assert plant.rotor_target(0.5, full, p) > 0.5 * craft.rotor_max


def test_the_battery_sags_under_load_and_empties():
    craft = CraftParams(capacity=0.02)
    x = state(craft, height=5.0)
    run(x, craft, [0.5] * 4, 0.2)
    loaded = x[plant.VOLTAGE]
    assert loaded < plant.open_circuit_voltage(x[plant.CHARGE] / 72.0, 6.0)
    run(x, craft, [0.5] * 4, 20.0)
    assert x[plant.CHARGE] == pytest.approx(72.0)
    assert x[plant.VOLTAGE] < 3.1 * 6


def test_the_ground_carries_the_craft_at_rest_and_level():
    craft = CraftParams()
    x = run(state(craft, roll=0.1, height=0.3), craft, [0.0] * 4, 4.0)
    assert -0.01 < x[2] < 0.01
    assert abs(x[5]) < 1e-3
    assert abs(euler_from_quat(x[plant.QUATERNION])[0]) < 1e-3
    out = np.zeros(6)
    plant.specific_force(x, plant.pack(craft), np.zeros(3), out)
    assert out[2] == pytest.approx(GRAVITY, abs=0.01)


def test_drag_brings_a_glide_to_the_wind():
    craft = benchmark_craft(wind=(3.0, 0.0, 0.0), drag_linear=0.25)
    speed = math.sqrt(craft.mass * GRAVITY / (4.0 * craft.thrust_coefficient))
    x = run(state(craft, rotors=speed), craft, [math.sqrt(hover_fraction(craft))] * 4, 60.0)
    assert x[3] == pytest.approx(3.0, abs=0.1)


def test_gusts_have_their_stationary_spread():
    rng = np.random.default_rng(3)
    x = np.zeros(plant.STATE_SIZE)
    values = []
    for _ in range(20_000):
        plant.advance_gust(x, 2.0, 0.5, 0.1, rng.standard_normal(3))
        values.append(x[17])
    assert np.std(values) == pytest.approx(2.0, rel=0.05)


def test_torque_per_thrust_fraction_is_lever_times_thrust():
    craft = benchmark_craft()
    x = state(craft)
    x[plant.ROTORS] = [1500.0, 0.0, 1500.0, 0.0]
    out = np.zeros(6)
    plant.specific_force(x, plant.pack(craft), np.zeros(3), out)
    assert out[3] == pytest.approx(2.0 * max_thrust(craft) * lever(craft) / 0.022)
