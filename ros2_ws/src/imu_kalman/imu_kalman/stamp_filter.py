# SPDX-License-Identifier: Apache-2.0
"""When samples were taken, though only the times of reading them are known.

A chip samples by its own clock, which is off by up to some per cent; the computer looks now and then and
learns how many samples have come, and that the newest was taken between two times. A two-state Kalman filter
(time of the newest sample, sample period) makes evenly spaced stamps of that.
"""

from __future__ import annotations

import math

import numpy as np

# The datasheet allows the chip's clock 1 % (gyro oscillator) to 5 % (RC oscillator); 1 sigma of the start.
_PERIOD_SIGMA = 0.02
# Random walk of the relative period per √sample: the oscillator follows temperature, some 1e-4 in a minute.
_PERIOD_WALK = 1e-6
# An innovation beyond this many sigma, and beyond half an interval, is a stepped clock or lost samples.
_GATE = 6.0
# Stamps may be ahead of the clock by some periods, while they are kept from going back.
_LEAD = 10.0
# Scheduling of the computer: times of reading are this uncertain beside the interval (s).
_JITTER = 50e-6


class StampFilter:
    """Turns "n more samples, the newest between `earliest` and `latest`" into stamps.

    Times are integer ns. `restarts` counts how often the clock and the count did not fit together.
    """

    def __init__(self, period: float) -> None:
        """`period`: nominal, s."""
        self._nominal = period
        self.restarts = -1
        self._last: int | None = None
        self._restart()

    def _restart(self) -> None:
        self.restarts += 1
        self._newest: int | None = None
        self.period = self._nominal
        self._cov = np.zeros((2, 2))

    def reset(self) -> None:
        """Forget the phase: samples were lost. The period stays known."""
        self._newest = None

    @property
    def sigma(self) -> float:
        """1 sigma of the newest stamp (s)."""
        return math.sqrt(self._cov[0, 0])

    def update(self, count: int, earliest: int, latest: int, wanted: int | None = None) -> list[int]:
        """Return the stamps of the `wanted` newest of `count` samples, oldest first, strictly increasing.

        `count` is how many the chip has taken since the last call, read or not; `wanted` None means all.
        """
        width = (latest - earliest) * 1e-9
        middle = (earliest + latest) // 2
        variance = width * width / 12.0 + _JITTER**2
        if self._newest is not None:
            fits = self._correct(count, middle, width, variance)
        else:
            # Samples may have been lost, but the clock never goes back by itself.
            fits = self._last is None or latest > self._last - round(_LEAD * self.period * 1e9)
        if not fits:
            self._restart()
            self._last = None
        if self._newest is None:
            self._newest = middle
            if self._cov[1, 1] == 0.0:
                self._cov[1, 1] = (_PERIOD_SIGMA * self._nominal) ** 2
            self._cov[0, 0] = variance
            self._cov[0, 1] = self._cov[1, 0] = 0.0
        # What is certain: the newest sample was there when it was counted.
        self._newest = min(self._newest, latest)
        return self._spread(count, count if wanted is None else wanted)

    def _correct(self, count: int, middle: int, width: float, variance: float) -> bool:
        """Predict over `count` samples and correct; False when the time does not fit."""
        assert self._newest is not None
        predicted = self._newest + round(count * self.period * 1e9)
        p = self._cov
        walk = (_PERIOD_WALK * self._nominal) ** 2 * count
        p00 = p[0, 0] + count * (2.0 * p[0, 1] + count * p[1, 1])
        p01 = p[0, 1] + count * p[1, 1]
        p11 = p[1, 1] + walk
        innovation = (middle - predicted) * 1e-9
        total = p00 + variance
        if abs(innovation) > 0.5 * width + _GATE * math.sqrt(total):
            return False
        gain0, gain1 = p00 / total, p01 / total
        self._newest = predicted + round(gain0 * innovation * 1e9)
        self.period += gain1 * innovation
        p[0, 0] = (1.0 - gain0) * p00
        p[0, 1] = p[1, 0] = (1.0 - gain0) * p01
        p[1, 1] = p11 - gain1 * p01
        return True

    def _spread(self, count: int, wanted: int) -> list[int]:
        assert self._newest is not None
        newest, last = self._newest, self._last
        step = self.period * 1e9
        if last is not None:
            # The correction is spread over the samples since the last stamp, and stamps never go back.
            newest = max(newest, last + count * max(1, round(0.25 * step)))
            gap = newest - last
            if gap < 1.5 * count * step:
                step = gap / count
        self._last = newest
        return [newest - round(age * step) for age in range(wanted - 1, -1, -1)]
