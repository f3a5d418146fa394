# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest

from quad_control.arming import NAMES
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, ImuErrorParams
from quad_control.flight import fly
from quad_control.pilot import Pilot, PilotParams
from quad_control.simulation import QuadSimulator


def test_the_manual_pilot_says_what_the_parameters_say():
    sticks = Pilot(PilotParams(roll=0.1, throttle=0.3, arm=True)).step(7)
    assert (sticks.stamp, sticks.roll, sticks.throttle, sticks.arm) == (7, 0.1, 0.3, True)


def test_beyond_the_range_of_the_link_nothing_is_said():
    pilot = Pilot(PilotParams())
    pilot.position = (149.0, 0.0, 0.0)
    assert pilot.step(1) is not None
    pilot.position = (149.0, 20.0, 0.0)
    assert pilot.step(1) is None


def test_the_mission_turns_the_switch_off_and_on_until_it_is_armed():
    pilot = Pilot(PilotParams(mission='hover'))
    switches = [pilot.step(round(i * 1e8)).arm for i in range(60)]
    assert True in switches
    assert False in switches[switches.index(True) :]
    pilot.state = 'armed'
    assert all(pilot.step(round((60 + i) * 1e8)).arm for i in range(60))


def test_in_a_failsafe_descent_the_mission_leaves_the_switch_on():
    pilot = Pilot(PilotParams(mission='hover'))
    pilot.state = 'armed'
    pilot.state = 'failsafe descent'
    assert all(pilot.step(round(i * 2e7)).arm for i in range(300))


def test_after_a_stop_the_mission_arms_no_more_until_it_is_told_again():
    pilot = Pilot(PilotParams(mission='hover'))
    pilot.state = 'armed'
    pilot.state = 'failsafe stopped'
    pilot.state = 'disarmed'
    assert not any(pilot.step(round(i * 1e8)).arm for i in range(60))
    pilot.params = PilotParams(mission='hover', height=2.0)
    assert any(pilot.step(round((60 + i) * 1e8)).arm for i in range(60))


def test_the_mission_takes_off_and_stays_in_place_at_its_height_in_gusts():
    plant = QuadSimulator(CraftParams(gust=0.5), ImuErrorParams(), seed=3)
    pilot, controller = Pilot(PilotParams(mission='hover', height=2.0)), AttitudeController()

    def sticks(time):
        if round(time * 200) % 10 == 0:
            sample = plant.range()
            pilot.height = sample.height
            controller.on_range(sample)
        truth = plant.truth()
        pilot.position, pilot.velocity, pilot.yaw = truth.position, truth.velocity, plant.euler[2]
        pilot.state = NAMES[controller.arming.mode]
        return pilot.step(plant.stamp)

    fly(plant, AttitudeFilter(), controller, 40.0, sticks)
    x, y, z = plant.truth().position
    assert z == pytest.approx(2.0, abs=1.5)
    assert math.hypot(x, y) < 3.0


def test_a_pilot_leans_back_towards_the_start_in_any_heading():
    pilot = Pilot(replace(PilotParams(mission='hover')))
    pilot.state = 'armed'
    pilot.position = (2.0, 0.0, 1.0)
    assert pilot.step(1).pitch < 0.0  # ahead of the start: nose up, backwards
    pilot.yaw = math.pi / 2
    assert pilot.step(1).roll < 0.0  # the start is to the left now: left side down
