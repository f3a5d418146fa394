# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from filterpy.stats import NEES
from scipy import stats

from kalman_core.consistency import anees, chi2_band, nees, nis, whiteness


def test_nees_equals_filterpys():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((30, 4, 4))
    P = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(4)
    error = rng.standard_normal((30, 4))
    expected = NEES(error, np.zeros_like(error), P)
    assert np.allclose(nees(error, P), np.ravel(expected), rtol=1e-10)
    assert nis is nees


def test_one_covariance_serves_all_errors_and_one_error_is_a_series_of_one():
    P = np.diag([4.0, 9.0])
    assert nees([[2.0, 3.0], [4.0, 0.0]], P) == pytest.approx([2.0, 4.0])
    assert nees([2.0, 3.0], P) == pytest.approx([2.0])


def test_a_covariance_that_is_not_positive_definite_raises():
    with pytest.raises(np.linalg.LinAlgError):
        nees([[1.0, 1.0]], np.diag([1.0, -1.0]))


def test_the_average_is_one_for_an_honest_covariance_and_tells_false_ones():
    rng = np.random.default_rng(2)
    error = rng.standard_normal((4000, 3))
    assert anees(nees(error, np.eye(3)), 3) == pytest.approx(1.0, abs=0.05)
    assert anees(nees(error, 0.25 * np.eye(3)), 3) == pytest.approx(4.0, abs=0.2)
    assert anees([3.0, 9.0], dof=3) == 2.0


@pytest.mark.parametrize(('probability', 'dof', 'runs'), [(0.95, 2, 50), (0.99, 9, 1), (0.5, 1, 1000)])
def test_the_band_equals_scipys_quantiles(probability, dof, runs):
    tail = (1.0 - probability) / 2.0
    expected = stats.chi2.ppf([tail, 1.0 - tail], dof * runs) / runs
    assert chi2_band(probability, dof, runs) == pytest.approx(tuple(expected), rel=1e-10)


def test_the_band_holds_the_stated_share_of_monte_carlo_means():
    rng = np.random.default_rng(3)
    means = rng.chisquare(4, (4000, 20)).mean(axis=1)
    low, high = chi2_band(0.9, dof=4, runs=20)
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize('probability', [0.0, 1.0, 95.0, float('nan')])
def test_a_band_of_an_impossible_probability_is_refused(probability):
    with pytest.raises(ValueError, match='probability is'):
        chi2_band(probability, 2)


def test_white_innovations_pass_and_coloured_ones_fail():
    rng = np.random.default_rng(4)
    white = rng.standard_normal(5000)
    result = whiteness(white, lags=40)
    assert result.correlation.shape == (40,)
    assert result.band == pytest.approx(1.96 / np.sqrt(5000), rel=1e-3)
    assert result.inside > 0.85
    assert result.portmanteau < stats.chi2.isf(1e-3, 40)
    coloured = np.convolve(white, [1.0, 0.5], mode='valid')
    result = whiteness(coloured + 3.0, lags=40)
    assert result.correlation[0] == pytest.approx(0.4, abs=0.03)
    assert result.portmanteau > stats.chi2.isf(1e-9, 40)


def test_correlation_and_portmanteau_follow_their_definitions():
    series = np.array([1.0, 2.0, -1.0, 0.5, -2.0, 1.5])
    centred = series - series.mean()
    expected = [np.sum(centred[lag:] * centred[:-lag]) / np.sum(centred**2) for lag in (1, 2)]
    result = whiteness(series, lags=2, probability=0.5)
    assert result.correlation == pytest.approx(expected)
    assert result.portmanteau == pytest.approx(6 * 8 * (expected[0] ** 2 / 5 + expected[1] ** 2 / 4))
    assert result.band == pytest.approx(stats.norm.ppf(0.75) / np.sqrt(6))
    assert result.inside == np.mean(np.abs(expected) <= result.band)


@pytest.mark.parametrize(
    ('series', 'message'),
    [
        (np.ones(20), '20 innovations are too few for 20 lags'),
        (np.ones(50), 'constant'),
        (np.append(np.arange(50.0), np.nan), 'not finite'),
    ],
)
def test_series_that_cannot_be_judged_are_refused(series, message):
    with pytest.raises(ValueError, match=message):
        whiteness(series)
