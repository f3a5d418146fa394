# SPDX-License-Identifier: Apache-2.0
"""Trial of new gains in flight: keep them, or go back, on its own and never silently."""

from __future__ import annotations

import math

from quad_control.params import TrialParams

# Half swings in a row, each fast and large enough, that make an oscillation: three full periods.
_HALF_SWINGS = 6
# Share of saturated samples over this time (s) that ends a trial.
_SATURATION_TIME, _SATURATION_SHARE = 0.5, 0.6


class SwingCounter:
    """Counts half swings of a signal in a row that are both faster and larger than the limits."""

    def __init__(self) -> None:
        self.count = 0
        self._sign = 0.0
        self._peak = 0.0
        self._since = 0.0

    def add(self, value: float, time: float, amplitude: float, half_period: float) -> int:
        """Add a sample at `time` (s); return the count."""
        sign = math.copysign(1.0, value)
        if sign != self._sign:
            counts = self._sign != 0.0 and self._peak > amplitude and time - self._since < half_period
            self.count = self.count + 1 if counts else 0
            self._sign, self._peak, self._since = sign, 0.0, time
        elif time - self._since > half_period:
            self.count = 0
        self._peak = max(self._peak, abs(value))
        return self.count


class Trial:
    """One trial. `watch` returns an empty string while it runs, 'kept', or 'reverted: why'."""

    def __init__(self, params: TrialParams, start: float, before: dict[str, float]) -> None:
        self._p = params
        self._start = start
        self.before = before
        self._swings = (SwingCounter(), SwingCounter(), SwingCounter())
        self._saturated = 0.0

    def watch(self, time: float, dt: float, rate_errors: tuple, angle_errors: tuple, saturated: bool) -> str:
        """Look at one control step: time and dt (s), errors of rates (rad/s) and of roll, pitch (rad)."""
        p = self._p
        if max(abs(angle_errors[0]), abs(angle_errors[1])) > p.trial_error:
            return f'reverted: angle error {max(map(abs, angle_errors)):.2f} rad'
        half = 0.5 / p.trial_frequency
        for axis, (swing, error) in enumerate(zip(self._swings, rate_errors)):
            if swing.add(error, time, p.trial_rate, half) >= _HALF_SWINGS:
                return f'reverted: {("roll", "pitch", "yaw")[axis]} oscillates'
        blend = min(dt / _SATURATION_TIME, 1.0)
        self._saturated += blend * ((1.0 if saturated else 0.0) - self._saturated)
        if self._saturated > _SATURATION_SHARE:
            return 'reverted: the mixer saturates'
        return 'kept' if time - self._start >= p.trial_time else ''
