# SPDX-License-Identifier: Apache-2.0
"""The one place where angles of this workspace become marine ones.

Heel positive to starboard, trim positive bow up, heading clockwise from north, degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ship_inclinometer.samples import INVALID, Angles

STALE = 1.0  # s, an attitude older than that is shown as invalid


@dataclass
class Picture:
    """What every bridge shows, brought up to date message by message. Angles in degrees, NaN: unknown."""

    stamp: int = 0
    roll: float = math.nan
    pitch: float = math.nan
    heading: float = math.nan
    roll_rate: float = math.nan
    pitch_rate: float = math.nan
    turn_rate: float = math.nan
    sigma_roll: float = math.nan
    sigma_pitch: float = math.nan
    sigma_heading: float = math.nan
    validity: int = INVALID
    reason: str = 'no attitude'
    heading_valid: bool = False
    rolling: dict[str, float] = field(default_factory=dict)
    peak_reset: int = 0

    def take_angles(self, angles: Angles, offsets: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Take roll, pitch, yaw; `offsets` are degrees added to heel, trim and heading."""
        self.stamp = angles.stamp
        roll, pitch, yaw = (math.degrees(a) for a in angles.angles)
        self.roll = roll + offsets[0]
        self.pitch = -pitch + offsets[1]
        self.heading = (90.0 - yaw + offsets[2]) % 360.0
        rates = [math.degrees(r) for r in angles.rates]
        self.roll_rate, self.pitch_rate, self.turn_rate = rates[0], -rates[1], -60.0 * rates[2]
        self.sigma_roll, self.sigma_pitch, self.sigma_heading = (math.degrees(s) for s in angles.sigmas)

    def take_roll(self, stamp: int, numbers: dict[str, float]) -> None:
        """Take what the roll analysis says, by ROLL_NAMES; angles become degrees."""
        in_degrees = (
            'heel',
            'amplitude_port',
            'amplitude_starboard',
            'peak_port',
            'peak_starboard',
            'mean_heel',
        )
        self.rolling = {n: math.degrees(v) if n in in_degrees else v for n, v in numbers.items()}
        self.peak_reset = stamp - round(self.rolling.get('peak_age', 0.0) * 1e9)

    def number(self, name: str) -> float:
        """Return a number of the roll analysis, NaN where there is none."""
        return self.rolling.get(name, math.nan)

    def age(self, now: int) -> float:
        """Return the age [s] of the attitude at `now` (ns)."""
        return (now - self.stamp) * 1e-9 if self.stamp else math.inf

    def shown_validity(self, now: int) -> tuple[int, str]:
        """Return validity and reason at `now`: silence is invalid."""
        if not self.age(now) <= STALE:
            return INVALID, 'attitude is stale'
        return self.validity, self.reason
