# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
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


def fly_mission(height, reach, seconds, silent_from=math.inf):
    """Fly the hover mission with a range finder that reaches so far. Returns heights (m) by 5 ms."""
    plant = QuadSimulator(CraftParams(), ImuErrorParams(), seed=3)
    pilot, controller = Pilot(PilotParams(mission='hover', height=height)), AttitudeController()
    heights = []

    def sticks(time):
        if round(time * 200) % 10 == 0 and time < silent_from:
            sample = plant.range()
            pilot.on_range(sample.height if sample.height <= reach else math.inf, 0.05, reach)
            if sample.height <= reach:
                controller.on_range(sample)
        elif time >= silent_from:
            pilot.height = None
        truth = plant.truth()
        pilot.position, pilot.velocity, pilot.yaw = truth.position, truth.velocity, plant.euler[2]
        pilot.state = NAMES[controller.arming.mode]
        heights.append(plant.x[2])
        return pilot.step(plant.stamp)

    fly(plant, AttitudeFilter(), controller, seconds, sticks)
    return pilot, np.array(heights)


@pytest.mark.parametrize('reach', [4.0, 40.0])
def test_a_mission_beyond_the_reach_of_the_range_finder_holds_where_it_measures_and_says_so(reach):
    pilot, heights = fly_mission(50.0, reach, 40.0)
    assert pilot.target == 0.8 * reach
    assert f'the range finder reaches {reach:g} m' in pilot.trouble
    assert heights.max() < reach + 6.0
    assert 0.4 * reach < heights[-2000:].min()
    assert heights[-2000:].max() < reach


def test_a_mission_within_reach_is_flown_as_told():
    pilot, heights = fly_mission(3.0, 40.0, 20.0)
    assert pilot.trouble == ''
    assert heights[-600:] == pytest.approx(3.0, abs=2.0)


def test_a_range_finder_that_dies_in_the_air_brings_the_craft_down():
    pilot, heights = fly_mission(3.0, 40.0, 45.0, silent_from=15.0)
    assert 'no ground in the range finder' in pilot.trouble
    assert heights.max() < 8.0
    assert heights[-1] < 0.1


def test_without_a_range_finder_the_mission_does_not_take_off():
    pilot = Pilot(PilotParams(mission='hover'))
    pilot.on_range(math.inf, 0.1, 10.0)
    assert pilot.height is None
    assert not any(pilot.step(round(i * 1e8)).arm for i in range(60))
    pilot.on_range(-math.inf, 0.1, 10.0)
    assert pilot.height == 0.0
    assert any(pilot.step(round((60 + i) * 1e8)).arm for i in range(60))
    assert Pilot(PilotParams()).trouble == ''
