# SPDX-License-Identifier: Apache-2.0
"""Tuning experiments and rules: Ziegler-Nichols as the paper does it, relay feedback, step identification.

Sources: paper 000, eqs. 11-13; Astrom and Hagglund, "Automatic tuning of simple regulators", Automatica
20(5), 1984, for the relay; Astrom and Murray, "Feedback Systems" (2008), chapter 9, for margins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from quad_control.linear_plant import LinearPlant, LinearSimulation, Margins, margins

# Share of the delay-limited bandwidth that the rate loop takes: crossover × delay, rad. With the motor lag
# cancelled that leaves 90° − 16° of phase, and a factor of 2 in gain costs another 16°.
_CROSSOVER_DELAY = 0.27
# Angle gain per rate crossover: 1/4 makes the double pole of s² + ω s + ω·P critically damped.
_ANGLE_SHARE = 0.25
# Integral time of the rate loop in units of 1/crossover; slower than the angle loop by a factor of 6.
_INTEGRAL_SHARE = 25.0


@dataclass(frozen=True)
class Ultimate:
    """Ultimate gain and period (s): where the loop oscillates for good.

    `lead` (rad) is how far the point lies before −180°; a relay with hysteresis finds such a point.
    """

    gain: float
    period: float
    lead: float = 0.0


@dataclass(frozen=True)
class PidGains:
    """Kp, Ki (1/s), Kd (s)."""

    kp: float
    ki: float
    kd: float


@dataclass(frozen=True)
class CascadeGains:
    """Gains of one axis of the cascade, with the margins they are predicted to have."""

    angle_p: float
    rate_p: float
    rate_i: float
    rate_d: float
    plant: LinearPlant
    margins: Margins


def ziegler_nichols(u: Ultimate) -> PidGains:
    """Return the PID gains of eqs. 11-13: 0.6 Ku, 1.2 Ku/Tu, 0.075 Ku Tu."""
    return PidGains(0.6 * u.gain, 1.2 * u.gain / u.period, 0.075 * u.gain * u.period)


def ultimate_by_experiment(
    plant: LinearPlant, first: float = 0.01, factor: float = 1.05, seconds: float = 4.0
) -> Ultimate:
    """Raise Kp from `first` until the loop oscillates for good, then measure: the paper's experiment.

    Each trial starts from a kick of 1 and lasts `seconds`. The oscillation is sustained when the last
    quarter's amplitude is no smaller than the quarter before; the gain is then bisected to 0.5 %.
    Raises ValueError when nothing oscillates up to a gain of 10⁴.
    """
    stable, gain = 0.0, first
    while not _sustained(plant, gain, seconds)[0]:
        stable, gain = gain, gain * factor
        if gain > 1e4:
            raise ValueError('no gain up to 1e4 makes the loop oscillate')
    while gain / max(stable, 1e-12) > 1.005:
        middle = 0.5 * (stable + gain)
        if _sustained(plant, middle, seconds)[0]:
            gain = middle
        else:
            stable = middle
    return Ultimate(gain, _sustained(plant, gain, seconds)[1])


def _sustained(plant: LinearPlant, gain: float, seconds: float) -> tuple[bool, float]:
    simulation = LinearSimulation(plant, start=1.0)
    n = round(seconds / plant.period)
    y = np.empty(n)
    for i in range(n):
        y[i] = simulation.output
        if abs(y[i]) > 1e6:
            return True, period_of(y[:i], plant.period)
        simulation.advance(-gain * y[i])
    quarter = n // 4
    before, last = np.ptp(y[-2 * quarter : -quarter]), np.ptp(y[-quarter:])
    return bool(last >= before and last > 1e-6), period_of(y[-2 * quarter :], plant.period)


def period_of(y: np.ndarray, dt: float) -> float:
    """Return the mean period (s) of an oscillation `y` sampled at `dt`, from interpolated up-crossings."""
    i = np.flatnonzero((y[:-1] < 0.0) & (y[1:] >= 0.0))
    if len(i) < 2:
        return math.nan
    crossing = i - y[i] / (y[i + 1] - y[i])
    return float((crossing[-1] - crossing[0]) / (len(crossing) - 1) * dt)


class RelayTest:
    """Relay feedback on one signal: ``output(error)`` per sample, `result` after enough equal cycles.

    The describing function of a relay of amplitude d with hysteresis h against an oscillation of amplitude
    a: the plant's gain there is π a / (4 d), its phase −180° + asin(h/a).
    """

    # Cycles that settle, and cycles that are measured.
    _SKIP, _MEASURE = 3, 6
    # A pause longer than this between switches (s): no oscillation to measure.
    _TIMEOUT = 3.0

    def __init__(self, amplitude: float, hysteresis: float) -> None:
        self.amplitude = amplitude
        self.hysteresis = hysteresis
        self._sign = 1.0
        self._last = 0.0
        self._time = 0.0
        self._samples = 0
        self._up: list[float] = []
        self._peaks: list[float] = []
        self._high = -math.inf
        self._low = math.inf
        self.failed = ''

    def output(self, error: float, dt: float) -> float:
        """Return the relay output for the control error (setpoint − measurement) after `dt` (s)."""
        self._time += dt
        self._samples += 1
        self._high, self._low = max(self._high, error), min(self._low, error)
        h = self.hysteresis
        if self._sign < 0.0 and error > h:
            self._sign = 1.0
            # When the error passed h between the samples, not when it was seen.
            share = (error - h) / max(error - self._last, 1e-12)
            self._up.append(self._time - dt * min(max(share, 0.0), 1.0))
            self._peaks.append(0.5 * (self._high - self._low))
            self._high = self._low = error
        elif self._sign > 0.0 and error < -h:
            self._sign = -1.0
        self._last = error
        if self._time - (self._up[-1] if self._up else 0.0) > self._TIMEOUT:
            self.failed = f'no oscillation within {self._TIMEOUT:.0f} s'
        return self.amplitude * self._sign

    @property
    def period(self) -> float:
        """Mean time between samples (s)."""
        return self._time / max(self._samples, 1)

    @property
    def result(self) -> Ultimate | None:
        """Ultimate gain and period once the cycles are in, else None."""
        if len(self._up) <= self._SKIP + self._MEASURE:
            return None
        times = self._up[self._SKIP :]
        amplitude = float(np.mean(self._peaks[self._SKIP + 1 :]))
        return Ultimate(
            4.0 * self.amplitude / (math.pi * amplitude),
            (times[-1] - times[0]) / (len(times) - 1),
            math.asin(min(self.hysteresis / amplitude, 1.0)),
        )


def ultimate_by_relay(
    plant: LinearPlant, amplitude: float = 1.0, hysteresis: float = 0.0, seconds: float = 20.0
) -> Ultimate:
    """Run a relay on a plant. Raises ValueError when it does not settle into an oscillation."""
    simulation = LinearSimulation(plant)
    relay = RelayTest(amplitude, hysteresis)
    for _ in range(round(seconds / plant.period)):
        simulation.advance(relay.output(-simulation.output, plant.period))
        if relay.result is not None:
            return relay.result
    raise ValueError(f'the relay gave no oscillation within {seconds:g} s')


def plant_from_ultimate(
    u: Ultimate, delay: float, period: float = 0.005, lag: float | None = None
) -> LinearPlant:
    """Return the gain and lag of an integrator with lag that has the ultimate point `u`.

    `delay` (s) is what is known of the dead time. Without `lag` the phase −180° fixes it; a point that a
    pure delay explains gets a lag of 1 ms.
    """
    omega = 2.0 * math.pi / u.period
    if lag is None:
        room = math.pi / 2 - u.lead - omega * (delay + 0.5 * period)
        lag = max(math.tan(room) / omega, 1e-3) if room > 0.0 else 1e-3
    return LinearPlant(omega * math.hypot(1.0, omega * lag) / u.gain, lag, delay, period=period)


def cascade_for(plant: LinearPlant) -> CascadeGains:
    """Return cascade gains for a rate plant, with their predicted margins (broken at the torque).

    The derivative cancels the lag; the crossover is set by what dead time is left.
    """
    hold = plant.delay + 0.5 * plant.period + plant.lag2
    crossover = _CROSSOVER_DELAY / hold
    rate_p = crossover / plant.gain
    angle_p = _ANGLE_SHARE * crossover
    rate_i = rate_p * crossover / _INTEGRAL_SHARE
    rate_d = rate_p * plant.lag
    return CascadeGains(
        angle_p,
        rate_p,
        rate_i,
        rate_d,
        plant,
        cascade_margins(plant, angle_p, rate_p, rate_i, rate_d),
    )


def cascade_margins(
    plant: LinearPlant, angle_p: float, rate_p: float, rate_i: float, rate_d: float, cutoff: float = 60.0
) -> Margins:
    """Return the margins of angle P and rate PID around a rate plant; `cutoff` (Hz) of the derivative."""
    tau = 1.0 / (2.0 * math.pi * cutoff)

    def loop(omega: float) -> complex:
        s = 1j * omega
        pi = rate_p + rate_i / s
        controller = pi * (1.0 + angle_p / s) + rate_d * s / (tau * s + 1.0)
        return controller * plant.response(omega)

    return margins(loop)


def pid_margins(plant: LinearPlant, gains: PidGains) -> Margins:
    """Return the margins of the printed PID around a plant."""

    def loop(omega: float) -> complex:
        s = 1j * omega
        return (gains.kp + gains.ki / s + gains.kd * s) * plant.response(omega)

    return margins(loop)


@njit(cache=True, nogil=True)
def _lagged_integral(u, dt, lag, delay, out):
    """Fill `out` with the rate of a unit-gain lag + integrator driven by held `u`, delayed by `delay` (s)."""
    n = u.shape[0]
    e = math.exp(-dt / lag)
    r = 0.0
    y = 0.0
    whole = int(delay / dt)
    share = delay / dt - whole
    for i in range(n):
        out[i] = y
        a = u[i - whole] if i >= whole else u[0]
        b = u[i - whole - 1] if i >= whole + 1 else u[0]
        target = (1.0 - share) * a + share * b
        y += target * dt + (r - target) * lag * (1.0 - e)
        r = target + (r - target) * e


@dataclass(frozen=True)
class Identified:
    """A rate plant and how much of the rate's variance it explains (1 = all)."""

    plant: LinearPlant
    fit: float


def identify_rate_plant(demand: np.ndarray, rate: np.ndarray, dt: float) -> Identified:
    """Fit gain, lag and delay to a flight log of torque demand (thrust fraction) and body rate (rad/s).

    Output error over the whole log, with a free start rate and a constant disturbance. Raises ValueError
    when the log is short (under 0.5 s) or holds no excitation.
    """
    if len(demand) != len(rate) or len(rate) * dt < 0.5:
        raise ValueError(f'the log has {len(rate)} samples of {dt:g} s, expected at least 0.5 s')
    if np.std(demand) < 1e-6 or np.std(rate) < 1e-6:
        raise ValueError('the log holds no excitation: demand or rate is constant')
    demand = np.asarray(demand, dtype=float)
    basis = np.empty_like(demand)
    time = np.arange(len(rate)) * dt

    def solve(lag: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
        _lagged_integral(demand, dt, lag, delay, basis)
        a = np.column_stack((basis, np.ones_like(basis), time))
        solution, *_ = np.linalg.lstsq(a, rate, rcond=None)
        return solution, rate - a @ solution

    best = least_squares(
        lambda x: solve(math.exp(x[0]), math.exp(x[1]))[1],
        (math.log(0.03), math.log(0.005)),
        bounds=((math.log(1e-3), math.log(1e-4)), (math.log(0.5), math.log(0.1))),
        diff_step=1e-3,
    )
    lag, delay = math.exp(best.x[0]), math.exp(best.x[1])
    solution, residual = solve(lag, delay)
    fit = 1.0 - float(np.var(residual) / np.var(rate))
    return Identified(LinearPlant(float(solution[0]), lag, delay, period=dt), fit)
