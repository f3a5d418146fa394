# SPDX-License-Identifier: Apache-2.0
"""Roll periods against the standard's definition on the noiseless heel."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ship_inclinometer.roll_analysis import RollAnalysis, RollCycle
from ship_inclinometer.samples import Angles
from ship_inclinometer.sea import sea_motion
from ship_inclinometer.simulation_params import scenario

RATE = 5.0
SEAS = ((9.0, 12.0), (12.0, 12.0), (5.0, 5.0), (15.0, 28.0), (7.0, 20.0))


def heel_of_sea(peak_period: float, natural_period: float, seed: int, duration: float = 720.0):
    """Return times (N,) [s] at 5 Hz and the noiseless heel (N,) [deg] on a list of 2°."""
    params = scenario(
        'beam',
        rate=RATE,
        duration=duration,
        peak_period=peak_period,
        roll_period=natural_period,
        largest_roll=10.0,
        list_angle=2.0,
        engine_frequencies=(0.0, 0.0),
    )
    t = np.arange(round(duration * RATE)) / RATE
    return t, np.degrees(sea_motion(params, t, np.random.default_rng(seed)).angles[:, 0])


def observed(heel: np.ndarray, seed: int) -> np.ndarray:
    """Return `heel` [deg] with 0.3° slow (60 s) and 0.1° white error."""
    rng = np.random.default_rng(1000 + seed)
    decay = math.exp(-1.0 / (RATE * 60.0))
    drive = 0.3 * math.sqrt(1.0 - decay**2) * rng.standard_normal(len(heel))
    slow = np.empty(len(heel))
    value = 0.3 * rng.standard_normal()
    for i, step in enumerate(drive):
        value = decay * value + step
        slow[i] = value
    return heel + slow + 0.1 * rng.standard_normal(len(heel))


def true_maxima(t: np.ndarray, heel: np.ndarray, mean: float) -> list[tuple[float, int, float]]:
    """Return (time, side, amplitude about the mean) of the maxima on each side, by cubic interpolation."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(t, heel - mean)
    crossings = np.concatenate([[t[0]], spline.roots(extrapolate=False), [t[-1]]])
    turning = spline.derivative().roots(extrapolate=False)
    maxima = []
    for begin, end in itertools.pairwise(crossings[1:-1]):
        inside = turning[(turning > begin) & (turning < end)]
        if len(inside):
            values = spline(inside)
            best = int(np.argmax(np.abs(values)))
            maxima.append((float(inside[best]), int(np.sign(values[best])), float(abs(values[best]))))
    return maxima


def analyse(t: np.ndarray, heel: np.ndarray) -> list[RollCycle]:
    """Return the maxima that the streaming analysis finds in `heel` [deg]."""
    analysis = RollAnalysis()
    cycles = []
    for time, angle in zip(t.tolist(), np.radians(heel).tolist()):
        stamp = 10**18 + round(time * 1e9)
        sample = Angles(stamp, '', (angle, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0)
        cycles += [e for e in analysis.on_angles(sample) if isinstance(e, RollCycle)]
    return cycles


class SeaScore(NamedTuple):
    """Cycles of 3° and more, those reported within max(5 %, 1 s), each delay beyond T/4 [s]."""

    cycles: int
    good: int
    excesses: list[float]


def period_score(seas: tuple[float, float], seed: int, settle: float = 120.0) -> SeaScore:
    """Return how one sea's periods were told.

    A cycle that was not reported within a quarter of a period of its maximum counts as missed.
    """
    t, heel = heel_of_sea(*seas, seed)
    found = analyse(t, observed(heel, seed))
    truth = true_maxima(t, heel, 2.0)
    good = total = 0
    excesses = []
    for side in (1, -1):
        same = [m for m in truth if m[1] == side]
        reported = [c for c in found if c.side == side]
        for before, after in itertools.pairwise(same):
            if after[0] < settle or min(before[2], after[2]) < 3.0:
                continue
            period = after[0] - before[0]
            total += 1
            near = min(reversed(reported), key=lambda c: abs(c.time - after[0]), default=None)
            if near is None or abs(near.time - after[0]) > 0.25 * period:
                continue
            excesses.append(near.delay - 0.25 * period)
            good += abs(near.period - period) <= max(0.05 * period, 1.0)
    return SeaScore(total, good, excesses)


def sine_error(periods: Iterable[float]) -> float:
    """Return the largest period error [s] on pure sines of 10° after the first two cycles."""
    worst = 0.0
    for period in periods:
        t = np.arange(round(12 * period * RATE)) / RATE
        cycles = analyse(t, 10.0 * np.sin(2.0 * math.pi * t / period + 0.3))
        found = [c.period for c in cycles if c.time > 3.0 * period]
        if len(found) < 10:
            return math.inf
        worst = max(worst, max(abs(p - period) for p in found))
    return worst
