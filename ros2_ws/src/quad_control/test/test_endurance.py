# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest

from quad_control.craft import CraftParams, max_thrust
from quad_control.endurance import Endurance, battery_for
from quad_control.params import GRAVITY

# Hovering at more than two thirds of full thrust leaves too little to control with.
HEAVIEST = 4.0 * max_thrust(CraftParams()) / GRAVITY / 1.5


def test_ideal_power_is_momentum_theory_by_hand():
    # 1 kg on 4 discs of 0.1 m diameter: v = sqrt(T / (2 rho A)), P = T v.
    e = Endurance(1.0, 0.0, 0.0, propeller_diameter=0.1, figure_of_merit=1.0, efficiency=1.0, avionics=0.0)
    thrust, area = GRAVITY, math.pi * 0.01
    assert e.power == pytest.approx(thrust * math.sqrt(thrust / (2 * 1.225 * area)))


def test_eighteen_minutes_are_plausible_without_payload():
    assert battery_for(18.0, Endurance(), HEAVIEST) < 1.0


def test_eighteen_minutes_with_the_full_payload_need_more_than_the_best_figures():
    generous = Endurance(
        bare_mass=1.2, payload=3.2, energy_density=180.0, figure_of_merit=0.7, efficiency=0.85
    )
    assert battery_for(18.0, generous, HEAVIEST) == math.inf
    assert battery_for(5.0, generous, HEAVIEST) < math.inf


def test_the_battery_found_lasts_as_long_as_asked():
    mass = battery_for(15.0, Endurance(), HEAVIEST)
    assert replace(Endurance(), battery_mass=mass).minutes == pytest.approx(15.0, abs=0.02)
