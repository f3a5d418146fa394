# SPDX-License-Identifier: Apache-2.0
"""How long the craft hovers: momentum theory with a figure of merit, and the battery that must be carried.

Source: Leishman, "Principles of Helicopter Aerodynamics" (2006), section 2.8: ideal hover power
T^1.5 / √(2 ρ A). The paper gives neither mass nor battery, so both are assumptions here, stated as fields.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from kalman_core.parameters import parameter
from quad_control.craft import AIR_DENSITY
from quad_control.params import GRAVITY


@dataclass(frozen=True)
class Endurance:
    """Assumptions of the hover time; the defaults are an ordinary craft of the paper's parts."""

    bare_mass: float = parameter(1.35, 'craft without battery and payload (estimate)', unit='kg')
    battery_mass: float = parameter(0.65, 'battery (estimate: 6S 4-5 Ah)', unit='kg')
    payload: float = parameter(0.0, 'payload', unit='kg')
    energy_density: float = parameter(150.0, 'of LiPo packs (data sheets: 130-180)', unit='Wh/kg')
    usable: float = parameter(0.8, 'share of the charge that is flown')
    propeller_diameter: float = parameter(0.239, '9450: 9.4 inch', unit='m')
    figure_of_merit: float = parameter(0.6, 'ideal over real power (small propellers: 0.5-0.7)')
    efficiency: float = parameter(0.8, 'shaft over battery power (estimate)')
    avionics: float = parameter(5.0, 'electronics (estimate)', unit='W')

    @property
    def mass(self) -> float:
        """Mass in the air (kg)."""
        return self.bare_mass + self.battery_mass + self.payload

    @property
    def power(self) -> float:
        """Battery power in hover (W)."""
        area = 4.0 * math.pi * self.propeller_diameter**2 / 4.0
        ideal = (self.mass * GRAVITY) ** 1.5 / math.sqrt(2.0 * AIR_DENSITY * area)
        return ideal / (self.figure_of_merit * self.efficiency) + self.avionics

    @property
    def minutes(self) -> float:
        """Hover time (min)."""
        return self.battery_mass * self.energy_density * self.usable / self.power * 60.0


def battery_for(minutes: float, assumptions: Endurance, heaviest: float) -> float:
    """Return the lightest battery (kg) that hovers for `minutes`, or inf when none does.

    `heaviest` (kg) is the largest mass in the air that leaves thrust to fly with. Hover time grows with the
    battery up to twice all other mass, so bisection up to there finds the lightest.
    """
    other = assumptions.bare_mass + assumptions.payload
    low, high = 0.0, min(2.0 * other, heaviest - other)
    if high <= 0.0 or replace(assumptions, battery_mass=high).minutes < minutes:
        return math.inf
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        if replace(assumptions, battery_mass=middle).minutes < minutes:
            low = middle
        else:
            high = middle
    return high
