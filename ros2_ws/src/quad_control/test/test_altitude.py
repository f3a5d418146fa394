# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from quad_control.altitude import SIZE, Altitude, pressure_height, upward_acceleration
from quad_control.params import GRAVITY, ControllerParams

DT = 0.005
LEVEL = (1.0, 0.0, 0.0, 0.0)


def loop(seconds, throttle, hover=0.2, height=2.0, bias=0.0, ranges=True):
    """A point mass on a column of thrust; `throttle(altitude)` per step. Returns altitude, heights."""
    a = Altitude(np.zeros(SIZE))
    a.hover = hover
    z, v, heights = height, 0.0, []
    for i in range(round(seconds / DT)):
        time = i * DT
        if ranges and i % 10 == 0:
            a.correct(z, time)
        thrust = throttle(a)
        force = GRAVITY * thrust / hover
        a.predict(upward_acceleration(LEVEL, (0.0, 0.0, force + bias)), DT)
        v += DT * (force - GRAVITY)
        z += DT * v
        heights.append(z)
    return a, np.array(heights)


def test_hold_keeps_the_height_despite_an_accelerometer_bias():
    p = ControllerParams()
    _, heights = loop(20.0, lambda a: a.hold(p, DT), bias=0.2)
    assert np.abs(heights[-1000:] - 2.0).max() < 0.1


def test_a_descent_sinks_at_its_rate():
    p = ControllerParams()
    _, heights = loop(10.0, lambda a: a.climb(-0.7, p, DT), height=30.0)
    rate = (heights[-1] - heights[-401]) / 2.0
    assert rate == pytest.approx(-0.7, abs=0.05)


def test_hover_thrust_is_learnt_from_thrust_and_force():
    a = Altitude(np.zeros(SIZE))
    for _ in range(1000):
        a.learn_hover(0.36, 1.2 * GRAVITY, DT)
    assert a.hover == pytest.approx(0.3)
    a.learn_hover(0.9, 3.0 * GRAVITY, DT)  # a jerk is no hover
    assert a.hover == pytest.approx(0.3)


def test_a_silent_range_finder_is_not_fresh():
    a = Altitude(np.zeros(SIZE))
    assert not a.fresh(0.0)
    a.correct(1.0, 10.0)
    assert a.fresh(10.4)
    assert not a.fresh(10.6)


def test_a_height_that_jumps_is_believed_the_fourth_time():
    a = Altitude(np.zeros(SIZE))
    a.correct(1.0, 10.0)
    assert [a.correct(2.0, 10.05 + 0.05 * i, jump=0.5) for i in range(4)] == [False, False, False, True]
    assert a.state[0] == 2.0
    assert a.state[1] == 0.0


def test_on_the_ground_means_low_and_at_rest_for_a_while():
    a = Altitude(np.zeros(SIZE))
    a.correct(0.05, 1.0)
    assert not a.on_ground(1.0)
    assert not a.on_ground(1.4)
    assert a.on_ground(1.6)
    a.state[0] = 2.0
    assert not a.on_ground(1.7)


def test_pressure_height_is_the_standard_atmosphere():
    # ISA tables: 1013.25 hPa at 0 m, 898.76 hPa at 1000 m.
    assert pressure_height(89876.0, 101325.0) == pytest.approx(1000.0, abs=0.5)
