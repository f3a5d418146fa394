# SPDX-License-Identifier: Apache-2.0
"""Loose coupling: positions and velocities that a receiver has computed itself."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ins_gps.estimator import InsGpsEstimator
from ins_gps.evaluation import filter_params
from ins_gps.params import FilterParams
from ins_gps.samples import FixEstimate, GnssEpoch, NavigationEstimate, PositionSample, VelocitySample
from ins_gps.simulation import DGPS, HG1700, MEMS, MOTIONS, Scenario, _level
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import error_of
from kalman_core.consistency import chi2_band
from kalman_core.earth import ecef_from_geodetic, geodetic_from_ecef

SCENARIO = Scenario(trajectory='s_turns', duration=120.0, imu_rate=50.0, imu=HG1700)
SIGMA, SPEED_SIGMA = np.array([1.5, 1.5, 3.0]), 0.1  # m NED, m/s
RUN = simulate(SCENARIO, 1)


def moved(geodetic, ned):
    """Return `geodetic` (rad, m) moved by `ned` (m)."""
    from kalman_core.earth import mat_ecef_from_ned

    at = np.array(ecef_from_geodetic(*geodetic)) + mat_ecef_from_ned(geodetic[0], geodetic[1]) @ ned
    return np.array(geodetic_from_ecef(at))


def fixes(run, seed, spoil=lambda second, ned: ned):
    """Return a fix and a velocity per second of `run`, with white errors of SIGMA and SPEED_SIGMA."""
    rng = np.random.default_rng(seed)
    samples = []
    for i in range(0, len(run.stamps), 50):
        truth, stamp = run.truth[i], int(run.stamps[i])
        ned = spoil(i // 50, SIGMA * rng.standard_normal(3))
        samples.append(PositionSample(stamp, moved(truth[:3], ned), np.diag(SIGMA**2)))
        speed = truth[3:6] + SPEED_SIGMA * rng.standard_normal(3)
        samples.append(VelocitySample(stamp, speed, np.eye(3) * SPEED_SIGMA**2))
    return samples


def feed(run, samples, params):
    """Run IMU and `samples` in order of time; return the estimator, its estimates and its fixes."""
    estimator = InsGpsEstimator(params)
    handlers = {PositionSample: estimator.on_position, VelocitySample: estimator.on_velocity}
    events = sorted([*run.imu_samples(), *samples], key=lambda s: s.stamp)
    out = []
    for sample in events:
        out += handlers.get(type(sample), estimator.on_imu)(sample) or []
    return (
        estimator,
        [e for e in out if type(e) is NavigationEstimate],
        [e for e in out if type(e) is FixEstimate],
    )


def errors(run, estimates, after):
    """Return position and velocity errors (k, 6) and their squares over covariance (k,), `after` s."""
    index = {int(s): i for i, s in enumerate(run.stamps)}
    rows, nees = [], []
    for e in estimates:
        if (e.stamp - run.stamps[0]) * 1e-9 < after:
            continue
        nav = np.r_[e.geodetic, e.velocity, e.q_nb]
        error = error_of(nav, run.truth[index[e.stamp]])[:6]
        rows.append(error)
        nees.append(error @ np.linalg.solve(e.covariance[:6, :6], error))
    return np.array(rows), np.array(nees)


# Where a test does not say otherwise, the errors of its fixes are white.
PARAMS = filter_params(DGPS, HG1700, mode='loose', alignment='velocity', fix_time=0.0)


def test_fixes_and_velocities_alone_start_it_and_are_smoothed_by_the_imu():
    _, estimates, answers = feed(RUN, fixes(RUN, 1), PARAMS)
    error, _ = errors(RUN, estimates, 60.0)
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert (rms[:3] < 0.6 * SIGMA).all(), rms
    assert (rms[3:] < SPEED_SIGMA).all(), rms
    assert len(answers) > 100


def test_its_error_is_what_its_covariance_says():
    nees = []
    for seed in range(12):
        run = simulate(SCENARIO, 100 + seed)
        _, estimates, _ = feed(run, fixes(run, seed), PARAMS)
        nees.append(errors(run, estimates[-1:], 0.0)[1][0])
    low, high = chi2_band(0.95, 6, 12)
    assert low < np.mean(nees) < high


def test_a_wild_fix_is_refused_and_a_lasting_one_taken_after_the_lost_time():
    def wild(second, ned):
        return ned + (np.array([300.0, 0.0, 0.0]) if second == 60 or second >= 80 else 0.0)

    estimator, estimates, _ = feed(RUN, fixes(RUN, 2, wild), replace(PARAMS, lost_time=10.0))
    seen = estimator.tally.sensor('gnss/fix')
    assert 10 <= seen.rejected['innovation gate'] <= 12
    assert any('rejected for 10 s, taken again' in text for text in estimator.tally.restarts)
    second = np.array([(e.stamp - RUN.stamps[0]) * 1e-9 for e in estimates])
    north = errors(RUN, estimates, 0.0)[0][:, 0]
    assert np.abs(north[(second > 60.0) & (second < 62.0)]).max() < 5.0
    # Who gives fixes for so long is believed at once, not by and by.
    assert np.abs(north[second > 100.0] + 300.0).max() < 5.0


def test_precise_fixes_that_come_late_weigh_less_but_do_not_lock_it_out():
    """RTK fixes stamped 0.1 s late are 2 m off at 22 m/s, a hundred times their σ."""
    run = simulate(replace(SCENARIO, trajectory='flight'), 1)
    sigma, late = np.array([0.02, 0.02, 0.04]), 5
    rng = np.random.default_rng(3)
    samples = []
    for i in range(50, len(run.stamps), 12):
        geodetic = moved(run.truth[i - late, :3], sigma * rng.standard_normal(3))
        samples.append(PositionSample(int(run.stamps[i]), geodetic, np.diag(sigma**2)))
    estimator, estimates, _ = feed(run, samples, PARAMS)
    assert estimator.tally.sensor('gnss/fix').rejected['innovation gate']
    assert not estimator.tally.restarts
    error = errors(run, estimates, 30.0)[0]
    speed = np.linalg.norm(run.truth[:, 3:6], axis=1).max()
    assert np.linalg.norm(error[:, :3], axis=1).max() < 1.2 * speed * 0.1


@pytest.mark.parametrize('off', [30.0, 3e3, 3e5])
def test_the_further_off_a_fix_is_the_less_it_moves(off):
    def wild(second, ned):
        return ned + np.array([off, 0.0, 0.0]) * (second == 60)

    _, estimates, _ = feed(RUN, fixes(RUN, 2, wild), PARAMS)
    _, clean, _ = feed(RUN, fixes(RUN, 2), PARAMS)
    moves = max(np.linalg.norm(a.enu - b.enu) for a, b in zip(estimates, clean, strict=True))
    # P·gate/|innovation| with a gate of 31 and a σ of the estimate below 0.9 m; and the good fix is missing.
    assert moves < 31.0 * 0.9**2 / off + 0.5


@pytest.mark.parametrize(
    ('geodetic', 'covariance', 'reason'),
    [
        ((math.nan, 0.0, 0.0), np.eye(3), 'not finite'),
        ((0.1, 0.2, 1e12), np.eye(3), 'implausible value'),
        ((0.1, 0.2, 0.0), np.zeros((3, 3)), 'covariance not positive definite'),
    ],
)
def test_what_is_no_fix_is_refused_by_name(geodetic, covariance, reason):
    estimator = InsGpsEstimator(FilterParams(mode='loose'))
    assert estimator.on_position(PositionSample(10**9, np.array(geodetic), covariance)) is None
    assert estimator.on_velocity(VelocitySample(10**9, np.array(geodetic), covariance)) is None
    assert estimator.tally.sensor('gnss/fix').rejected == {reason: 1}
    assert estimator.tally.sensor('gnss/velocity').rejected == {reason: 1}


def test_a_velocity_before_any_fix_is_refused_and_starts_nothing():
    estimator = InsGpsEstimator(FilterParams(mode='loose'))
    estimator.on_velocity(VelocitySample(10**9, np.zeros(3), np.eye(3)))
    assert not estimator.navigation.running
    assert 'no position to start from yet' in estimator.tally.sensor('gnss/velocity').rejected


def _accelerating(t):
    one = np.ones_like(t)
    return _level(0.0 * t, 0.0 * t, 2.5 * one, 0.0 * t)


@pytest.mark.parametrize('source', ['observations', 'fixes', 'fixes and velocities'])
def test_it_aligns_within_three_sigma_while_it_accelerates(source, monkeypatch):
    monkeypatch.setitem(MOTIONS, 'car', (_accelerating, (3.0, 0.0, 0.0)))
    run = simulate(Scenario(trajectory='car', duration=8.0, imu_rate=50.0, imu=MEMS), 2)
    mode = 'tight_tdcp' if source == 'observations' else 'loose'
    estimator = InsGpsEstimator(FilterParams(mode=mode))
    samples = {
        'observations': run.epochs,
        'fixes': [s for s in fixes(run, 1, lambda _, ned: 0.02 * ned) if type(s) is PositionSample],
        'fixes and velocities': fixes(run, 1),
    }[source]
    if source == 'fixes':
        samples = [s._replace(covariance=s.covariance * 0.02**2) for s in samples]
    handlers = {
        PositionSample: estimator.on_position,
        VelocitySample: estimator.on_velocity,
        GnssEpoch: estimator.on_gnss,
    }
    for sample in sorted([*run.imu_samples(), *samples], key=lambda s: s.stamp):
        handlers.get(type(sample), estimator.on_imu)(sample)
        if estimator.navigation.running:
            break
    assert estimator.navigation.running
    truth = run.truth[np.searchsorted(run.stamps, sample.stamp)]
    tilt = error_of(estimator.navigation.nav, truth)[6:8]
    sigma = np.sqrt(np.diag(estimator.navigation.covariance)[6:8])
    assert (np.abs(tilt) < 3.0 * sigma).all(), np.degrees(tilt)
    # 2.5 m/s² taken for a tilt would be 14 degrees.
    assert (np.abs(tilt) < math.radians(7.0)).all(), np.degrees(tilt)


@pytest.mark.parametrize('speeds', [False, True])
def test_a_flight_that_starts_itself_errs_as_its_covariance_says(speeds):
    scenario = Scenario(trajectory='flight', duration=60.0, imu_rate=50.0, imu=MEMS)
    nees = []
    for seed in range(6):
        run = simulate(scenario, 20 + seed)
        samples = [s for s in fixes(run, seed) if speeds or type(s) is PositionSample]
        estimator, estimates, _ = feed(run, samples, FilterParams(mode='loose', fix_time=0.0))
        nees.append(errors(run, estimates[-1:], 0.0)[1][0])
        assert not estimator.tally.sensor('gnss/fix').rejected
    assert np.mean(nees) < chi2_band(0.999, 6, 6)[1]
