# SPDX-License-Identifier: Apache-2.0
"""Roll period, amplitudes and peaks after IMO MSC.363(92), from heel.

Heel is the momentary angle. A maximum is the largest heel of a half cycle, a half cycle lies between two
crossings of the mean heel, and the roll period is the time between two successive maxima on the same side.
A maximum is told a fifth of a period after it, or once the mean is crossed by the hysteresis if that is
sooner; the estimate carries that delay. A larger heel in the same half cycle is told anew. The dominant
period of the spectrum stands beside it, never for it.

Angles in rad, roll positive to starboard; amplitudes and peaks are positive heel to their side.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from kalman_core.event_time import NANOSECONDS
from kalman_core.health import Tally
from ship_inclinometer.roll_params import RollParams
from ship_inclinometer.samples import INVALID, Angles, Validity
from ship_inclinometer.topics import ANGLES

ROLLING, NO_ROLL, NOT_VALID = 0, 1, 2
# A gap in the heel (s) after which half a cycle may be missing.
_GAP = 1.0
# Consecutive stamps out of order before the clock is believed to have gone back.
_BACKWARD = 10
# Part of the last period without a larger heel after which a maximum is told: a quarter is where a regular
# roll crosses its mean, and the next period may be the shorter one.
_TOLD_AFTER = 0.2
# Half the window that smooths a half cycle, as a share of it: wide against noise, narrow against two tops.
_SMOOTHED_OVER = 0.1
# The spectrum is taken of heel at this rate (Hz) and anew after this time (s).
_SPECTRUM_RATE, _SPECTRUM_EVERY = 2.0, 10.0
# Growth of the amplitude over the last three maxima of a side that tells parametric roll from forced roll.
_GROWTH = 1.3


class RollState(NamedTuple):
    """What the inclinometer shows; NaN where not known."""

    stamp: int
    status: int
    heel: float
    period: float
    amplitude_port: float
    amplitude_starboard: float
    peak_port: float
    peak_starboard: float
    peak_reset: int
    delay: float
    mean_heel: float
    spectral_period: float
    synchronous: bool
    parametric: bool


class RollCycle(NamedTuple):
    """One maximum: when, to which side (+1 starboard), how far, and the period that it ends."""

    stamp: int
    time: float
    side: int
    heel: float
    period: float
    delay: float


class RollAnalysis:
    """Streaming analysis of heel; `cycles` keeps the last maxima."""

    def __init__(self, params: RollParams | None = None) -> None:
        self.params = params if params is not None else RollParams()
        self.tally = Tally()
        self.cycles: deque[RollCycle] = deque(maxlen=1000)
        self.reset()

    def set_params(self, params: RollParams) -> None:
        """Take new live parameters."""
        self.params = params

    def reset(self) -> None:
        """Forget all but the parameters."""
        self._peaks = [0.0, 0.0]
        self._peak_reset = 0
        self._stamp: int | None = None
        self._behind = 0
        self._source_valid = True
        self._restart()

    def _restart(self) -> None:
        self.cycles.clear()
        self._origin = self._stamp
        self._half: list[tuple[float, float]] = []
        self._side = 0
        self._mean = 0.0
        self._weight = 0.0
        self._midpoints: deque[float] = deque(maxlen=6)
        # Of each side the newest maximum, and that of the half cycle before the present one.
        self._last: dict[int, RollCycle] = {}
        self._before: dict[int, RollCycle | None] = {}
        self._last_period = self.params.longest_period
        self._top = (0.0, -math.inf)
        self._told = -math.inf
        self._next_output = 0
        size = round(self.params.spectrum_time * _SPECTRUM_RATE)
        self._slow: deque[tuple[float, float]] = deque(maxlen=size)
        self._spectral = self._pitch_period = math.nan
        self._next_slow = self._next_spectrum = 0.0
        self._previous_slow, self._previous_time = (0.0, 0.0), 0.0

    def reset_peaks(self, stamp: int) -> None:
        """Start the peak hold anew at `stamp` (ns)."""
        self._peaks = [0.0, 0.0]
        self._peak_reset = stamp

    def on_validity(self, sample: Validity) -> None:
        """Take the attitude's validity; an invalid heel is not analysed."""
        self._source_valid = sample.validity != INVALID

    def on_angles(self, sample: Angles) -> list[Any]:
        """Use one heel; return the state at the output rate and each maximum once it is known."""
        heel, pitch = sample.angles[0], sample.angles[1]
        if not abs(heel) <= math.pi or not abs(pitch) <= math.pi:
            self.tally.reject(ANGLES, 'angle out of range')
            return []
        if not self._in_order(sample.stamp):
            return []
        assert self._origin is not None
        t = (sample.stamp - self._origin) / NANOSECONDS
        if not self._peak_reset:
            self._peak_reset = sample.stamp
        self.tally.accept(ANGLES, sample.stamp)
        self._peaks = [max(self._peaks[0], -heel), max(self._peaks[1], heel)]
        self._follow_spectrum(t, heel, pitch)
        cycle = self._follow_cycle(sample.stamp, t, heel)
        out: list[Any] = []
        if cycle is not None:
            self.cycles.append(cycle)
            out.append(cycle)
        period = round(NANOSECONDS / self.params.output_rate)
        if not self._next_output - period <= sample.stamp < self._next_output:
            self._next_output = (sample.stamp // period + 1) * period
            out.append(self._state(sample.stamp, t, heel))
        return out

    def _in_order(self, stamp: int) -> bool:
        last = self._stamp
        if last is not None and stamp <= last:
            self.tally.reject(ANGLES, 'stamp not newer')
            self._behind += 1
            if self._behind < _BACKWARD:
                return False
            self.tally.restart(f'time went back by {(last - stamp) / NANOSECONDS:.3f} s')
            self._stamp = stamp
            self._restart()
        elif last is None or stamp - last > _GAP * NANOSECONDS:
            if last is not None:
                self.tally.restart(f'no heel for {(stamp - last) / NANOSECONDS:.1f} s')
            self._stamp = stamp
            self._restart()
        self._behind = 0
        self._stamp = stamp
        return True

    def _follow_cycle(self, stamp: int, t: float, heel: float) -> RollCycle | None:
        mean = self._follow_mean(t, heel)
        self._half.append((t, heel))
        side = 1 if heel > mean else -1
        if self._side == 0:
            self._side = side
        if len(self._half) > 2 and t - self._half[0][0] > self.params.longest_period:
            # Half a cycle never lasts a whole longest period: the ship lies still, or on another list, of
            # which the maxima so far know nothing.
            self._midpoints.clear()
            del self._half[: len(self._half) // 2]
        reach = heel * self._side
        if reach > self._top[1]:
            self._top = (t, reach)
        crossed = side != self._side and abs(heel - mean) >= math.radians(self.params.hysteresis)
        if crossed:
            return self._close_half(stamp, t, mean)
        if self._last.get(self._side) is None or self._top[1] <= self._told:
            return None
        before = self._before.get(self._side)
        # A cycle that turns out shorter than the last one is told sooner.
        so_far = self._top[0] - before.time if before is not None else math.inf
        if t - self._top[0] < _TOLD_AFTER * min(self._last_period, so_far):
            return None
        return self._maximum(stamp, t, mean, len(self._half))

    def _follow_mean(self, t: float, heel: float) -> float:
        """Return the mean heel: of the last extrema, which bear no ripple, or of time before there are."""
        self._weight += 1.0
        steps = max(self._weight, 1.0)
        rate = steps / max(t, 1e-3) if t > 0.0 else 1.0
        self._mean += (heel - self._mean) / min(steps, max(self.params.list_time * rate, 1.0))
        if len(self._midpoints) >= 2:
            return float(np.mean(self._midpoints))
        return self._mean

    def _close_half(self, stamp: int, t: float, mean: float) -> RollCycle | None:
        finished = self._side
        # The half that begins now holds what came after the crossing.
        keep = len(self._half)
        while keep > 1 and (self._half[keep - 1][1] - mean) * finished <= 0.0:
            keep -= 1
        cycle = self._maximum(stamp, t, mean, keep) if self._top[1] > self._told else None
        latest = self._last.get(finished)
        opposite = self._last.get(-finished)
        if latest is not None and opposite is not None and self._told > -math.inf:
            self._midpoints.append(0.5 * (latest.heel + opposite.heel))
        self._before[finished] = self._last.get(finished)
        del self._half[:keep]
        self._side = -finished
        self._told = -math.inf
        self._top = max(
            ((w, -h * finished) for w, h in self._half), key=lambda p: p[1], default=(t, -math.inf)
        )
        return cycle

    def _maximum(self, stamp: int, t: float, mean: float, count: int) -> RollCycle | None:
        """Return the maximum of the first `count` samples of this half cycle, None when it is no roll."""
        times, heels = np.array(self._half[:count]).T
        if np.argmax(heels * self._side) in (0, count - 1):
            # The half was cut by a mean that moved: its largest heel is no maximum.
            return None
        when, value = vertex(times, heels * self._side)
        value *= self._side
        self._told = self._top[1]
        if (value - mean) * self._side < math.radians(self.params.no_roll):
            return None
        previous = self._before.get(self._side)
        period = math.nan
        if previous is not None and when - previous.time <= self.params.longest_period:
            period = self._last_period = when - previous.time
        cycle = RollCycle(stamp, when, self._side, value, period, t - when)
        self._last[self._side] = cycle
        return cycle

    def _follow_spectrum(self, t: float, heel: float, pitch: float) -> None:
        before, earlier = self._previous_slow, self._previous_time
        self._previous_slow, self._previous_time = (heel, pitch), t
        while self._next_slow <= t:
            # On an even grid, whatever the rate of the input.
            share = (self._next_slow - earlier) / (t - earlier) if t > earlier else 1.0
            now = (heel, pitch)
            self._slow.append(
                (now[0] * share + before[0] * (1.0 - share), now[1] * share + before[1] * (1.0 - share))
            )
            self._next_slow += 1.0 / _SPECTRUM_RATE
        if t < self._next_spectrum or len(self._slow) < 60 * _SPECTRUM_RATE:
            return
        self._next_spectrum = t + _SPECTRUM_EVERY
        record = np.array(self._slow)
        threshold = math.radians(self.params.no_roll)
        self._spectral = dominant_period(record[:, 0], _SPECTRUM_RATE, threshold)
        self._pitch_period = dominant_period(record[:, 1], _SPECTRUM_RATE, 0.2 * threshold)

    def _state(self, stamp: int, t: float, heel: float) -> RollState:
        newest = max(self._last.values(), key=lambda c: c.time, default=None)
        rolling = newest is not None and t - newest.time <= self.params.longest_period
        status = ROLLING if rolling else NO_ROLL
        if not self._source_valid:
            status = NOT_VALID
        port, starboard = self._amplitude(-1, t), self._amplitude(1, t)
        synchronous, parametric = self._resonances() if status == ROLLING else (False, False)
        return RollState(
            stamp,
            status,
            heel,
            newest.period if newest is not None and status == ROLLING else math.nan,
            port if rolling else math.nan,
            starboard if rolling else math.nan,
            self._peaks[0],
            self._peaks[1],
            self._peak_reset,
            t - newest.time if newest is not None and rolling else math.nan,
            float(np.mean(self._midpoints)) if len(self._midpoints) >= 2 else self._mean,
            self._spectral,
            synchronous,
            parametric,
        )

    def _amplitude(self, side: int, t: float) -> float:
        """Return the last maximum to `side`, NaN when it is not of the present rolling any more."""
        last = self._last.get(side)
        if last is None or t - last.time > self.params.longest_period:
            return math.nan
        return max(side * last.heel, 0.0)

    def _resonances(self) -> tuple[bool, bool]:
        """Return warnings of synchronous and of parametric roll (MSC.1/Circ.1228, section 2).

        Synchronous: waves (seen by pitch) at the ship's natural roll period. Parametric: waves at half the
        roll period while the roll grows.
        """
        mean = float(np.mean(self._midpoints)) if self._midpoints else self._mean
        # The first maxima of a start may be cut off.
        recent = [c for c in list(self.cycles)[-6:] if c.period > 0.0]
        if len(recent) < 4 or not self._spectral > 0.0 or not self._pitch_period > 0.0:
            return False, False
        amplitudes = [abs(c.heel - mean) for c in recent]
        if max(amplitudes[-2:]) < math.radians(self.params.warning_amplitude):
            return False, False
        near = self.params.period_tolerance
        natural = self.params.natural_period
        synchronous = (
            natural > 0.0
            and abs(self._pitch_period / natural - 1.0) < near
            and abs(self._spectral / natural - 1.0) < near
        )
        growing = max(amplitudes[-2:]) > _GROWTH * max(amplitudes[:2])
        parametric = abs(2.0 * self._pitch_period / self._spectral - 1.0) < near and growing
        return synchronous, parametric

    def diagnostics(self) -> dict[str, Any]:
        """Return the number of maxima and the mean heel."""
        return {'maxima': len(self.cycles), 'mean_heel_deg': math.degrees(self._mean)}


def vertex(times: np.ndarray, heels: np.ndarray) -> tuple[float, float]:
    """Return time and value of the largest of `heels` (N,) at `times` (N,) [s], by a fitted parabola.

    Of two tops in one half cycle noise must not choose: the largest is that of the heel smoothed by a local
    parabola. The final parabola takes a quarter of the half cycle to both sides, and is fitted twice: the
    largest sample may lie beside the top.
    """
    peak = int(np.argmax(_smoothed(heels)))
    when, value = float(times[peak]), float(heels[peak])
    width = max(0.25 * (times[-1] - times[0]), 2.1 * (times[-1] - times[0]) / max(len(times) - 1, 1))
    for _ in range(2):
        near = np.abs(times - when) <= width
        if np.count_nonzero(near) < 3:
            break
        x = times[near] - when
        curve, slope, level = np.polyfit(x, heels[near], 2)
        if curve >= 0.0 or abs(slope / (2.0 * curve)) > width:
            break
        shift = -slope / (2.0 * curve)
        when, value = when + shift, level + 0.5 * slope * shift
        when = min(max(when, float(times[0])), float(times[-1]))
    return when, value


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Return (N,) values by local parabolas over a fifth of them, ends held (Savitzky and Golay, 1964)."""
    half = round(_SMOOTHED_OVER * len(values))
    if half < 1:
        return values
    weights = np.linalg.pinv(np.vander(np.arange(-half, half + 1.0), 3))[2]
    return np.convolve(np.pad(values, half, mode='edge'), weights[::-1], 'valid')


def dominant_period(record: np.ndarray, rate: float, threshold: float) -> float:
    """Return the period [s] of the spectrum's peak, NaN if the record's amplitude is under `threshold`.

    Averaged over half-overlapping segments (Welch), peak refined by a parabola over three lines.
    """
    record = record - np.mean(record)
    if math.sqrt(2.0) * float(np.std(record)) < threshold:
        return math.nan
    length = min(len(record), round(120.0 * rate))
    window = np.hanning(length)
    starts = range(0, len(record) - length + 1, max(length // 2, 1))
    power = np.mean([np.abs(np.fft.rfft(window * record[s : s + length])) ** 2 for s in starts], axis=0)
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    allowed = (frequency > 0.02) & (frequency < 0.5)
    peak = int(np.argmax(np.where(allowed, power, 0.0)))
    left, top, right = np.log(power[peak - 1 : peak + 2] + 1e-30)
    shift = 0.5 * (left - right) / (left - 2.0 * top + right)
    return float(1.0 / (frequency[peak] + shift * (frequency[1] - frequency[0])))
