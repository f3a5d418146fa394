# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a node: per sensor rate, age, NIS, accepted and rejected with reason; processing time.

WARN: samples were rejected since the last report, or an optional input that was a stream is absent for 5 s.
ERROR: a required input is stale (older than its timeout) or never came.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from kalman_core.health import Tally
from node_core.ports import Input

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)
# Processing times kept for the percentile: two seconds at 500 Hz.
_TIMINGS = 1000
# An input without a timeout is absent after this time (s): GNSS, the slowest stream, comes once a second.
_ABSENT = 5.0
# What had news in this many reports in a row is a stream; a latched or rare message is not.
_STREAM = 10


@dataclass(slots=True)
class InputState:
    """Arrival of one input, by the steady clock (ns)."""

    port: Input
    count: int = 0
    arrived: int = 0
    reported_count: int = 0
    reported_rejected: Counter[str] = field(default_factory=Counter)
    reports_in_a_row: int = 0


class Timings:
    """Ring of the last processing times (ns)."""

    def __init__(self) -> None:
        self._ring = [0] * _TIMINGS
        self._count = 0

    def add(self, nanoseconds: int) -> None:
        """Record one processing time."""
        self._ring[self._count % _TIMINGS] = nanoseconds
        self._count += 1

    def percentile(self, percent: float) -> float:
        """Return a percentile (s) of the recent processing times, NaN before the first."""
        recent = self._ring[: min(self._count, _TIMINGS)]
        return float(np.percentile(recent, percent)) * 1e-9 if recent else float('nan')


def status(name: str, level: bytes, message: str, values: Mapping[str, Any]) -> DiagnosticStatus:
    """Return a DiagnosticStatus; floats are printed with six significant digits."""
    pairs = [
        KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
        for key, value in values.items()
    ]
    return DiagnosticStatus(name=name, level=level, message=message, hardware_id='', values=pairs)


class Reporter:
    """Builds the diagnostic array of one estimator node once a second."""

    def __init__(self, node_name: str, inputs: dict[str, InputState], tally: Tally) -> None:
        self._name = node_name
        self._inputs = inputs
        self._tally = tally
        self._last = time.monotonic_ns()
        self.timings = Timings()

    def _input_status(self, state: InputState, now: int, elapsed: float) -> DiagnosticStatus:
        port = state.port
        sensor = self._tally.sensor(port.topic)
        # What was withdrawn since (a late sample that fits after all) leaves a count smaller: none is new.
        fresh = sensor.rejected - state.reported_rejected
        rate = (state.count - state.reported_count) / elapsed
        if state.reports_in_a_row < _STREAM:
            state.reports_in_a_row = state.reports_in_a_row + 1 if rate > 0.0 else 0
        state.reported_count, state.reported_rejected = state.count, sensor.rejected.copy()
        age = (now - state.arrived) * 1e-9 if state.count else float('inf')
        values: dict[str, Any] = {
            'rate_hz': rate,
            'age_s': age,
            'received': state.count,
            'accepted': sensor.accepted,
            'rejected': sensor.rejected.total(),
        }
        if sensor.nis is not None:
            values['nis'] = sensor.nis
        if sensor.gate is not None:
            values['gate'] = sensor.gate
        values |= {f'rejected: {reason}': count for reason, count in sorted(sensor.rejected.items())}
        level, text = OK, 'ok'
        if port.timeout and age > port.timeout:
            level, text = ERROR, f'stale: no message for {age:.1f} s' if state.count else 'no message yet'
        elif not port.timeout and state.reports_in_a_row == _STREAM and age > _ABSENT:
            level, text = WARN, f'absent: no message for {age:.1f} s'
        elif fresh:
            level, text = WARN, f'{fresh.total()} rejected, mostly: {fresh.most_common(1)[0][0]}'
        return status(f'{self._name}: {port.topic}', level, text, values)

    def report(self, extra: Mapping[str, Any]) -> DiagnosticArray:
        """Return the array; `extra` are the estimator's own values, 'level' and 'message' among them."""
        now = time.monotonic_ns()
        elapsed = max((now - self._last) * 1e-9, 1e-3)
        self._last = now
        sensors = [self._input_status(state, now, elapsed) for state in self._inputs.values()]
        values = dict(extra)
        level = values.pop('level', OK)
        text = values.pop('message', 'ok')
        worst = max(sensors, key=lambda s: s.level, default=None)
        if worst is not None and worst.level > level:
            level, text = worst.level, f'{worst.name.split(": ")[1]}: {worst.message}'
        values |= {
            'processing_p50_s': self.timings.percentile(50.0),
            'processing_p99_s': self.timings.percentile(99.0),
            'restarts': self._tally.restart_count,
        }
        if self._tally.restarts:
            values['last_restart'] = self._tally.restarts[-1]
        return DiagnosticArray(status=[status(self._name, level, text, values), *sensors])
