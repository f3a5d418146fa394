# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ev_velocity import plant
from ev_velocity.params import VelocityParams
from ev_velocity.plant import GRAVITY, Car
from ev_velocity.scenarios import RATE, SCENARIOS
from ev_velocity.simulation import COURSES, Course, drive_course, named
from ev_velocity.velocity_batch import run_drive

DT = 1.0 / RATE
NONE = np.empty((0, 3))
ALL = np.array([1.0, 1.0])


def drive(targets, car=None, limits=ALL, patches=NONE, hills=NONE, abs_slip=0.0):
    return plant.drive((car or Car()).array(), targets, limits, patches, hills, abs_slip, DT)


def full_speed(seconds, **kwargs):
    return drive(np.full(round(seconds * RATE), 60.0), **kwargs)


def test_full_throttle_is_limited_by_torque_then_by_power():
    out = full_speed(120.0)
    car = Car()
    inertia = car.mass + (2.0 * car.wheel_inertia + car.motor_inertia) / car.radius**2
    start = (car.motor_torque * car.gear_ratio / car.radius - car.rolling * car.mass * GRAVITY) / inertia
    assert out[round(1.5 * RATE), 1] == pytest.approx(start, rel=0.03)
    # At the end the power of the motor is what drag and rolling take.
    v = out[-1, 0]
    resistance = 0.6 * car.drag_area * v * v + car.rolling * car.mass * GRAVITY
    assert resistance * v == pytest.approx(car.motor_power, rel=0.05)


def test_braking_is_limited_by_the_friction_of_the_road():
    targets = np.concatenate((np.full(round(8 * RATE), 15.0), np.zeros(round(10 * RATE))))
    friction = 0.4
    icy = np.array([[-10.0, 1e5, friction]])
    out = drive(targets, patches=icy)
    # The tyre's curve has its peak at 1; a locked wheel slides with less.
    assert out[:, 1].min() > -friction * GRAVITY * 1.1
    assert out[:, 1].min() < -friction * GRAVITY * 0.6
    assert drive(targets)[:, 1].min() < out[:, 1].min() - 1.0


def test_abs_keeps_the_wheels_turning():
    targets = np.concatenate((np.full(round(8 * RATE), 15.0), np.zeros(round(10 * RATE))))
    icy = np.array([[-10.0, 1e5, 0.3]])
    locked, turning = (drive(targets, patches=icy, abs_slip=slip) for slip in (0.0, 0.15))
    fast = locked[:, 0] > 5.0
    braking = fast & (locked[:, 6] > 0.3)
    assert (locked[braking, 3] / locked[braking, 0]).min() < 0.2
    fast = (turning[:, 0] > 5.0) & (turning[:, 6] > 0.3)
    assert (turning[fast, 3] / turning[fast, 0]).min() > 0.6


def test_a_hill_costs_what_gravity_takes():
    hill = np.array([[5.0, 1e5, 0.10]])
    flat, steep = full_speed(12.0), full_speed(12.0, hills=hill)
    k = round(6.0 * RATE)
    car = Car()
    ratio = car.mass / (car.mass + (2.0 * car.wheel_inertia + car.motor_inertia) / car.radius**2)
    lost = GRAVITY * np.sin(np.arctan(0.10)) * ratio
    assert flat[k, 1] - steep[k, 1] == pytest.approx(lost, abs=0.5)


def test_a_car_left_alone_stays_where_it_is():
    out = drive(np.zeros(round(5 * RATE)))
    assert np.abs(out[:, 0]).max() == 0.0
    assert np.abs(out[:, 2]).max() == 0.0


def test_on_the_patch_the_driven_wheel_spins_and_comes_back():
    d = drive_course(COURSES['plant_oil_patch'], 0)
    excess = d.wheel_speed * (1.0 + d.radius_error) - d.v
    spinning = np.flatnonzero(excess > 1.0)
    assert excess.max() > 4.0
    assert 0.1 < (spinning[-1] - spinning[0]) / RATE < 1.0
    assert np.abs(excess[spinning[-1] + round(RATE) :]).max() < 0.5


@pytest.mark.parametrize('name', COURSES)
def test_the_joint_filter_copes_with_every_course(name):
    squares = []
    for seed in range(3):
        d = named(name, seed)
        assert d.v.max() > 4.0
        error = run_drive(VelocityParams(), d).speed - d.v
        squares.append(np.mean(error**2))
        # The first second of a drive that nothing is known of is not what the courses are about.
        assert np.abs(error[2 * round(RATE) :]).max() < 0.6
    assert np.mean(squares) ** 0.5 < 0.08


def test_names_are_found_or_listed():
    assert named('good_road_10hz', 1, 5.0).t[-1] == pytest.approx(5.0)
    with pytest.raises(KeyError, match='plant_long_hill'):
        named('nowhere', 1)
    assert not set(COURSES) & set(SCENARIOS)
    assert drive_course(Course(), 1, 3.0).t[-1] == pytest.approx(3.0)
