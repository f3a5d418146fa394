# SPDX-License-Identifier: Apache-2.0
"""Alerts to a bridge alert management: ALF and ALC out, ACN in, ARC for what is refused. Pure text.

Sentences after IEC 61162-1 edition 5, states after IEC 62923-1: V active, S active and silenced, A active and
acknowledged, U over but not acknowledged, N normal. Identifiers from 10000 on are the manufacturer's own.
HBT is not sent: the cyclic list tells that this end lives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

from ship_inclinometer.alarms import RULES
from ship_inclinometer.nmea import checksum, sentence

_FIRST_IDENTIFIER = 10001
_TEXTS = {
    'heel_warning': 'HEEL WARNING',
    'heel_alarm': 'HEEL ALARM',
    'roll_alarm': 'ROLL AMPLITUDE',
    'pitch_alarm': 'TRIM ALARM',
    'resonance_warning': 'ROLL RESONANCE',
    'sensor_alarm': 'NO ATTITUDE/ROLL',
}
_LOST = 'monitor_lost'
# The list of alerts is repeated this often (s); two of its longest entries fit 82 characters.
_LIST_EVERY = 30.0
_ENTRIES = 2
_SECOND = 10**9


class Command(NamedTuple):
    """What a bridge alert management asks for; `alarm` by its name here."""

    name: str
    alarm: str


@dataclass(slots=True)
class _Alert:
    identifier: int
    priority: str
    text: str
    state: str = 'N'
    changed: int = 0
    instance: int = 0
    revision: int = 0


class AlertReporter:
    """Turns the numbers of ship/alarms into sentences, and ACN into commands.

    `manufacturer` is the mnemonic code of three capitals that NMEA registers.
    """

    def __init__(self, talker: str, manufacturer: str) -> None:
        self._talker = talker
        self._manufacturer = manufacturer
        self._alerts = {
            rule.name: _Alert(
                _FIRST_IDENTIFIER + i, 'W' if 'warning' in rule.name else 'A', _TEXTS[rule.name]
            )
            for i, rule in enumerate(RULES)
        }
        # Not of the monitor's making: that it is silent, and whether the bridge has acknowledged that.
        self._alerts[_LOST] = _Alert(_FIRST_IDENTIFIER + len(RULES), 'A', 'ALARMS LOST')
        self._lost_known = False
        self._message = 0
        self._list = 0
        self._next_list = 0

    def sentences(self, now: int, alarms: Mapping[str, float] | None) -> list[str]:
        """Return ALF for each alert that has changed at `now` (ns), and ALC after a change or in its turn.

        Nothing in `alarms`: none were told yet. None: the monitor is silent, which is an alert itself; what
        stood then goes on standing, since nobody knows of an end.
        """
        out = []
        for name, alert in self._alerts.items():
            state = self._state(name, alarms)
            if state != alert.state:
                if alert.state == 'N':
                    alert.instance = alert.instance % 999999 + 1
                    alert.revision = 0
                alert.state, alert.changed, alert.revision = state, now, alert.revision % 99 + 1
                out.append(self._alf(alert))
        if out or not self._next_list - _LIST_EVERY * _SECOND <= now < self._next_list:
            self._next_list = now + round(_LIST_EVERY * _SECOND)
            out += self._alc()
        return out

    def _state(self, name: str, alarms: Mapping[str, float] | None) -> str:
        if name != _LOST:
            return _state(name, alarms) if alarms else self._alerts[name].state
        if alarms is not None:
            self._lost_known = False
            return 'N'
        return 'A' if self._lost_known else 'V'

    def _alf(self, alert: _Alert) -> str:
        self._message = (self._message + 1) % 10
        head = ('1', '1', str(self._message), _time(alert.changed), 'B', alert.priority, alert.state)
        return sentence(self._talker, 'ALF', *head, *self._entry(alert), '0', alert.text)

    def _alc(self) -> list[str]:
        self._list = (self._list + 1) % 100
        standing = [alert for alert in self._alerts.values() if alert.state != 'N']
        groups = [standing[i : i + _ENTRIES] for i in range(0, len(standing), _ENTRIES)] or [[]]
        out = []
        for number, group in enumerate(groups, 1):
            entries = [field for alert in group for field in self._entry(alert)]
            head = (f'{len(groups):02d}', f'{number:02d}', f'{self._list:02d}', str(len(group)))
            out.append(sentence(self._talker, 'ALC', *head, *entries))
        return out

    def _entry(self, alert: _Alert) -> tuple[str, str, str, str]:
        return self._manufacturer, str(alert.identifier), str(alert.instance), str(alert.revision)

    def take(self, line: str, now: int) -> tuple[Command | None, list[str]]:
        """Return the command of an ACN sentence for an alert here, if it is one, and the answers."""
        fields = _fields(line)
        if fields is None or len(fields) != 7 or fields[0][2:] != 'ACN' or fields[6] != 'C':
            return None, []
        _, _, manufacturer, identifier, instance, command, _ = fields
        found = [(n, a) for n, a in self._alerts.items() if str(a.identifier) == identifier]
        if manufacturer != self._manufacturer or not found:
            return None, []
        name, alert = found[0]
        if instance in ('', str(alert.instance)):
            if command == 'Q':
                return None, [self._alf(alert)]
            if name == _LOST:
                if command == 'A' and alert.state == 'V':
                    self._lost_known = True
                    return None, []
            elif self._alerts[_LOST].state == 'N':
                if command == 'A' and alert.state in 'VSU':
                    return Command('acknowledge', name), []
                if command == 'S' and alert.state == 'V':
                    return Command('silence', name), []
        # Responsibility is not handed over, what is over or known already is not acknowledged again, and
        # without the monitor there is nobody to carry anything out.
        refused = (_time(now), self._manufacturer, identifier, instance, command)
        return None, [sentence(self._talker, 'ARC', *refused)]


def _state(name: str, alarms: Mapping[str, float]) -> str:
    unacknowledged = bool(alarms.get(f'{name}_unacknowledged'))
    if not alarms.get(name):
        return 'U' if unacknowledged else 'N'
    if not unacknowledged:
        return 'A'
    return 'V' if alarms.get('sounding') else 'S'


def _time(stamp: int) -> str:
    moment = datetime.fromtimestamp(stamp // _SECOND, UTC)
    return f'{moment:%H%M%S}.{stamp % _SECOND // 10**7:02d}'


def _fields(line: str) -> list[str] | None:
    """Return the fields of a sentence with the right checksum, address first; None for anything else."""
    body, star, given = line.strip().partition('*')
    if not star or not body.startswith('$') or not body.isascii() or checksum(body[1:]) != given.upper():
        return None
    return body[1:].split(',')
