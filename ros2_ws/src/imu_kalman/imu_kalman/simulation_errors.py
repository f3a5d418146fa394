# SPDX-License-Identifier: Apache-2.0
"""Errors of MEMS sensors, generated block after block.

Every noise source draws from its own generator, so that changing one leaves the others as they were.
Sources: IEEE Std 952-1997, annex C, for the coefficients N (white), B (instability), K (random walk) and
their Allan deviations; Keshner, "1/f noise", Proc. IEEE 70 (1982), for 1/f noise as a sum of first-order
processes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.signal import lfilter

# 1/f noise: correlation times from 0.1 s to 6500 s, each four times the one before. The sum follows 1/f
# within 2 % from 1 mHz to 0.1 Hz and falls below it beyond, where white noise covers it.
_FLICKER_SHORTEST = 0.1
_FLICKER_RATIO = 4.0
_FLICKER_COUNT = 9


class Noise(Protocol):
    """A source of errors for three axes."""

    def take(self, count: int) -> np.ndarray:
        """Return the next (count, 3) samples."""


class White:
    """White noise of root power spectral density `density` (unit/√Hz)."""

    def __init__(self, density: float, rate: float, rng: np.random.Generator) -> None:
        self.sigma = density * math.sqrt(rate)
        self._rng = rng

    def take(self, count: int) -> np.ndarray:
        """Return the next (count, 3) samples."""
        return self.sigma * self._rng.standard_normal((count, 3))


class RandomWalk:
    """Integrated white noise that starts at 0 and grows by `density` per √s."""

    def __init__(self, density: float, rate: float, rng: np.random.Generator) -> None:
        self._sigma = density / math.sqrt(rate)
        self._rng = rng
        self._value = np.zeros(3)

    def take(self, count: int) -> np.ndarray:
        """Return the next (count, 3) samples."""
        steps = self._sigma * self._rng.standard_normal((count, 3))
        steps[0] += self._value
        walk = np.cumsum(steps, axis=0)
        self._value = walk[-1].copy()
        return walk


class GaussMarkov:
    """First-order Gauss–Markov process of standard deviation `sigma`, stationary from the first sample."""

    def __init__(self, sigma: float, correlation: float, rate: float, rng: np.random.Generator) -> None:
        self._decay = math.exp(-1.0 / (rate * correlation))
        # -expm1 keeps the digits where the correlation time is long against the sample.
        self._sigma = sigma * math.sqrt(-math.expm1(-2.0 / (rate * correlation)))
        self._rng = rng
        self._state = (self._decay * sigma * rng.standard_normal(3))[None, :]

    def take(self, count: int) -> np.ndarray:
        """Return the next (count, 3) samples."""
        drive = self._sigma * self._rng.standard_normal((count, 3))
        out, self._state = lfilter([1.0], [1.0, -self._decay], drive, axis=0, zi=self._state)
        return out


class Flicker:
    """1/f noise whose Allan deviation is flat at 0.664 `instability` from about 1 s to 1000 s.

    First-order processes of one variance, correlation times spaced by the ratio r, add up to the two-sided
    density σ²/(2 f ln r); equated with B²/(2π f) this gives σ² = B² ln r / π.
    """

    def __init__(self, instability: float, rate: float, rng: np.random.Generator) -> None:
        sigma = instability * math.sqrt(math.log(_FLICKER_RATIO) / math.pi)
        self._parts = [
            GaussMarkov(sigma, _FLICKER_SHORTEST * _FLICKER_RATIO**k, rate, rng)
            for k in range(_FLICKER_COUNT)
        ]

    def take(self, count: int) -> np.ndarray:
        """Return the next (count, 3) samples."""
        return np.sum([part.take(count) for part in self._parts], axis=0)


class Lines:
    """Vibration: a sine per line along a random direction with a random phase."""

    def __init__(self, amplitude: tuple, frequency: tuple, rng: np.random.Generator) -> None:
        direction = rng.standard_normal((len(amplitude), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self._gain = np.asarray(amplitude)[:, None] * direction
        self._omega = 2.0 * math.pi * np.asarray(frequency)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, len(amplitude))

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the (n, 3) vibration at `times` (n,) [s]."""
        return np.sum(np.sin(times[:, None] * self._omega + self._phase)[:, :, None] * self._gain, axis=1)


@dataclass(frozen=True, slots=True)
class TriadSpec:
    """Errors of three like sensors; units and meaning as in SimulatorParams."""

    noise: float
    bias: tuple
    turn_on: float
    instability: float
    correlation: float
    walk: float
    scale: tuple
    misalignment: tuple
    temperature: tuple
    range: float
    resolution: float
    vibration: tuple


def gain_matrix(scale: tuple, misalignment: tuple) -> np.ndarray:
    """Return the (3, 3) gain of a triad: 1 + scale on the diagonal, xy xz yx yz zx zy beside it."""
    gain = np.diag(1.0 + np.asarray(scale, float))
    gain[[0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = misalignment
    return gain


def digitise(values: np.ndarray, limit: float, resolution: float) -> np.ndarray:
    """Return `values` saturated at ±limit and rounded to the step `resolution` (0: not rounded)."""
    clipped = np.clip(values, -limit, limit)
    if resolution > 0.0:
        clipped = np.clip(np.rint(clipped / resolution) * resolution, -limit, limit)
    return clipped


class Triad:
    """Three gyros or three accelerometers: truth in, what is measured out."""

    def __init__(
        self,
        spec: TriadSpec,
        model: str,
        lines: tuple,
        rate: float,
        seed: np.random.SeedSequence,
    ) -> None:
        """`model`: bias instability, gauss_markov or flicker; `lines`: vibration frequencies (Hz)."""
        white, turn_on, slow, walk, vibration = (np.random.default_rng(s) for s in seed.spawn(5))
        self._spec = spec
        self._gain = gain_matrix(spec.scale, spec.misalignment)
        self._constant = np.asarray(spec.bias) + spec.turn_on * turn_on.standard_normal(3)
        self._white = White(spec.noise, rate, white)
        slow_noise: Noise
        if model == 'flicker':
            slow_noise = Flicker(spec.instability, rate, slow)
        else:
            slow_noise = GaussMarkov(spec.instability, spec.correlation, rate, slow)
        self._wandering = (slow_noise, RandomWalk(spec.walk, rate, walk))
        self._lines = Lines(spec.vibration, lines, vibration)

    def take(
        self, truth: np.ndarray, times: np.ndarray, warming: np.ndarray, foreign: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (measured, bias), each (n, 3).

        truth: (n, 3); times: (n,) s; warming: (n,) K above the temperature at start; foreign: (n, 3), what
        leaks in from another quantity. The bias is all that changes slowly: constant, instability, walk and
        temperature.
        """
        count = len(times)
        bias = self._constant + warming[:, None] * np.asarray(self._spec.temperature)
        for noise in self._wandering:
            bias = bias + noise.take(count)
        # einsum, not @: BLAS may order the sums by the block's length.
        true = np.einsum('ij,nj->ni', self._gain, truth) + self._lines.at(times) + foreign
        measured = true + bias + self._white.take(count)
        return digitise(measured, self._spec.range, self._spec.resolution), bias

    @property
    def variance(self) -> float:
        """Variance of one sample about truth + bias: white noise, rounding and vibration."""
        return sample_variance(self._white.sigma, self._spec.resolution, self._spec.vibration)


def sample_variance(sigma: float, resolution: float, lines: tuple = ()) -> float:
    """Return the variance per axis of white noise, rounding (step²/12) and lines (amplitude²/6)."""
    # A line of amplitude A along a random direction has A²/2 in all, a third of it on each axis.
    return sigma**2 + resolution**2 / 12.0 + sum(a * a for a in lines) / 6.0
