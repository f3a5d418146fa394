# SPDX-License-Identifier: Apache-2.0
"""Linear plants for tuning: k·e^(−sT) / (s (τs + 1)(τ₂s + 1)), their margins and their ultimate point.

The paper's Ku = 0.9 and Tu = 0.08 s come out of `documented_plant`: a craft whose ESP32 loop hands the PID's
output to something that turns it into a *rate* with a lag of 19 ms (on a bare rigid body, which integrates
twice, no ultimate gain exists), read and acted on at 200 Hz with one sample of delay.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import brentq

# Simulation step (s): 1/20 of the control period, so that a delay is resolved to 0.25 ms.
STEP = 2.5e-4


@dataclass(frozen=True)
class LinearPlant:
    """Gain (output per second per unit of input), lags and delay (s), control period (s)."""

    gain: float
    lag: float
    delay: float
    lag2: float = 0.0
    period: float = 0.005

    def response(self, omega: float) -> complex:
        """Return the frequency response at `omega` (rad/s), zero-order hold as half a period of delay."""
        s = 1j * omega
        hold = self.delay + 0.5 * self.period
        return self.gain * cmath.exp(-s * hold) / (s * (self.lag * s + 1.0) * (self.lag2 * s + 1.0))

    def phase_lag(self, omega: float) -> float:
        """Return the phase lag (rad) at `omega` (rad/s), not wrapped."""
        hold = self.delay + 0.5 * self.period
        return math.pi / 2 + math.atan(self.lag * omega) + math.atan(self.lag2 * omega) + hold * omega

    def ultimate(self) -> tuple[float, float]:
        """Return the ultimate gain and period (s) of a proportional loop, from the phase of −180°."""
        omega = brentq(lambda w: self.phase_lag(w) - math.pi, 1e-3, 1e5)
        return 1.0 / abs(self.response(omega)), 2.0 * math.pi / omega


def documented_plant() -> LinearPlant:
    """Return the plant on which the tuning experiment itself gives Ku ≈ 0.9 and Tu ≈ 0.08 s.

    The delay is one 5 ms sample; with the hold's 2.5 ms, −180° at 2π/0.08 rad/s needs a lag of 19.1 ms, and
    |G| = 1/0.9 there needs a gain of 157 per second.
    """
    omega = 2.0 * math.pi / 0.08
    hold = 0.0075
    lag = math.tan(math.pi / 2 - omega * hold) / omega
    gain = omega * math.hypot(1.0, omega * lag) / 0.9
    return LinearPlant(gain, lag, 0.005)


def rate_plant(effectiveness: float, motor_time: float = 0.03, delay: float = 0.005) -> LinearPlant:
    """Return body rate per torque demand of a craft: `effectiveness` in rad/s² per thrust fraction."""
    return LinearPlant(effectiveness, motor_time, delay)


@njit(cache=True, nogil=True)
def run(x, line, cursor, u, steps, gain, lag, lag2):
    """Advance the plant by `steps` steps of STEP with input `u`; returns (output, cursor).

    x (3,): output before the second lag, its rate, output; line: ring of delayed inputs. Exact hold
    equivalents of the integrator and of each lag.
    """
    n = line.shape[0]
    e = math.exp(-STEP / lag)
    e2 = math.exp(-STEP / lag2) if lag2 > 0.0 else 0.0
    for _ in range(steps):
        line[cursor] = u
        cursor = (cursor + 1) % n
        target = gain * line[cursor]
        x[0] += target * STEP + (x[1] - target) * lag * (1.0 - e)
        x[1] = target + (x[1] - target) * e
        x[2] = x[0] + (x[2] - x[0]) * e2
    return x[2], cursor


class LinearSimulation:
    """A LinearPlant in time: `advance(u)` holds `u` for one control period and returns the output."""

    def __init__(self, plant: LinearPlant, start: float = 0.0) -> None:
        self.plant = plant
        self._x = np.array([start, 0.0, start])
        # n − 1 steps pass between writing an input and its use.
        self._line = np.zeros(round(plant.delay / STEP) + 1)
        self._cursor = 0
        self._steps = round(plant.period / STEP)

    @property
    def output(self) -> float:
        """Output of this instant."""
        return float(self._x[2])

    @property
    def rate(self) -> float:
        """Rate of the output before the second lag."""
        return float(self._x[1])

    def advance(self, u: float) -> float:
        """Hold the input `u` for one period; return the output after it."""
        p = self.plant
        y, self._cursor = run(self._x, self._line, self._cursor, u, self._steps, p.gain, p.lag, p.lag2)
        return float(y)


@dataclass(frozen=True)
class Margins:
    """Gain margin (factor), phase margin (rad), crossover (rad/s), largest sensitivity."""

    gain: float
    phase: float
    crossover: float
    sensitivity: float

    def __str__(self) -> str:
        return (
            f'gain margin {self.gain:.1f}, phase margin {math.degrees(self.phase):.0f}°, '
            f'crossover {self.crossover:.0f} rad/s, largest sensitivity {self.sensitivity:.1f}'
        )


def margins(loop) -> Margins:
    """Return the margins of ``loop(omega) -> complex``, on 4000 frequencies from 0.1 to 3000 rad/s.

    Phase margin: the smallest distance to −180° at any unity-gain crossing; gain margin: the smallest
    factor above 1 at a crossing of −180°.
    """
    omega = np.geomspace(0.1, 3000.0, 4000)
    values = np.array([loop(w) for w in omega])
    size = np.abs(values)
    phase = np.unwrap(np.angle(values))
    phase -= 2.0 * math.pi * round((phase[0] + math.pi) / (2.0 * math.pi))
    crossing = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    phase_margin = min(
        (abs(math.remainder(phase[i] + math.pi, 2 * math.pi)) for i in crossing), default=math.pi
    )
    inverted = np.flatnonzero((phase[:-1] > -math.pi) & (phase[1:] <= -math.pi))
    gain_margin = min((1.0 / size[i] for i in inverted if size[i] < 1.0), default=math.inf)
    sensitivity = float(np.max(1.0 / np.abs(1.0 + values)))
    return Margins(
        float(gain_margin),
        float(phase_margin),
        float(omega[crossing[-1]]) if len(crossing) else 0.0,
        sensitivity,
    )
