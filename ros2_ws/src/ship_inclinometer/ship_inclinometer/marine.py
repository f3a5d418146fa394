# SPDX-License-Identifier: Apache-2.0
"""The one place where angles of this workspace become marine ones.

Heel positive to starboard, trim positive bow up, heading clockwise from north, degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from ship_inclinometer.samples import INVALID, VALIDITY, Angles, Validity

STALE = 1.0  # s, an attitude further off than that, into the past or the future, is shown as invalid
# Roll analysis and alarms: three times the longest period at which they may be published (s).
SLOW_STALE = 3.0
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
    rolling_stamp: int = 0
    peak_reset: int = 0
    alarms: dict[str, float] = field(default_factory=dict)
    alarms_stamp: int = 0
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
        # The remainder of a negative number near zero rounds to 360 itself.
        self.heading = (90.0 - yaw + self.offsets[2]) % 360.0 % 360.0
        if math.isfinite(self.shown_roll) and 0.0 < since < STALE and self.filter_time > 0.0:
            self.shown_roll += (1.0 - math.exp(-since / self.filter_time)) * (self.roll - self.shown_roll)
        else:
            self.shown_roll = self.roll
        rates = [math.degrees(r) for r in angles.rates]
        self.roll_rate, self.pitch_rate, self.turn_rate = rates[0], -rates[1], -60.0 * rates[2]
        self.sigma_roll, self.sigma_pitch, self.sigma_heading = (math.degrees(s) for s in angles.sigmas)

    def take_validity(self, validity: Validity) -> None:
        """Take the validity; a level that is none counts as invalid."""
        known = 0 <= validity.validity < len(VALIDITY)
        self.validity = validity.validity if known else INVALID
        self.reason = validity.reason
        self.heading_valid = validity.heading_valid

    def take_alarms(self, stamp: int, numbers: Mapping[str, float]) -> None:
        """Take what the alarm monitor says."""
        self.alarms, self.alarms_stamp = dict(numbers), stamp

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
        self.rolling_stamp = stamp
        age = self.rolling.get('peak_age', 0.0) * 1e9
        self.peak_reset = stamp - round(age) if 0.0 <= age < stamp else 0

    def rolling_known(self, now: int) -> bool:
        """Return whether the roll analysis has spoken lately at `now` (ns)."""
        return bool(self.rolling) and _fresh(now, self.rolling_stamp, SLOW_STALE)

    def alarms_known(self, now: int) -> bool:
        """Return whether the alarm monitor has spoken lately at `now` (ns)."""
        return bool(self.alarms) and _fresh(now, self.alarms_stamp, SLOW_STALE)

    def shown_alarms(self, now: int) -> dict[str, float]:
        """Return what the alarm monitor said, nothing when that is old."""
        return self.alarms if self.alarms_known(now) else {}

    def number(self, name: str, now: int) -> float:
        """Return a number of the roll analysis, NaN where there is none or it is old; heel with offset."""
        value = self.rolling.get(name, math.nan) if self.rolling_known(now) else math.nan
        offset = self.offsets[0] * _HEEL_SIGN.get(name, 0.0)
        return max(value + offset, 0.0) if offset and name in _ONE_SIDED else value + offset

    def age(self, now: int) -> float:
        """Return the age [s] of the attitude at `now` (ns), infinite for one out of a future that is none."""
        age = (now - self.stamp) * 1e-9
        return age if self.stamp and age >= -STALE else math.inf

    def shown_validity(self, now: int) -> tuple[int, str]:
        """Return validity and reason at `now`: silence is invalid."""
        if not self.age(now) <= STALE:
            ahead = self.stamp > now
            return INVALID, 'attitude is stamped in the future' if ahead else 'attitude is stale'
        return self.validity, self.reason


def _fresh(now: int, stamp: int, limit: float) -> bool:
    """Return whether `stamp` is within `limit` (s) of `now`: after a step of the clock it may lie ahead."""
    return abs(now - stamp) * 1e-9 <= limit
