# SPDX-License-Identifier: Apache-2.0
"""Alarms with hysteresis, delay, acknowledgement, latching and silence. Pure: time comes in with each call.

States after IEC 62923-1 (bridge alert management), section 6: an alert is active or not, acknowledged or
not; a latched one stays until it is acknowledged. Warnings need no latch but are handled alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from kalman_core.event_time import NANOSECONDS


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
    Rule('sensor_alarm', 'sensor_fault', None, 'no valid attitude'),
)


@dataclass(slots=True)
class AlarmState:
    """Where one alarm stands; `since` is when its condition began (ns), `raised` when it became active."""

    active: bool = False
    acknowledged: bool = True
    since: int = 0
    raised: int = 0

    @property
    def shown(self) -> bool:
        """Whether it stands on the list: active, or over but not acknowledged."""
        return self.active or not self.acknowledged


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """Something to be logged: `kind` is 'alarm', 'end' or 'acknowledge'."""

    stamp: int
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
        self._silent_until = 0

    def update(self, stamp: int, quantities: Mapping[str, float]) -> list[AlarmEvent]:
        """Judge at `stamp` (ns) and return what has changed.

        An unknown quantity neither raises nor ends its alarm; nothing does while `stopped`.
        """
        events: list[AlarmEvent] = []
        if self.stopped:
            return events
        for rule in RULES:
            value = abs(quantities.get(rule.quantity, math.nan))
            if not math.isnan(value):
                event = self._judge(rule, stamp, value)
                if event is not None:
                    events.append(event)
        return events

    def _judge(self, rule: Rule, stamp: int, value: float) -> AlarmEvent | None:
        state = self.states[rule.name]
        threshold = self.settings[rule.threshold] if rule.threshold else 0.5
        hysteresis = self.settings['hysteresis'] if rule.threshold else 0.0
        if not state.active:
            if value <= threshold:
                state.since = 0
                return None
            state.since = state.since or stamp
            if stamp - state.since < self.settings['alarm_delay'] * NANOSECONDS:
                return None
            state.active, state.acknowledged, state.raised = True, False, stamp
            self._silent_until = 0
            return AlarmEvent(stamp, 'alarm', rule.name, f'{rule.text}: {value:.1f}')
        if value > threshold - hysteresis:
            return None
        state.active, state.since = False, 0
        if not self.latching:
            state.acknowledged = True
        return AlarmEvent(stamp, 'end', rule.name, f'{rule.text}: ended at {value:.1f}')

    def acknowledge(self, stamp: int, name: str = '') -> list[AlarmEvent]:
        """Acknowledge the alarm `name`, or all."""
        events = []
        for key, state in self.states.items():
            if not state.acknowledged and name in ('', key):
                state.acknowledged = True
                events.append(AlarmEvent(stamp, 'acknowledge', key, 'acknowledged'))
        return events

    def silence(self, stamp: int) -> None:
        """Silence the sound for the set time; a new alarm breaks it."""
        self._silent_until = stamp + round(self.settings['silence_time'] * NANOSECONDS)

    def sounding(self, stamp: int) -> bool:
        """Return whether the buzzer should sound at `stamp`."""
        if self.stopped or stamp < self._silent_until:
            return False
        return any(not s.acknowledged for s in self.states.values())

    def numbers(self, stamp: int) -> dict[str, float]:
        """Return the state as named numbers: 1 active, and for each alarm `…_unacknowledged`."""
        out = {name: float(state.active) for name, state in self.states.items()}
        out |= {f'{n}_unacknowledged': float(not s.acknowledged) for n, s in self.states.items()}
        out['alarm_active'] = float(any(s.active for s in self.states.values()))
        out['alarm_unacknowledged'] = float(any(not s.acknowledged for s in self.states.values()))
        out['sounding'] = float(self.sounding(stamp))
        out['stop_flag'] = float(self.stopped)
        return out
