# SPDX-License-Identifier: Apache-2.0
"""Sensor noise for simulators, and the Allan deviation that measures it.

Every generator takes a ``numpy.random.Generator`` first, so that a seed fixes the series. `unit` stands for
that of the sensor (rad/s, m/s², …).

Sources: IEEE Std 952-1997, annex C (Allan deviation of each term); Kasdin, "Discrete simulation of colored
noise and stochastic processes and 1/f^α power law noise generation" (1995) for flicker noise.
"""

import math

import numpy as np
from numba import njit

# Flat part of the Allan deviation of flicker noise with coefficient 1: sqrt(2 ln 2 / π), IEEE 952 C.11.
FLICKER_FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)


def white(rng: np.random.Generator, density: float, dt: float, shape) -> np.ndarray:
    """Return samples of white noise of root PSD `density` (unit/√Hz), each the mean over dt (s)."""
    return (density / math.sqrt(dt)) * rng.standard_normal(shape)


def random_walk(rng: np.random.Generator, density: float, dt: float, shape) -> np.ndarray:
    """Return a walk of `density` (unit/√s) along axis 0, starting at 0 in its first sample."""
    steps = (density * math.sqrt(dt)) * rng.standard_normal(shape)
    steps[0] = 0.0
    return np.cumsum(steps, axis=0)


def gauss_markov(rng: np.random.Generator, sigma: float, time_constant: float, dt: float, count: int):
    """Return (count,) samples of a stationary first-order Gauss-Markov process, exactly discretised.

    `sigma` (unit) is its standard deviation, the correlation falls as exp(-t/`time_constant`).
    """
    decay = math.exp(-dt / time_constant)
    drive = sigma * math.sqrt(-math.expm1(-2.0 * dt / time_constant)) * rng.standard_normal(count)
    drive[0] = sigma * rng.standard_normal()
    return _first_order(drive, decay)


@njit(cache=True, nogil=True)
def _first_order(drive, decay):
    out = np.empty_like(drive)
    value = 0.0
    for i in range(drive.size):
        value = decay * value + drive[i]
        out[i] = value
    return out


def flicker(rng: np.random.Generator, instability: float, count: int) -> np.ndarray:
    """Return (count,) samples of 1/f noise with bias instability `instability` (unit).

    The Allan deviation is flat at ``FLICKER_FLOOR * instability`` from a few samples to a tenth of the
    series, whatever the rate; the series starts at rest and is not stationary. O(count log count).
    """
    index = np.arange(1, count)
    impulse = np.concatenate(([1.0], np.cumprod((index - 0.5) / index)))
    size = 1 << (2 * count - 1).bit_length()
    drive = np.fft.rfft(instability * rng.standard_normal(count), size)
    return np.fft.irfft(drive * np.fft.rfft(impulse, size), size)[:count]


def quantise(values, step: float) -> np.ndarray:
    """Return `values` rounded to multiples of `step` (unit), as a converter without dither does."""
    return step * np.round(np.asarray(values, dtype=np.float64) / step)


def allan_deviation(values, dt: float, averaging_times) -> np.ndarray:
    """Return the overlapping Allan deviation (K,) of a series (N,) at the averaging times (K,) [s].

    `values` are rates (unit) sampled every dt (s); each time is rounded to whole samples, and is NaN where
    the series holds fewer than two averages.
    """
    integral = np.concatenate(([0.0], np.cumsum(np.asarray(values, dtype=np.float64)))) * dt
    out = np.full(len(averaging_times), np.nan)
    for k, time in enumerate(averaging_times):
        m = max(1, round(time / dt))
        if 2 * m < integral.size:
            second = integral[2 * m :] - 2.0 * integral[m:-m] + integral[: -2 * m]
            out[k] = math.sqrt(float(np.mean(second * second)) / 2.0) / (m * dt)
    return out
