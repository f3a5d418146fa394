# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest

from ins_gps import layout as at
from ins_gps.evaluation import (
    START_SIGMAS,
    SYSTEMS,
    evaluate,
    filter_params,
    paper_systems,
)
from ins_gps.filter import NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.prediction import NAV_STATES, error_dynamics, hold_to, inject
from ins_gps.samples import Corrections, GnssEpoch, ImuSample
from ins_gps.simulation import DGPS, MEMS, MOTIONS, NOISELESS, STANDALONE, Fault, Outage, Scenario, _level
from ins_gps.simulation_gnss import simulate
from ins_gps.solution import error_of
from ins_gps.strapdown import increments, mechanise
from kalman_core.consistency import chi2_band
from kalman_core.rotation import matrix_from_quat, quat_from_euler

SHORT = Scenario(trajectory='s_turns', duration=150.0, imu_rate=50.0)


def test_error_dynamics_are_the_derivative_of_the_mechanisation():
    nav = np.r_[0.7, 1.9, 300.0, 20.0, -35.0, 2.0, quat_from_euler(0.1, -0.2, 1.0)]
    rate, force, dt = np.array([0.02, -0.03, 0.1]), np.array([0.5, 0.8, -9.7]), 1e-3
    F = np.empty((NAV_STATES, NAV_STATES))
    mat = matrix_from_quat(nav[6:10])
    error_dynamics(nav, mat @ force, mat, F)

    def advance(dx):
        state = np.zeros(at.state_size(1))
        state[at.NAVIGATION : at.NAVIGATION + 10] = nav
        full = np.zeros(at.error_states(1))
        full[:15] = dx
        inject(state, 1, full)
        inc = np.empty(6)
        w, f = rate - state[at.GYR_BIAS : at.GYR_BIAS + 3], force - state[at.ACC_BIAS : at.ACC_BIAS + 3]
        increments(w, f, w, f, dt, inc)
        out = state[at.NAVIGATION : at.NAVIGATION + 10]
        mechanise(out, inc, dt, np.empty(20))
        return out

    reference = advance(np.zeros(15))
    for column in range(15):
        step = np.zeros(15)
        step[column] = 10.0 if column < 3 else 1e-3
        size = step[column]
        derivative = (error_of(reference, advance(step)) - error_of(reference, advance(-step))) / (2.0 * size)
        start = np.zeros(9)
        if column < 9:
            start[column] = 1.0
        np.testing.assert_allclose(
            (derivative - start) / dt, F[:9, column], atol=3e-2 * np.abs(F[:9, column]).max() + 1e-8
        )


def test_noiseless_data_are_followed_to_millimetres():
    scenario = replace(SHORT, budget=NOISELESS, imu=replace(SHORT.imu, gyro_bias=0.0, accel_bias=0.0))
    params = filter_params(replace(NOISELESS, receiver=0.01), code_noise=0.01, carrier_noise=1e-3)
    result = evaluate(simulate(scenario, 0), params, 0)
    assert result.position[-1] < 0.02
    assert result.velocity[-1] < 0.01


@pytest.mark.parametrize('white', [True, False])
def test_error_is_what_the_covariance_says(white):
    budget = replace(DGPS, white=white)
    scenario = replace(SHORT, budget=budget)
    runs = 12
    position, all_nine = [], []
    for seed in range(runs):
        result = evaluate(simulate(scenario, seed), filter_params(budget), seed)
        late = result.after(60.0)
        position.append(result.nees(slice(0, 3))[late].mean())
        all_nine.append(result.nees()[late].mean())
    # Epochs of one run are correlated: the band is that of one value a run, at 99.9 %.
    low, high = chi2_band(0.999, dof=3, runs=runs)
    assert low < np.mean(position) < high
    low, high = chi2_band(0.999, dof=9, runs=runs)
    assert low < np.mean(all_nine) < high


def test_carrier_difference_beats_doppler_beats_code():
    run = simulate(SHORT, 1)
    mean = {
        mode: evaluate(run, filter_params(DGPS, mode=mode), 1).position[60:].mean()
        for mode in ('tight_code', 'tight_doppler', 'tight_tdcp')
    }
    assert mean['tight_tdcp'] < mean['tight_doppler'] < mean['tight_code']


def test_the_papers_order_holds():
    for seed in (100, 101):
        mean = {name: e.position.mean() for name, e in paper_systems(seed).items()}
        values = [mean[name] for name in SYSTEMS]
        assert values == sorted(values, reverse=True)


@pytest.mark.parametrize('left', [3, 2, 0])
def test_an_outage_is_survived_within_three_sigma(left):
    scenario = replace(SHORT, outages=(Outage(80.0, 110.0, left),))
    result = evaluate(simulate(scenario, 5), filter_params(DGPS), 5)
    assert result.within(3.5) == 1.0
    assert result.position[-1] < 0.5


@pytest.mark.parametrize('cycles', [1.0, -1.0, 2.0])
def test_a_single_slip_is_rejected_and_leaves_no_trace(cycles):
    clean = evaluate(simulate(SHORT, 6), filter_params(DGPS), 6)
    slipped = replace(SHORT, faults=(Fault('slip', 4, 100.0, cycles),))
    result = evaluate(simulate(slipped, 6), filter_params(DGPS), 6)
    assert result.navigation.tally.sensor('gnss/carrier').rejected['cycle slip'] >= 1
    assert np.abs(result.errors - clean.errors)[:, :3].max() < 0.05


@pytest.mark.parametrize(('kind', 'size'), [('jump', 20.0), ('jump', -20.0), ('ramp', 1.0)])
def test_a_faulty_satellite_does_little_harm(kind, size):
    clean = evaluate(simulate(SHORT, 7), filter_params(DGPS), 7)
    faulty = replace(SHORT, faults=(Fault(kind, 2, 90.0, size, 110.0),))
    result = evaluate(simulate(faulty, 7), filter_params(DGPS), 7)
    assert sum(result.navigation.tally.sensor('gnss/code').rejected.values()) >= 10
    assert np.linalg.norm((result.errors - clean.errors)[:, :3], axis=1).max() < 0.3


def test_a_receiver_clock_jump_is_taken_out_and_named():
    run = simulate(SHORT, 8)
    epochs = list(run.epochs)
    for k in range(100, len(epochs)):
        rows = epochs[k].rows.copy()
        rows[:, 3] += 299_792.458
        rows[:, 4] += 299_792.458 / 0.19029367
        epochs[k] = GnssEpoch(epochs[k].stamp, rows)
    result = evaluate(replace(run, epochs=epochs), filter_params(DGPS), 8)
    assert any('clock jumped' in reason for reason in result.navigation.tally.restarts)
    assert result.position[-1] < 1.0


def test_a_lever_arm_is_modelled_at_both_epochs():
    lever = (2.0, -1.0, 0.5)  # forward-right-down
    scenario = replace(SHORT, trajectory='flight', lever_arm=lever)
    params = filter_params(DGPS, lever_arm=(2.0, 1.0, -0.5))
    with_lever = evaluate(simulate(scenario, 9), params, 9)
    assert with_lever.position[60:].mean() < 0.5
    assert with_lever.navigation.tally.sensor('gnss/carrier').rejected['cycle slip'] == 0


def _held(cuts):
    """Return σ (9,) after an IMU that was silent for 4 s, brought there by `cuts` steps."""
    navigation = NavigationFilter(FilterParams())
    nav = np.r_[0.7, 1.9, 300.0, 20.0, -5.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    start = 10**18
    navigation.initialise(start, nav, np.r_[[1.0] * 3, [0.1] * 3, [0.01] * 3])
    rate, force = np.zeros(3), np.array([0.0, 0.0, -9.8])
    for i in range(1, 11):
        navigation.imu(ImuSample(start + i * 10_000_000, rate, force))
    start += 100_000_000
    for i in range(1, cuts + 1):
        when = divmod(start + round(i * 3.99e9 / cuts), 10**9)
        hold_to(navigation.state, navigation.channels, navigation.config, *when)
    navigation.imu(ImuSample(start + 4 * 10**9, rate, force))
    navigation.flush()
    return np.sqrt(np.diag(navigation.covariance)[:9])


def test_a_gap_of_the_imu_adds_the_same_however_epochs_cut_it():
    whole = _held(1)
    p = FilterParams()
    np.testing.assert_allclose(whole[6:9], 4.0 * p.gap_rate, rtol=0.01)
    assert (whole[3:6] > 4.0 * p.gap_force).all()
    for cuts in (4, 20, 40, 80):
        np.testing.assert_allclose(_held(cuts), whole, rtol=0.05)


@pytest.mark.parametrize('rate', [1.0, 5.0, 10.0])
def test_after_a_gap_of_the_imu_the_yaw_is_doubted_and_found_again(rate):
    scenario = Scenario(trajectory='s_turns', duration=35.0, imu_rate=50.0, gnss_rate=rate)
    run = simulate(scenario, 3)
    navigation = NavigationFilter(filter_params(DGPS))
    navigation.initialise(int(run.stamps[0]), run.truth[0], START_SIGMAS, tuple(run.clock[0]), (100.0, 3.0))
    imu = run.imu_samples()
    k = 1
    for epoch in run.epochs[1:]:
        while k < len(run.stamps) and run.stamps[k] <= epoch.stamp:
            if not 18.05e9 < run.stamps[k] - run.stamps[0] < 22.0e9:
                navigation.imu(imu[k - 1])
            k += 1
        navigation.gnss(epoch)
        if epoch.stamp - run.stamps[0] == 22 * 10**9:
            doubt = math.sqrt(navigation.covariance[8, 8])
    error = error_of(navigation.nav, run.truth[-1])
    assert doubt == pytest.approx(4.0 * FilterParams().gap_rate, rel=0.2)
    assert np.linalg.norm(error[:3]) < 2.0
    assert abs(error[8]) < math.radians(1.0)


@pytest.mark.parametrize('mode', ['gps', 'loose'])
def test_first_fixes_without_corrections_err_as_the_covariance_says(mode):
    nees = []
    for seed in range(60):
        scenario = Scenario(duration=2.0, imu_rate=10.0, budget=replace(STANDALONE, white=False))
        run = simulate(scenario, seed)
        params = filter_params(scenario.budget, mode=mode, alignment='velocity', code_slow=0.1)
        navigation = NavigationFilter(params)
        assert navigation.gnss(run.epochs[0]) is not None
        error = error_of(navigation.nav, run.truth[0])[:3]
        nees.append(error @ np.linalg.solve(navigation.covariance[:3, :3], error))
    low, high = chi2_band(0.99, 3, len(nees))
    assert low < np.mean(nees) < high


@pytest.mark.parametrize('begin', [True, False])
def test_corrections_that_begin_or_end_change_the_error_of_a_code(begin):
    """A satellite errs by 2.5 m without correction and by 0.1 m with it, 1 σ."""
    budget = replace(
        DGPS, ionosphere=0.0, troposphere=0.0, orbit=0.0, multipath=0.5, receiver=0.5, white=False
    )
    params = filter_params(budget, code_slow=0.1, code_slow_alone=2.5)
    scenario = Scenario(trajectory='s_turns', duration=100.0, imu_rate=20.0, budget=budget)
    nees, rejected = [], 0
    for seed in range(6):
        run = simulate(scenario, seed)
        slow = 2.5 * np.random.default_rng(seed).standard_normal(40)
        navigation = NavigationFilter(params)
        clock = tuple(run.clock[0])
        navigation.initialise(int(run.stamps[0]), run.truth[0], START_SIGMAS, clock, (100.0, 3.0))
        imu = iter(run.imu_samples())
        sample = next(imu)
        for k, epoch in enumerate(run.epochs[1:]):
            while sample is not None and sample.stamp <= epoch.stamp:
                navigation.imu(sample)
                sample = next(imu, None)
            own = slow[epoch.rows[:, 1].astype(int)]
            epoch.rows[:, 3] += own
            if (k >= 50) == begin:
                zero = np.zeros(len(own))
                rows = np.column_stack([zero, epoch.rows[:, 1], -own, zero, zero])
                navigation.corrections(Corrections(epoch.stamp, rows))
            navigation.gnss(epoch)
        error = error_of(navigation.nav, run.truth[-1])[:3]
        P = navigation.covariance[:3, :3]
        nees.append(error @ np.linalg.solve(P, error))
        rejected += navigation.tally.sensor('gnss/code').rejected.total()
        assert (np.trace(P) < 1.0) or not begin
    low, high = chi2_band(0.99, 3, len(nees))
    assert low < np.mean(nees) < high
    assert rejected <= 6


def test_it_starts_from_rest_and_aligns_by_the_course():
    run = simulate(replace(SHORT, trajectory='flight', clock=replace(SHORT.clock, bias=-3e5)), 10)
    navigation = NavigationFilter(FilterParams(channels=8, elevation_mask=0.0, code_multipath=0.5))
    from ins_gps.batch import run_batch

    history = run_batch(navigation, run.stamps[1:], run.rate, run.force, run.epochs)
    assert navigation.running
    index = np.searchsorted(run.stamps, history.stamps[-1])
    error = error_of(history.nav[-1], run.truth[index])
    assert np.linalg.norm(error[:3]) < 5.0
    assert abs(error[8]) < math.radians(5.0)


def _south(t):
    one = np.ones_like(t)
    return _level(math.pi * one, 0.0 * one, 0.3 * np.sin(0.2 * t), 0.3 * np.sin(0.15 * t))


@pytest.mark.parametrize('mode', ['tight_tdcp', 'loose'])
@pytest.mark.parametrize('lever', [(0.0, 0.0, 0.0), (1.0, 0.0, -1.0), (3.0, 0.5, -2.0)])
def test_it_starts_by_the_course_with_the_antenna_beside_the_imu(mode, lever, monkeypatch):
    monkeypatch.setitem(MOTIONS, 'south', (_south, (-10.0, 0.0, 0.0)))
    scenario = Scenario(trajectory='south', duration=25.0, imu_rate=50.0, imu=MEMS, lever_arm=lever)
    run = simulate(scenario, 2)
    x, y, z = lever
    navigation = NavigationFilter(FilterParams(lever_arm=(x, -y, -z), mode=mode))
    imu = iter(run.imu_samples())
    sample = next(imu)
    for epoch in run.epochs:
        while sample is not None and sample.stamp <= epoch.stamp:
            navigation.imu(sample)
            sample = next(imu, None)
        navigation.gnss(epoch)
        since = (epoch.stamp - run.stamps[0]) * 1e-9
        if since > 5.0:
            error = error_of(navigation.nav, run.truth[np.searchsorted(run.stamps, epoch.stamp)])
            P = navigation.covariance[:9, :9]
            assert error @ np.linalg.solve(P, error) < 9.0 * 4.0, since
    assert navigation.tally.sensor('gnss/carrier').rejected.total() == 0


@pytest.mark.parametrize('budget', [DGPS, STANDALONE])
def test_fixes_whose_errors_last_are_not_averaged_away(budget):
    nees = []
    for seed in range(8):
        lasting = replace(budget, white=False)
        run = simulate(replace(SHORT, duration=300.0, imu_rate=20.0, budget=lasting), seed)
        result = evaluate(run, filter_params(lasting, mode='loose'), seed)
        nees.append(result.nees(slice(0, 3))[result.after(60.0)].mean())
    # 3 expected; taken as white they were 32 and 270.
    assert 1.5 < np.mean(nees) < 6.0


@pytest.mark.parametrize('alignment', ['given', 'velocity'])
@pytest.mark.parametrize('mode', ['tight_tdcp', 'loose'])
def test_a_false_position_recovers_and_says_so(mode, alignment):
    from ins_gps.batch import run_batch

    nees = []
    for seed in range(11, 19):
        run = simulate(SHORT, seed)
        navigation = NavigationFilter(filter_params(DGPS, lost_time=5.0, mode=mode, alignment=alignment))
        nav = run.truth[0].copy()
        nav[0] += 1e-3  # 6 km, believed to 1 m
        navigation.initialise(int(run.stamps[0]), nav, START_SIGMAS, run.clock[0], (1.0, 0.1))
        history = run_batch(navigation, run.stamps[1:], run.rate, run.force, run.epochs)
        error = error_of(history.nav[-1], run.truth[np.searchsorted(run.stamps, history.stamps[-1])])
        assert np.linalg.norm(error[:3]) < 2.0
        assert len(navigation.tally.restarts) == 1
        nees.append(error @ np.linalg.solve(navigation.covariance[:9, :9], error))
    low, high = chi2_band(0.99, 9, len(nees))
    assert low < np.mean(nees) < high


def test_bad_samples_are_counted_and_harmless():
    run = simulate(replace(SHORT, duration=20.0), 12)
    navigation = NavigationFilter(filter_params(DGPS))
    navigation.initialise(int(run.stamps[0]), run.truth[0], START_SIGMAS)
    stamps = run.stamps
    navigation.imu(ImuSample(int(stamps[1]), np.full(3, np.nan), run.force[0]))
    navigation.imu(ImuSample(int(stamps[1]), run.rate[0], np.zeros(3)))
    navigation.imu(ImuSample(int(stamps[2]), run.rate[1], run.force[1]))
    navigation.imu(ImuSample(int(stamps[2]), run.rate[1], run.force[1]))
    rows = run.epochs[1].rows.copy()
    rows[0, 3] = np.inf
    rows[1, 9] = np.nan
    rows[2, 1] = 99.0
    rows[3, 4] = -np.inf
    navigation.gnss(GnssEpoch(int(stamps[3]), rows))
    navigation.gnss(GnssEpoch(int(stamps[4]), np.empty((0, rows.shape[1]))))
    navigation.gnss(GnssEpoch(int(stamps[4]), rows))
    expected = {'not finite': 1, 'zero specific force': 1, 'not newer than the last': 1}
    assert navigation.tally.sensor('imu/data_raw').rejected == expected
    assert navigation.tally.sensor('gnss/observations').rejected['unknown satellite or signal'] == 2
    assert np.isfinite(navigation.state).all()
