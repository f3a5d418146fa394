# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from quad_control.craft import PITCH_SIGN, ROLL_SIGN, YAW_SIGN
from quad_control.mixer import duty_from_thrust, mix, pulses_from_thrust

LOW, HIGH = 0.006, 1.0
demands = st.floats(-3.0, 3.0)
throttles = st.floats(-1.0, 2.0)
many = settings(max_examples=300, deadline=None)


def mixed(roll, pitch, yaw, throttle, low=LOW, high=HIGH):
    thrust, achieved = np.zeros(4), np.zeros(4)
    mix(roll, pitch, yaw, throttle, low, high, thrust, achieved)
    return thrust, achieved


def torques(thrust):
    return np.array([ROLL_SIGN @ thrust, PITCH_SIGN @ thrust, YAW_SIGN @ thrust, thrust.sum()]) / 4.0


@many
@given(demands, demands, demands, throttles, st.floats(0.0, 0.3))
def test_every_pulse_is_within_its_limits_for_every_demand(roll, pitch, yaw, throttle, low):
    thrust, _ = mixed(roll, pitch, yaw, throttle, low)
    pulses = np.zeros(4)
    for curve in (0.0, 0.5, 1.0):
        for sag in (0.5, 0.9, 1.2):
            pulses_from_thrust(thrust, curve, sag, 1000.0, 2000.0, pulses)
            assert np.all((pulses >= 1000.0) & (pulses <= 2000.0))


@many
@given(demands, demands, demands, throttles)
def test_what_is_reported_is_what_the_motors_make(roll, pitch, yaw, throttle):
    thrust, achieved = mixed(roll, pitch, yaw, throttle)
    assert torques(thrust) == pytest.approx(achieved, abs=1e-12)


@many
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), demands, throttles)
def test_roll_and_pitch_are_kept_in_full_while_any_thrust_gives_them(roll, pitch, yaw, throttle):
    # The largest difference between two motors is 2(|r| + |p|): that is all the room there is.
    assume(2.0 * (abs(roll) + abs(pitch)) <= HIGH - LOW)
    _, achieved = mixed(roll, pitch, yaw, throttle)
    assert achieved[:2] == pytest.approx([roll, pitch], abs=1e-12)


@many
@given(demands, demands, demands, throttles)
def test_beyond_that_the_torque_keeps_its_axis_and_uses_all_room(roll, pitch, yaw, throttle):
    assume(2.0 * (abs(roll) + abs(pitch)) > HIGH - LOW)
    thrust, achieved = mixed(roll, pitch, yaw, throttle)
    assert achieved[0] * pitch == pytest.approx(achieved[1] * roll, abs=1e-9)
    assert np.ptp(thrust) == pytest.approx(HIGH - LOW, abs=1e-9)


@many
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), demands, throttles)
def test_throttle_gives_way_only_as_far_as_roll_and_pitch_need(roll, pitch, yaw, throttle):
    need = abs(roll) + abs(pitch)
    assume(2.0 * need <= HIGH - LOW)
    _, achieved = mixed(roll, pitch, yaw, throttle)
    assert achieved[3] == pytest.approx(np.clip(throttle, LOW + need, HIGH - need), abs=1e-12)


@many
@given(demands, demands, demands, throttles)
def test_yaw_is_the_most_that_is_left(roll, pitch, yaw, throttle):
    thrust, achieved = mixed(roll, pitch, yaw, throttle)
    assert achieved[2] * yaw >= 0.0
    assert abs(achieved[2]) <= abs(yaw)
    if abs(achieved[2]) < abs(yaw) - 1e-9:
        # One more grain of yaw would push some motor over an edge.
        more = thrust + YAW_SIGN * math.copysign(1e-6, yaw)
        assert more.min() < LOW or more.max() > HIGH


@many
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_duty_inverts_the_thrust_curve(thrust, curve):
    d = duty_from_thrust(thrust, curve, 1.0)
    assert curve * d * d + (1.0 - curve) * d == pytest.approx(thrust, abs=1e-9)


def test_a_sagging_battery_gets_more_duty_and_the_same_thrust():
    full, sagging = duty_from_thrust(0.3, 1.0, 1.0), duty_from_thrust(0.3, 1.0, 0.85)
    assert sagging * 0.85 == pytest.approx(full)
