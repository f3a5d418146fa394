# SPDX-License-Identifier: Apache-2.0
"""Errors of fixes that last: their states, and what a receiver without corrections does to the filter."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_external_fixes import RUN, SCENARIO, SIGMA, errors, feed, fixes, moved

from ins_gps import layout as at
from ins_gps.evaluation import filter_params
from ins_gps.filter import NavigationFilter
from ins_gps.lasting import add_rows, age_errors, start_errors
from ins_gps.params import FilterParams
from ins_gps.samples import GROUND_CORRECTIONS, PositionSample
from ins_gps.simulation import DGPS, HG1700, MEMS
from ins_gps.simulation_gnss import simulate
from ins_gps.smoother import Smoother
from ins_gps.solution import error_of

TIME = 60.0
FAST, SLOW = slice(at.FIX, at.FIX + 3), slice(at.FIX + 3, at.FIX + 6)


def lasting(share, seed):
    """Return a spoiler of fixes: errors of TIME but for the `share` of their variance that is white."""
    decay, kept, rng = math.exp(-1.0 / TIME), [np.zeros(3)], np.random.default_rng(1000 + seed)

    def spoil(second, ned):
        kept[0] = ned if second == 0 else decay * kept[0] + math.sqrt(1.0 - decay**2) * ned
        return math.sqrt(1.0 - share) * kept[0] + math.sqrt(share) * SIGMA * rng.standard_normal(3)

    return spoil


def consistency(imu, speeds, params, share, seeds):
    """Return mean NEES of position (3 expected) and rms of position and velocity errors, after 60 s."""
    nees, found = [], []
    for seed in range(seeds):
        run = simulate(replace(SCENARIO, duration=300.0, imu=imu), 200 + seed)
        samples = fixes(run, seed, lasting(share, seed))
        samples = [s for s in samples if speeds or type(s) is PositionSample]
        _, estimates, _ = feed(run, samples, params)
        settled = [e for e in estimates[::50] if (e.stamp - run.stamps[0]) * 1e-9 > 60.0]
        error = errors(run, settled, 0.0)[0]
        P = np.array([e.covariance[:3, :3] for e in settled])
        nees.append(
            np.mean(np.einsum('ki,ki->k', error[:, :3], np.linalg.solve(P, error[:, :3, None])[..., 0]))
        )
        found.append(np.mean(error**2, axis=0))
    rms = np.sqrt(np.mean(found, axis=0))
    return np.mean(nees), np.linalg.norm(rms[:3]), np.linalg.norm(rms[3:])


def test_errors_that_last_are_not_averaged_away():
    params = filter_params(DGPS, HG1700, mode='loose', alignment='velocity')
    white, white_error, _ = consistency(HG1700, True, replace(params, fix_time=0.0), params.fix_white, 6)
    nees, error, _ = consistency(HG1700, True, params, params.fix_white, 6)
    assert 1.5 < nees < 6.0
    assert white > 5.0 * nees
    assert error < white_error


def test_positions_alone_start_a_cheap_imu_and_still_show_how_it_moves():
    """Counted as weakly as they average, such fixes would not even show the course to start with."""
    params = filter_params(DGPS, MEMS, mode='loose', alignment='velocity')
    nees, _, speed = consistency(MEMS, False, params, params.fix_white, 4)
    assert nees < 6.0
    assert speed < 0.25


def test_smoothing_knows_what_all_fixes_have_in_common():
    params = filter_params(DGPS, HG1700, mode='loose', alignment='velocity')
    nees = []
    for seed in range(3):
        run = simulate(replace(SCENARIO, duration=240.0), 300 + seed)
        samples = [s for s in fixes(run, seed, lasting(params.fix_white, seed)) if type(s) is PositionSample]
        result = Smoother(params).run(run.stamps[1:], run.rate, run.force, samples)
        for stamp, nav, P in zip(result.stamps, result.smoothed, result.smoothed_covariance, strict=True):
            error = error_of(nav, run.truth[np.searchsorted(run.stamps, stamp)])[:3]
            nees.append(error @ np.linalg.solve(P[:3, :3], error))
    # 3 expected of few independent errors; taken as white they were 176.
    assert np.mean(nees) < 10.0


def test_white_errors_of_a_simulator_do_no_harm():
    params = filter_params(DGPS, MEMS, mode='loose', alignment='velocity')
    nees, error, _ = consistency(MEMS, True, params, 1.0, 4)
    assert nees < 4.0
    assert error < 0.5 * np.linalg.norm(SIGMA)


def test_fixes_with_a_ground_stations_corrections_are_taken_as_white():
    samples = fixes(RUN, 1)
    helped = [s._replace(status=GROUND_CORRECTIONS) if type(s) is PositionSample else s for s in samples]
    params = filter_params(DGPS, HG1700, mode='loose', alignment='velocity')
    _, with_help, _ = feed(RUN, helped, params)
    _, white, _ = feed(RUN, samples, replace(params, fix_time=0.0))
    _, without, _ = feed(RUN, samples, params)
    assert np.array_equal(with_help[-1].geodetic, white[-1].geodetic)
    assert np.trace(without[-1].covariance[:3, :3]) > 2.0 * np.trace(white[-1].covariance[:3, :3])


def test_a_better_kind_of_fix_is_not_held_by_the_errors_of_the_worse():
    """Code fixes 4 m off for a minute, then the same receiver resolves its ambiguities."""
    off, fine = np.array([3.0, -2.0, 2.0]), 0.02
    run = simulate(replace(SCENARIO, duration=80.0), 7)
    samples = []
    for s in (s for s in fixes(run, 3, lambda _, ned: 0.1 * ned) if type(s) is PositionSample):
        if (s.stamp - run.stamps[0]) * 1e-9 < 60.0:
            samples.append(s._replace(geodetic=moved(s.geodetic, off)))
        else:
            exact = run.truth[np.searchsorted(run.stamps, s.stamp), :3]
            samples.append(PositionSample(s.stamp, exact, np.eye(3) * fine**2, GROUND_CORRECTIONS))
    params = filter_params(DGPS, HG1700, mode='loose', alignment='velocity')
    estimator, estimates, _ = feed(run, samples, params)
    error, nees = errors(run, estimates, 65.0)
    assert np.abs(error[:, :3]).max() < 5.0 * fine
    assert nees.mean() < 12.0
    assert not estimator.tally.restarts


def started(covariance, shares):
    navigation = NavigationFilter(FilterParams(channels=4))
    navigation.initialise(10**9, np.r_[0.5, 0.1, 50.0, np.zeros(3), 1.0, 0.0, 0.0, 0.0], np.full(9, 0.1))
    navigation.covariance[:3, :3] = covariance
    start_errors(navigation.state, 4, covariance, shares)
    return navigation.state, navigation.covariance


def test_a_start_from_a_fix_shares_its_errors():
    covariance = np.diag([4.0, 9.0, 16.0])
    _, P = started(covariance, ((0.5, 10.0), (0.3, 100.0)))
    assert np.array_equal(P[FAST, :3], -0.5 * covariance)
    assert np.array_equal(P[:3, SLOW], -0.3 * covariance)
    assert np.linalg.eigvalsh(P)[0] > -1e-9
    # The same fix again, with nothing new in it but its white share, is no second opinion.
    H = np.zeros((3, len(P)))
    H[:, :3] = np.eye(3)
    add_rows(np.zeros(at.state_size(4)), H, np.zeros(3))
    assert np.allclose(H @ P @ H.T, 0.2 * covariance)


def test_errors_fade_towards_what_the_fix_says():
    covariance = np.diag([4.0, 9.0, 16.0])
    shares = ((0.5, 10.0), (0.3, 100.0))
    state, P = started(covariance, shares)
    state[at.FIX_ERROR : at.FIX_ERROR + 6] = 1.0
    P[FAST, FAST] = 0.0
    white = age_errors(state, 4, covariance, 10.0, shares)
    assert np.allclose(white, 0.2 * covariance)
    assert np.allclose(state[at.FIX_ERROR : at.FIX_ERROR + 6], np.repeat(np.exp([-1.0, -0.1]), 3))
    assert np.allclose(P[FAST, FAST], 0.5 * (1.0 - math.exp(-2.0)) * covariance)
    assert np.allclose(P[SLOW, SLOW], 0.3 * covariance)
    assert np.allclose(P[SLOW, :3], -0.3 * math.exp(-0.1) * covariance)


def test_a_fix_is_never_all_alike_the_last():
    covariance = np.diag([4.0, 9.0, 16.0])
    state, _ = started(covariance, ((1.0, 60.0),))
    white = age_errors(state, 4, covariance, 1.0, ((0.6, 60.0), (0.4, 600.0)))
    assert np.allclose(white, 0.01 * covariance)


@pytest.mark.parametrize(('factor', 'anew'), [(0.2, True), (0.3, False), (3.5, False), (4.5, True)])
def test_another_kind_of_solution_has_errors_of_its_own(factor, anew):
    covariance = np.eye(3)
    state, P = started(covariance, ((0.7, 60.0),))
    state[at.FIX_ERROR] = 1.0
    age_errors(state, 4, factor * covariance, 1.0, ((0.7, 60.0),))
    assert (state[at.FIX_ERROR] == 0.0) == anew
    assert (not P[FAST, :3].any()) == anew
    if anew:
        assert np.allclose(P[FAST, FAST], 0.7 * factor * covariance)
