# SPDX-License-Identifier: Apache-2.0
"""Per-sensor book-keeping that diagnostics report: accepted, rejected with reason, NIS."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

# Smoothing of the reported mean NIS: a window of about 50 updates.
_NIS_WEIGHT = 0.02
# Bound of the list of restarts, for a clock that flaps for days.
_RESTARTS_KEPT = 1000


@dataclass(slots=True)
class SensorTally:
    """Counts of one sensor since start (or the last reset of the node)."""

    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    nis: float | None = None
    gate: float | None = None
    last_stamp: int | None = None


class Tally:
    """Counts what an estimator did with its samples, by sensor name.

    While `muted` (an event-time buffer re-applies samples) nothing is counted twice.
    """

    def __init__(self) -> None:
        self.sensors: dict[str, SensorTally] = {}
        self.restarts: list[str] = []
        self.restart_count = 0
        self.muted = False

    def sensor(self, name: str) -> SensorTally:
        """Return the counts of sensor `name`, made on first use."""
        entry = self.sensors.get(name)
        if entry is None:
            entry = self.sensors[name] = SensorTally()
        return entry

    def accept(self, name: str, stamp: int, nis: float | None = None, gate: float | None = None) -> None:
        """Count a used sample; `nis` is its normalised innovation squared, `gate` its limit."""
        if self.muted:
            return
        entry = self.sensor(name)
        entry.accepted += 1
        entry.last_stamp = stamp
        if nis is not None and math.isfinite(nis):
            entry.nis = nis if entry.nis is None else entry.nis + _NIS_WEIGHT * (nis - entry.nis)
            entry.gate = gate

    def reject(self, name: str, reason: str) -> None:
        """Count a sample that was not used, with its reason."""
        if not self.muted:
            self.sensor(name).rejected[reason] += 1

    def withdraw(self, name: str, reason: str) -> None:
        """Take back one `reject`: the sample is used after all."""
        rejected = self.sensor(name).rejected
        if rejected[reason] > 1:
            rejected[reason] -= 1
        else:
            del rejected[reason]

    def restart(self, reason: str) -> None:
        """Record that the estimator started anew by itself, and why.

        After 1000 the latest reason replaces the one before it; `restart_count` goes on.
        """
        self.restart_count += 1
        if len(self.restarts) < _RESTARTS_KEPT:
            self.restarts.append(reason)
        else:
            self.restarts[-1] = reason
