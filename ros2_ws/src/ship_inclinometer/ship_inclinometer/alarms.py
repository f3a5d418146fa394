# SPDX-License-Identifier: Apache-2.0
"""Alarms with hysteresis, delay, acknowledgement, latching and silence. Pure: time comes in with each call.

Time is that of a clock that does not step (ns); should it go back all the same, no time has passed.

States after IEC 62923-1 (bridge alert management), section 6: an alert is active or not, acknowledged or
not; a latched one stays until it is acknowledged. Warnings need no latch but are handled alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from kalman_core.event_time import NANOSECONDS
from ship_inclinometer.marine import Picture
from ship_inclinometer.roll_analysis import NO_ROLL
from ship_inclinometer.samples import INVALID

# An alarm ends at the latest at this share of its threshold: a hysteresis as large as the threshold, which
# settings of two sources can add up to, would never let it end.
_LOWEST_END = 0.5


@dataclass(frozen=True, slots=True)
class Rule:
    """One alarm: `quantity` (its magnitude counts) over the setting `threshold`; None: a yes/no quantity."""

    name: str
    quantity: str
    threshold: str | None
    text: str


RULES = (
    Rule('heel_warning', 'heel', 'heel_warning', 'heel over the warning threshold'),
    Rule('heel_alarm', 'heel', 'heel_alarm', 'heel over the alarm threshold'),
    Rule('roll_alarm', 'amplitude', 'roll_alarm', 'roll amplitude over the threshold'),
    Rule('pitch_alarm', 'pitch', 'pitch_alarm', 'trim over the threshold'),
    Rule('resonance_warning', 'resonance', None, 'synchronous or parametric roll'),
    Rule('sensor_alarm', 'sensor_fault', None, 'no valid attitude, or no roll analysis'),
)


@dataclass(slots=True)
class AlarmState:
    """Where one alarm stands; `over` is for how long (ns) it was seen over its threshold before it is raised.

    `judged` is when it was last seen so, None when it was not: time of which nothing is known does not count.
    """

    active: bool = False
    acknowledged: bool = True
    over: int = 0
    judged: int | None = None

    @property
    def shown(self) -> bool:
        """Whether it stands on the list: active, or over but not acknowledged."""
        return self.active or not self.acknowledged


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """Something to be logged: `kind` is 'alarm', 'end' or 'acknowledge'."""

    kind: str
    name: str
    text: str


class AlarmMonitor:
    """Judges quantities (degrees, NaN: unknown) against thresholds."""

    def __init__(self, settings: Mapping[str, float], latching: bool = True) -> None:
        self.settings = dict(settings)
        self.latching = latching
        self.states = {rule.name: AlarmState() for rule in RULES}
        # The stop flag: at the quay, under repair. Nothing is judged, nothing sounds, and it is shown.
        self.stopped = False
        # Time that has passed since the start (ns), and the clock when it was last looked at.
        self._elapsed = 0
        self._clock: int | None = None
        self._silent_until = 0

    def _pass(self, now: int) -> int:
        """Return the time (ns) that has passed at `now`."""
        if self._clock is not None:
            self._elapsed += max(now - self._clock, 0)
        self._clock = now
        return self._elapsed

    def update(self, now: int, quantities: Mapping[str, float]) -> list[AlarmEvent]:
        """Judge at `now` (ns) and return what has changed.

        An unknown quantity neither raises nor ends its alarm; nothing does while `stopped`.
        """
        events: list[AlarmEvent] = []
        elapsed = self._pass(now)
        for rule in RULES:
            value = math.nan if self.stopped else abs(quantities.get(rule.quantity, math.nan))
            if math.isnan(value):
                self.states[rule.name].judged = None
                continue
            event = self._judge(rule, elapsed, value)
            if event is not None:
                events.append(event)
        return events

    def _judge(self, rule: Rule, elapsed: int, value: float) -> AlarmEvent | None:
        state = self.states[rule.name]
        threshold = self.settings[rule.threshold] if rule.threshold else 0.5
        if not state.active:
            if value <= threshold:
                state.over, state.judged = 0, None
                return None
            state.over += elapsed - state.judged if state.judged is not None else 0
            state.judged = elapsed
            if state.over < self.settings['alarm_delay'] * NANOSECONDS:
                return None
            state.active, state.acknowledged = True, False
            self._silent_until = 0
            return AlarmEvent('alarm', rule.name, f'{rule.text}: {value:.1f}')
        hysteresis = self.settings['hysteresis'] if rule.threshold else 0.0
        if value > max(threshold - hysteresis, _LOWEST_END * threshold):
            return None
        state.active, state.over, state.judged = False, 0, None
        if not self.latching:
            state.acknowledged = True
        return AlarmEvent('end', rule.name, f'{rule.text}: ended at {value:.1f}')

    def acknowledge(self, name: str = '') -> list[AlarmEvent]:
        """Acknowledge the alarm `name`, or all."""
        events = []
        for key, state in self.states.items():
            if not state.acknowledged and name in ('', key):
                state.acknowledged = True
                events.append(AlarmEvent('acknowledge', key, 'acknowledged'))
        return events

    def silence(self, now: int) -> None:
        """Silence the sound for the set time; a new alarm breaks it."""
        self._silent_until = self._pass(now) + round(self.settings['silence_time'] * NANOSECONDS)

    def sounding(self, now: int) -> bool:
        """Return whether the buzzer should sound at `now`."""
        if self._pass(now) < self._silent_until or self.stopped:
            return False
        return any(not s.acknowledged for s in self.states.values())

    def numbers(self, now: int) -> dict[str, float]:
        """Return the state as named numbers: 1 active, and for each alarm `…_unacknowledged`."""
        out = {name: float(state.active) for name, state in self.states.items()}
        out |= {f'{n}_unacknowledged': float(not s.acknowledged) for n, s in self.states.items()}
        out['alarm_active'] = float(any(s.active for s in self.states.values()))
        out['alarm_unacknowledged'] = float(any(not s.acknowledged for s in self.states.values()))
        out['sounding'] = float(self.sounding(now))
        out['stop_flag'] = float(self.stopped)
        return out


def quantities(picture: Picture, now: int, started: bool) -> dict[str, float]:
    """Return what RULES judge, from the picture at `now` (ns); NaN where unknown.

    No attitude is a fault once `started`: aligning takes its time. A roll analysis that has never spoken is
    taken for one that is not installed.
    """
    known = picture.shown_validity(now)[0] != INVALID
    names = ('amplitude_port', 'amplitude_starboard')
    amplitudes = [a for a in (picture.number(name, now) for name in names) if not math.isnan(a)]
    if picture.number('status', now) == NO_ROLL:
        # There are no maxima any more, which is known and not unknown: the alarm must be able to end.
        amplitudes.append(0.0)
    warned = picture.number('synchronous_warning', now) + picture.number('parametric_warning', now)
    missing = not known or (bool(picture.rolling) and not picture.rolling_known(now))
    return {
        'heel': picture.roll if known else math.nan,
        'pitch': picture.pitch if known else math.nan,
        'amplitude': max(amplitudes, default=math.nan) if known else math.nan,
        'resonance': warned if known else math.nan,
        'sensor_fault': float(missing) if started or known else math.nan,
    }
