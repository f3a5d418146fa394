# SPDX-License-Identifier: Apache-2.0
"""Is a filter's covariance honest? NEES, NIS, their chi-square bands, and whiteness of innovations.

Source: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
5.4.2; Li, Zhao and Jilkov, "Practical measures and test for credibility of an estimator" (2001) for ANEES.
"""

import math
from typing import NamedTuple

import numpy as np


def nees(error, P) -> np.ndarray:
    """Return the normalised squares ``eᵀ P⁻¹ e`` (N,) of errors (N, n) with covariances (N, n, n) or (n, n).

    With innovations and S it is the NIS. Raises numpy.linalg.LinAlgError where a covariance is not positive
    definite: such a filter is not merely inconsistent.
    """
    error = np.atleast_2d(np.asarray(error, dtype=np.float64))
    lower = np.linalg.cholesky(np.asarray(P, dtype=np.float64))
    lower = np.broadcast_to(lower, (error.shape[0], *lower.shape[-2:]))
    white = np.linalg.solve(lower, error[..., np.newaxis])[..., 0]
    return np.sum(white * white, axis=1)


nis = nees


def anees(values, dof: int) -> float:
    """Return the average of normalised squares divided by `dof`: 1 for an honest covariance.

    Above 1 the filter is over-confident, below 1 it is too modest.
    """
    return float(np.mean(values)) / dof


def chi2_band(probability: float, dof: int, runs: int = 1) -> tuple[float, float]:
    """Return the two-sided band that holds the mean of `runs` chi-square values of `dof`, each.

    The values must be independent: one per Monte-Carlo run, or many of one run only where they are white.
    """
    from scipy.special import chdtri  # scipy costs a quarter of a second and no estimator needs it

    if not 0.0 < probability < 1.0:
        raise ValueError(f'probability is {probability}, allowed: 0 … 1')
    tail = 0.5 * (1.0 - probability)
    degrees = dof * runs
    return float(chdtri(degrees, 1.0 - tail)) / runs, float(chdtri(degrees, tail)) / runs


class Whiteness(NamedTuple):
    """Autocorrelation at lags 1 … L, the band ±`band` of one lag, and the share of lags inside."""

    correlation: np.ndarray
    band: float
    inside: float
    portmanteau: float
    """Ljung-Box statistic: chi-square with L degrees of freedom for a white series."""


def whiteness(innovation, lags: int = 20, probability: float = 0.95) -> Whiteness:
    """Test a series (N,) of normalised scalar innovations for being white.

    `probability` is that of one lag lying inside its band. Raises ValueError for a constant series or one
    not longer than `lags`.
    """
    from scipy.special import ndtri

    series = np.asarray(innovation, dtype=np.float64)
    count = series.size
    if count <= lags:
        raise ValueError(f'{count} innovations are too few for {lags} lags')
    series = series - series.mean()
    power = float(series @ series)
    if not power > 0.0:
        raise ValueError('the innovations are constant or not finite')
    correlation = np.array([series[:-lag] @ series[lag:] for lag in range(1, lags + 1)]) / power
    band = float(ndtri(0.5 + 0.5 * probability)) / math.sqrt(count)
    left = count - np.arange(1, lags + 1)
    portmanteau = count * (count + 2) * float(np.sum(correlation**2 / left))
    return Whiteness(correlation, band, float(np.mean(np.abs(correlation) <= band)), portmanteau)
