# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from ins_gps import layout as at
from ins_gps.evaluation import evaluate, filter_params
from ins_gps.filter import NavigationFilter
from ins_gps.prediction import signatures_of
from ins_gps.simulation import DGPS, Fault, Outage, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import error_of

SHORT = Scenario(trajectory='s_turns', duration=150.0, imu_rate=20.0, budget=replace(DGPS, white=False))
DRIFTS = 'drifts away'


def _drive(run, params, watched=None):
    """Run to the end; `watched` is a channel whose hypothesis is opened at 60 s and held open."""
    navigation = NavigationFilter(params)
    navigation.initialise(
        int(run.stamps[0]), run.truth[0], np.r_[[1.0] * 3, [0.1] * 3, [0.01] * 3], run.clock[0]
    )
    samples, done = run.imu_samples(), 0
    for number, epoch in enumerate(run.epochs):
        while done < len(samples) and samples[done].stamp <= epoch.stamp:
            navigation.imu(samples[done])
            done += 1
        navigation.gnss(epoch)
        if watched is None:
            continue
        for channel in range(navigation.channels):
            # The cumulated sum decides when a hypothesis opens and closes.
            here = at.HEAD + channel * at.CHANNEL_WIDTH
            held = channel == watched and number >= 60
            navigation.state[here + at.C_PLUS] = 1e9 if held else 0.0
            navigation.state[here + at.C_MINUS] = 0.0
            navigation.state[here + at.C_SIGN] = 1.0
            if number == 60:
                navigation.state[here + at.C_ONSET] = epoch.stamp * 1e-9 if held else 0.0
                navigation.state[here + at.C_SCORE : here + at.C_INFORMATION + 1] = 0.0
                signatures_of(navigation.state, navigation.channels)[channel] = 0.0
    return navigation


def test_the_signature_is_what_a_drift_does_to_the_estimate():
    scenario = replace(SHORT, duration=100.0)
    params = filter_params(scenario.budget, drift_probability=1e-15)
    channel, drift = 1, 0.01
    clean = _drive(simulate(scenario, 1), params, channel)
    fault = Fault('ramp', channel + 1, 60.0, drift)
    drifting = _drive(simulate(replace(scenario, faults=(fault,)), 1), params)
    signature = signatures_of(clean.state, clean.channels)[channel]
    shift = -error_of(drifting.nav, clean.nav)
    sigma = np.sqrt(np.diag(clean.covariance)[:9])
    np.testing.assert_allclose(drift * signature[:9] / sigma, shift / sigma, atol=2e-3)
    assert np.linalg.norm(shift[:3]) > 0.01
    here = at.HEAD + channel * at.CHANNEL_WIDTH
    for error, value in ((0, at.C_SLOW), (1, at.C_MULTIPATH)):
        index = at.CHANNEL + at.PER_CHANNEL * channel + error
        assert drift * signature[index] == pytest.approx(
            drifting.state[here + value] - clean.state[here + value], rel=0.05
        )


@pytest.mark.parametrize('seed', [1000, 1001, 1003])
def test_a_slow_ramp_is_found_and_its_trace_taken_out(seed):
    params = filter_params(SHORT.budget)
    fault = Fault('ramp', 2, 90.0, 0.5, 130.0)
    clean = evaluate(simulate(SHORT, seed), params, seed)
    result = evaluate(simulate(replace(SHORT, faults=(fault,)), seed), params, seed)
    refused = result.navigation.tally.sensor('gnss/code').rejected
    assert refused[DRIFTS] + refused['innovation gate'] >= 20
    effect = np.linalg.norm((result.errors - clean.errors)[:, :3], axis=1)
    assert effect.max() < 0.3
    assert effect[result.times >= 105.0].max() < 0.25


def test_a_code_comes_back_after_its_fault():
    params = filter_params(SHORT.budget)
    scenario = replace(SHORT, duration=220.0, faults=(Fault('ramp', 2, 90.0, 0.5, 130.0),))
    navigation = evaluate(simulate(scenario, 1003), params, 1003).navigation
    assert navigation.tally.sensor('gnss/code').rejected[DRIFTS] > 0
    assert navigation.state[at.HEAD + 1 * at.CHANNEL_WIDTH + at.C_BARRED] == 0.0


def test_without_a_satellite_to_spare_none_is_barred():
    scenario = replace(SHORT, outages=(Outage(0.0, 150.0, 4),), faults=(Fault('ramp', 1, 90.0, 0.5, 130.0),))
    navigation = evaluate(simulate(scenario, 2), filter_params(SHORT.budget), 2).navigation
    assert navigation.tally.sensor('gnss/code').rejected[DRIFTS] == 0


def test_good_codes_are_left_alone():
    refused = 0
    for seed in range(1010, 1016):
        result = evaluate(simulate(SHORT, seed), filter_params(SHORT.budget), seed)
        refused += result.navigation.tally.sensor('gnss/code').rejected[DRIFTS]
    # One false alarm bars a code for half a minute; 1e-4 of them is less than one in these runs.
    assert refused <= 40
