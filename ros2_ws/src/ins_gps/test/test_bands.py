# SPDX-License-Identifier: Apache-2.0
"""Several bands: what signals share counts once, and what is of L1 is not put on the others."""

from dataclasses import replace

import numpy as np
import pytest

from ins_gps import layout as at
from ins_gps.batch import run_batch
from ins_gps.channels import (
    REPORT_CODE,
    ROW_UNUSED,
    ROW_USED,
    channel_of,
    corrected_range,
    store_corrections,
    wavelength,
)
from ins_gps.configuration import config_array
from ins_gps.constants import FREQUENCY_L1, FREQUENCY_L2, FREQUENCY_L5, SPEED_OF_LIGHT
from ins_gps.evaluation import START_SIGMAS, compare, evaluate, filter_params, start_wrong
from ins_gps.filter import NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.prediction import covariance_of
from ins_gps.samples import OBS, OBSERVATION_COLUMNS, Corrections, GnssEpoch
from ins_gps.simulation import STANDALONE, Scenario
from ins_gps.simulation_gnss import simulate
from kalman_core.consistency import chi2_band

SLOW, OWN, COMMON = 2.5, 2.0, 10.0
PARAMS = FilterParams(channels=6, code_slow_alone=SLOW, code_slow=0.5, code_band=OWN, code_band_common=COMMON)


def opened(keys, params=PARAMS):
    """Return the covariance of the slow errors of signals, opened in this order without any measurement."""
    state = np.zeros(at.state_size(params.channels))
    state[at.SEC] = 1000.0
    config = config_array(params)
    indices = []
    for satellite, band in keys:
        channel = channel_of(state, params.channels, config, 1.0 + 10.0 * satellite + band, False)
        state[at.HEAD + channel * at.CHANNEL_WIDTH + at.C_SEC] = 1000.0
        indices.append(at.CHANNEL + at.PER_CHANNEL * channel)
    return covariance_of(state, params.channels)[np.ix_(indices, indices)]


def test_codes_of_one_satellite_share_its_error_and_codes_of_one_band_the_receivers_delay():
    P = opened([(7, 1), (9, 1), (7, 5), (9, 5)])
    assert P[0, 0] == pytest.approx(SLOW**2)
    assert P[0, 1] == 0.0
    # Both bands have orbit, clock and troposphere of the satellite.
    assert P[0, 2] == P[1, 3] == pytest.approx(SLOW**2)
    assert P[2, 2] == pytest.approx(SLOW**2 + OWN**2 + COMMON**2)
    # The difference of the bands, taken between satellites, is free of the receiver's delay.
    between = np.array([-1.0, 1.0, 1.0, -1.0])
    assert between @ P @ between == pytest.approx(2.0 * OWN**2)
    np.testing.assert_allclose(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0.0


def test_a_band_alone_has_all_errors_of_its_own():
    P = opened([(7, 5), (9, 2), (9, 5)])
    assert P[0, 0] == P[1, 1] == pytest.approx(SLOW**2 + OWN**2 + COMMON**2)
    assert np.abs(P - np.diag(np.diag(P))).max() == 0.0


@pytest.mark.parametrize(('band', 'frequency'), [(1, FREQUENCY_L1), (2, FREQUENCY_L2), (5, FREQUENCY_L5)])
def test_a_correction_made_on_l1_leaves_the_rest_of_the_ionosphere_of_another_band(band, frequency):
    """By hand: the code has the ionosphere of its own frequency, the correction that of L1."""
    range_, vertical, troposphere, clock = 2.2e7, 8.0, 3.0, 1e-4
    ionosphere = vertical * (FREQUENCY_L1 / frequency) ** 2
    state = np.zeros(at.state_size(4))
    state[at.SEC] = 1000.0
    config = config_array(replace(PARAMS, channels=4))
    row = np.full(OBSERVATION_COLUMNS, np.nan)
    row[:3] = 0.0, 7.0, band
    row[OBS['pseudorange']] = range_ - SPEED_OF_LIGHT * clock + ionosphere + troposphere
    row[OBS['satellite_clock']], row[OBS['ionosphere']], row[OBS['troposphere']] = (
        clock,
        ionosphere,
        troposphere,
    )
    assert corrected_range(state, 4, config, row)[0] == pytest.approx(range_, abs=1e-6)
    correction = np.array([[0.0, 7.0, -vertical - troposphere, 0.0, 0.0]])
    store_corrections(state, 4, correction, 1000.0, 0.0)
    value, _, corrected = corrected_range(state, 4, config, row)
    assert corrected
    assert value == pytest.approx(range_, abs=1e-6)


@pytest.mark.parametrize('modelled', [False, True])
@pytest.mark.parametrize('seed', [1000, 1001])
def test_a_correction_of_l1_is_put_on_another_band_only_with_a_model_of_the_ionosphere(modelled, seed):
    """Base and rover see 3 to 12 m of it on L1. Used without a model, L5 moved the position by 0.3 m."""
    budget = replace(STANDALONE, ionosphere=0.0, troposphere=0.0, orbit=0.3, white=False)
    run = simulate(Scenario(trajectory='s_turns', duration=40.0, imu_rate=20.0, budget=budget), seed)
    delay = np.random.default_rng(seed).uniform(3.0, 12.0, 40)
    ratio = (FREQUENCY_L1 / FREQUENCY_L5) ** 2
    alone, both, corrections = [], [], []
    for epoch in run.epochs:
        own = delay[epoch.rows[:, 1].astype(int)]
        first, fifth = epoch.rows.copy(), epoch.rows.copy()
        first[:, 3] += own
        fifth[:, 2], fifth[:, 4:6] = 5.0, np.nan
        fifth[:, 3] += ratio * own
        if modelled:
            first[:, OBS['ionosphere']], fifth[:, OBS['ionosphere']] = own, ratio * own
        zero = np.zeros(len(own))
        corrections.append(Corrections(epoch.stamp, np.column_stack([zero, first[:, 1], -own, zero, zero])))
        alone.append(GnssEpoch(epoch.stamp, first))
        both.append(GnssEpoch(epoch.stamp, np.vstack([first, fifth])))
    results = []
    for epochs in (alone, both):
        navigation = NavigationFilter(filter_params(budget, channels=16, code_band=3.0))
        start_wrong(navigation, run, seed, START_SIGMAS)
        history = run_batch(navigation, run.stamps[1:], run.rate, run.force, epochs, corrections)
        results.append(compare(run, history, navigation))
    codes = results[1].fates[-1][len(alone[-1].rows) :, 2 + REPORT_CODE]
    assert (codes == (ROW_USED if modelled else ROW_UNUSED)).all()
    if not modelled:
        np.testing.assert_allclose(results[1].errors, results[0].errors, rtol=0.0, atol=1e-9)
    assert results[1].nees(slice(0, 3))[20:].mean() < 3.0 * 3.0


def with_bands(run, bands, seed):
    """Return a run with other bands too: the same range errors, biases and noise of their own."""
    rng = np.random.default_rng([seed, 5])
    delays = rng.normal(0.0, 10.0, len(bands))
    biases = rng.normal(0.0, 2.0, (len(bands), 40))
    epochs = []
    for epoch in run.epochs:
        parts = [epoch.rows]
        for k, band in enumerate(bands):
            rows = epoch.rows.copy()
            length, count = wavelength(float(band)), len(rows)
            rows[:, 2] = band
            rows[:, 3] += delays[k] + biases[k, rows[:, 1].astype(int)] + rng.normal(0.0, 0.5, count)
            metres = epoch.rows[:, 4] * wavelength(1.0) + rng.normal(0.0, 0.003, count)
            rows[:, 4], rows[:, 5] = metres / length, rows[:, 5] * wavelength(1.0) / length
            parts.append(rows)
        epochs.append(GnssEpoch(epoch.stamp, np.vstack(parts)))
    return replace(run, epochs=epochs)


def test_more_bands_do_no_harm_and_the_covariance_stays_true():
    budget = replace(STANDALONE, white=False, carrier_walk=0.01)
    scenario = Scenario(trajectory='s_turns', duration=60.0, imu_rate=20.0, budget=budget)
    params = filter_params(budget, channels=20, code_band=2.0, carrier_walk=0.01)
    first, every, nees = [], [], []
    runs = 16
    for seed in range(1000, 1000 + runs):
        run = simulate(scenario, seed)
        late = slice(20, None)
        first.append(evaluate(run, params, seed).position[late].mean())
        result = evaluate(with_bands(run, (2, 5), seed), params, seed)
        every.append(result.position[late].mean())
        nees.append(result.nees(slice(0, 3))[late].mean())
    low, high = chi2_band(0.999, dof=3, runs=runs)
    assert low < np.mean(nees) < high
    assert np.mean(every) < 1.05 * np.mean(first)
