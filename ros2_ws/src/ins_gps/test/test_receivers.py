# SPDX-License-Identifier: Apache-2.0
"""Receivers that are not ideal, from a start that nobody gives: defaults of the filter, a MEMS IMU."""

from dataclasses import replace

import numpy as np
import pytest

from ins_gps.batch import run_batch
from ins_gps.filter import NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.samples import OBS, GnssEpoch
from ins_gps.simulation import DGPS, MEMS, Clock, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import error_of

BUDGET = replace(DGPS, white=False, multipath=2.0)
BASE = Scenario(
    trajectory='flight', duration=90.0, imu_rate=20.0, imu=MEMS, budget=BUDGET, clock=Clock(-2e5, 200.0)
)
MILLISECOND = 299_792.458  # m of the clock
WAVELENGTH = 0.190293672798365  # m
CODE, PHASE, DOPPLER, CN0, SLIP = (
    OBS[name] for name in ('pseudorange', 'carrier_phase', 'doppler', 'cn0', 'slip')
)


def _no_doppler(k, rows, rng):
    rows[:, DOPPLER] = np.nan


def _code_only(k, rows, rng):
    rows[:, PHASE] = rows[:, DOPPLER] = np.nan


def _few_at_first(k, rows, rng):
    rows[3 if k < 20 else len(rows) :, CODE:DOPPLER] = np.nan


def _no_ephemerides_at_first(k, rows, rng):
    if k < 40:
        rows[3:, 9:17] = np.nan


def _clock_jumps_in_code_and_phase(k, rows, rng):
    rows[:, CODE] += k // 30 * MILLISECOND
    rows[:, PHASE] += k // 30 * MILLISECOND / WAVELENGTH


def _clock_jumps_in_code(k, rows, rng):
    rows[:, CODE] += k // 30 * MILLISECOND


def _half_cycles(k, rows, rng):
    rows[:, DOPPLER] = np.nan
    rows[2, PHASE] += 0.5 * ((k >= 50) + (k >= 65))


def _unannounced_slips(k, rows, rng):
    rows[:, DOPPLER] = np.nan
    # Each epoch each satellite slips with 5 %; the generator is that of the epoch, so slips accumulate.
    slips = np.random.default_rng(1).choice([-1.0, 1.0, 0.5, 7.0], (200, len(rows)))
    slips *= np.random.default_rng(2).random((200, len(rows))) < 0.05
    rows[:, PHASE] += slips[:k].sum(axis=0)


def _run(change, seed=2000, scenario=BASE):
    run = simulate(scenario, seed)
    rng = np.random.default_rng(seed)
    epochs = []
    for k, epoch in enumerate(run.epochs):
        rows = epoch.rows.copy()
        change(k, rows, rng)
        epochs.append(GnssEpoch(epoch.stamp, rows))
    params = FilterParams(elevation_mask=0.05, code_multipath=1.5, code_slow_alone=0.6)
    navigation = NavigationFilter(params)
    history = run_batch(navigation, run.stamps[1:], run.rate, run.force, epochs)
    index = np.searchsorted(run.stamps, history.stamps)
    errors = np.array([error_of(n, run.truth[i]) for n, i in zip(history.nav, index, strict=True)])
    seconds = (history.stamps - run.stamps[0]) * 1e-9
    return navigation, seconds, errors, np.sqrt(np.einsum('kii->ki', history.covariance))


@pytest.mark.parametrize(
    'change',
    [
        _no_doppler,
        _code_only,
        _few_at_first,
        _no_ephemerides_at_first,
        _clock_jumps_in_code_and_phase,
        _clock_jumps_in_code,
        _half_cycles,
        _unannounced_slips,
    ],
)
def test_it_starts_and_stays_within_its_covariance(change):
    navigation, seconds, errors, sigma = _run(change)
    late = seconds > 50.0
    assert navigation.running
    assert late.sum() > 35
    assert np.linalg.norm(errors[late, :3], axis=1).max() < 5.0
    assert (np.abs(errors[late, :3]) < 4.0 * sigma[late, :3]).all()
    assert np.abs(errors[-1, 8]) < 4.0 * sigma[-1, 8]


@pytest.mark.parametrize('trajectory', ['flight', 's_turns'])
def test_it_finds_back_from_a_street_canyon(trajectory):
    def canyon(k, rows, rng):
        """For a minute four in ten signals are hidden, one in four is reflected; no Doppler."""
        rows[:, DOPPLER] = np.nan
        if k > 60:
            return
        reflected = rng.random(len(rows)) < 0.25
        rows[reflected, CODE] += rng.uniform(5.0, 60.0, reflected.sum())
        rows[reflected, CN0] = 25.0
        slipped = rng.random(len(rows)) < 0.1
        rows[slipped, PHASE] += np.round(rng.normal(0.0, 20.0, slipped.sum()))
        rows[slipped, SLIP] = 1.0
        rows[rng.random(len(rows)) < 0.4, CODE:DOPPLER] = np.nan

    scenario = replace(BASE, trajectory=trajectory, duration=130.0)
    for seed in (2000, 2001):
        _, seconds, errors, _ = _run(canyon, seed, scenario)
        after = seconds > 110.0
        assert np.linalg.norm(errors[after, :3], axis=1).max() < 10.0
