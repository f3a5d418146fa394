# SPDX-License-Identifier: Apache-2.0
"""The one place where angles of this workspace become marine ones.

Heel positive to starboard, trim positive bow up, heading clockwise from north, degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from ship_inclinometer.samples import INVALID, Angles

STALE = 1.0  # s, an attitude older than that is shown as invalid
# How an offset of heel acts on what the roll analysis says.
_HEEL_SIGN = {
    'heel': 1.0,
    'mean_heel': 1.0,
    'amplitude_port': -1.0,
    'amplitude_starboard': 1.0,
    'peak_port': -1.0,
    'peak_starboard': 1.0,
}
_ONE_SIDED = frozenset(_HEEL_SIGN) - {'heel', 'mean_heel'}


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
    # Set by the operator: degrees added to heel, trim and heading; time constant (s) of `shown_roll`.
    offsets: tuple[float, float, float] = (0.0, 0.0, 0.0)
    filter_time: float = 0.0
    shown_roll: float = math.nan

    def take_settings(self, settings: Mapping[str, float]) -> None:
        """Take the offsets and the display filter of ship/settings."""
        names = ('roll_offset', 'pitch_offset', 'heading_offset')
        roll, pitch, heading = (settings.get(n, old) for n, old in zip(names, self.offsets))
        self.offsets = (roll, pitch, heading)
        self.filter_time = settings.get('display_filter', self.filter_time)

    def take_angles(self, angles: Angles) -> None:
        """Take roll, pitch, yaw."""
        since, self.stamp = (angles.stamp - self.stamp) * 1e-9, angles.stamp
        roll, pitch, yaw = (math.degrees(a) for a in angles.angles)
        self.roll = roll + self.offsets[0]
        self.pitch = -pitch + self.offsets[1]
        self.heading = (90.0 - yaw + self.offsets[2]) % 360.0
        if math.isfinite(self.shown_roll) and 0.0 < since < STALE and self.filter_time > 0.0:
            self.shown_roll += (1.0 - math.exp(-since / self.filter_time)) * (self.roll - self.shown_roll)
        else:
            self.shown_roll = self.roll
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
        """Return a number of the roll analysis, NaN where there is none; heel with its offset."""
        value = self.rolling.get(name, math.nan)
        offset = self.offsets[0] * _HEEL_SIGN.get(name, 0.0)
        return max(value + offset, 0.0) if offset and name in _ONE_SIDED else value + offset

    def age(self, now: int) -> float:
        """Return the age [s] of the attitude at `now` (ns)."""
        return (now - self.stamp) * 1e-9 if self.stamp else math.inf

    def shown_validity(self, now: int) -> tuple[int, str]:
        """Return validity and reason at `now`: silence is invalid."""
        if not self.age(now) <= STALE:
            return INVALID, 'attitude is stale'
        return self.validity, self.reason
