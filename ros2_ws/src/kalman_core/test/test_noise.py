# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from scipy import signal

from kalman_core import noise


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize(
    'generate',
    [
        lambda r: noise.white(r, 0.1, 0.01, (50, 3)),
        lambda r: noise.random_walk(r, 0.1, 0.01, (50, 3)),
        lambda r: noise.gauss_markov(r, 0.1, 3.0, 0.01, 50),
        lambda r: noise.flicker(r, 0.1, 50),
    ],
)
def test_a_seed_fixes_the_series(generate):
    assert np.array_equal(generate(rng(5)), generate(rng(5)))
    assert not np.array_equal(generate(rng(5)), generate(rng(6)))


def test_white_noise_has_its_density_at_any_rate():
    for dt in (0.002, 0.1):
        series = noise.white(rng(), 0.03, dt, 100_000)
        assert series.std() * math.sqrt(dt) == pytest.approx(0.03, rel=0.01)
        assert noise.allan_deviation(series, dt, [10 * dt])[0] == pytest.approx(
            0.03 / math.sqrt(10 * dt), rel=0.02
        )


def test_a_random_walk_starts_at_zero_and_spreads_with_the_root_of_time():
    series = noise.random_walk(rng(), 0.2, 0.5, (400, 2000))
    assert (series[0] == 0.0).all()
    for k in (100, 399):
        assert series[k].std() == pytest.approx(0.2 * math.sqrt(0.5 * k), rel=0.05)


def test_a_random_walk_has_its_allan_deviation():
    series = noise.random_walk(rng(1), 0.2, 0.1, 200_000)
    times = np.array([2.0, 10.0])
    expected = 0.2 * np.sqrt(times / 3.0)
    assert noise.allan_deviation(series, 0.1, times) == pytest.approx(expected, rel=0.07)


def test_a_gauss_markov_process_is_stationary_from_its_first_sample():
    series = np.array([noise.gauss_markov(rng(seed), 0.5, 2.0, 0.1, 60) for seed in range(3000)])
    assert series[:, 0].std() == pytest.approx(0.5, rel=0.05)
    assert series[:, -1].std() == pytest.approx(0.5, rel=0.05)
    correlation = np.mean(series[:, 20] * series[:, 40]) / 0.25
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.05)


def test_a_gauss_markov_process_is_exact_however_long_the_step():
    series = noise.gauss_markov(rng(2), 0.5, 1e-3, 10.0, 50_000)
    assert series.std() == pytest.approx(0.5, rel=0.02)
    assert np.corrcoef(series[:-1], series[1:])[0, 1] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize('dt', [0.01, 1.0])
def test_flicker_noise_has_a_flat_allan_deviation_at_its_floor(dt):
    deviations = []
    for seed in range(6):
        series = noise.flicker(rng(seed), 0.3, 60_000)
        deviations.append(noise.allan_deviation(series, dt, np.array([20, 100, 500]) * dt))
    assert pytest.approx(0.664, abs=5e-4) == noise.FLICKER_FLOOR
    assert np.mean(deviations, axis=0) == pytest.approx(0.3 * noise.FLICKER_FLOOR, rel=0.1)


def test_flicker_noise_has_a_spectrum_that_falls_as_one_over_f():
    power = 0.0
    for seed in range(8):
        f, p = signal.welch(noise.flicker(rng(seed), 1.0, 2**16), fs=1.0, nperseg=4096)
        power = power + p / 8
    band = (f > 2e-3) & (f < 5e-2)
    slope = np.polyfit(np.log(f[band]), np.log(power[band]), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.06)
    # One-sided density 2·B²/(2πf), IEEE 952 annex C.
    assert np.mean(power[band] * f[band]) == pytest.approx(1.0 / math.pi, rel=0.08)


@pytest.mark.parametrize('count', [1, 2, 3, 100])
def test_flicker_noise_is_the_driven_fractional_integrator(count):
    series = noise.flicker(rng(7), 2.0, count)
    drive = 2.0 * rng(7).standard_normal(count)
    impulse = np.ones(count)
    for k in range(1, count):
        impulse[k] = impulse[k - 1] * (k - 0.5) / k
    assert np.allclose(series, np.convolve(drive, impulse)[:count], atol=1e-12)


def test_quantised_values_are_the_nearest_multiples_of_the_step():
    assert noise.quantise([0.12, -0.13, 0.0, 0.3], 0.25) == pytest.approx([0.0, -0.25, 0.0, 0.25])
    values = rng().uniform(-5, 5, 1000)
    error = noise.quantise(values, 0.1) - values
    assert np.max(np.abs(error)) <= 0.05 + 1e-12
    assert error.std() == pytest.approx(0.1 / math.sqrt(12), rel=0.05)


def allan_by_definition(values, m, dt):
    averages = [np.mean(values[i : i + m]) for i in range(len(values) - m + 1)]
    differences = [averages[i + m] - averages[i] for i in range(len(averages) - m)]
    return math.sqrt(np.mean(np.square(differences)) / 2.0)


@pytest.mark.parametrize('m', [1, 3, 10])
def test_the_allan_deviation_equals_its_definition(m):
    values = rng(8).standard_normal(50)
    got = noise.allan_deviation(values, 0.2, [m * 0.2])[0]
    assert got == pytest.approx(allan_by_definition(values, m, 0.2), rel=1e-10)


def test_the_allan_deviation_of_a_ramp_grows_with_its_slope():
    values = 0.3 * np.arange(1000) * 0.1
    times = np.array([1.0, 5.0])
    assert noise.allan_deviation(values, 0.1, times) == pytest.approx(0.3 * times / math.sqrt(2.0), rel=1e-9)


def test_averaging_times_are_rounded_to_samples_and_too_long_ones_are_nan():
    values = rng(9).standard_normal(20)
    got = noise.allan_deviation(values, 1.0, [0.2, 1.4, 10.0, 10.6])
    assert got[0] == got[1] == pytest.approx(allan_by_definition(values, 1, 1.0))
    assert got[2] == pytest.approx(allan_by_definition(values, 10, 1.0))
    assert math.isnan(got[3])
