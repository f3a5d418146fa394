# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from bag_tools.bag import BagError, BagReader
from ins_gps import layout as at
from ins_gps.bag_smoother import smooth_bag
from ins_gps.evaluation import START_SIGMAS, filter_params
from ins_gps.filter import NavigationFilter
from ins_gps.fixtures import write_run
from ins_gps.nodes.smoother import run as command
from ins_gps.params import FilterParams
from ins_gps.samples import GnssEpoch, PositionSample
from ins_gps.simulation import DGPS, Outage, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.smoother import Smoother, _freeze
from ins_gps.solution import displaced, error_of
from kalman_core.consistency import chi2_band
from kalman_core.parameters import ParameterError

OUTAGE = Scenario(
    trajectory='s_turns', duration=120.0, imu_rate=20.0, outages=(Outage(40.0, 100.0, 0),), budget=DGPS
)


def _start(navigation, run, seed, sigmas=START_SIGMAS):
    rng = np.random.default_rng([seed, 77])
    nav = displaced(run.truth[0], sigmas * rng.standard_normal(9))
    clock = run.clock[0] + np.array([100.0, 3.0]) * rng.standard_normal(2)
    navigation.initialise(int(run.stamps[0]), nav, sigmas, clock, (100.0, 3.0))


def _smooth(run, params, seed):
    smoother = Smoother(params)
    _start(smoother.navigation, run, seed)
    return smoother.run(run.stamps[1:], run.rate, run.force, run.epochs)


def _errors(run, stamps, solutions):
    index = np.searchsorted(run.stamps, stamps)
    return np.array([error_of(nav, run.truth[i]) for nav, i in zip(solutions, index, strict=True)])


# What is constant per satellite in the correlated budget no smoother can know: it bounds the gain.
@pytest.mark.parametrize(('white', 'better'), [(True, 4.0), (False, 1.5)])
def test_a_minute_without_satellites_is_mended_and_the_covariance_says_how_well(white, better):
    budget = replace(DGPS, white=white)
    filtered, smoothed, nees, before = [], [], [], []
    runs = 10
    for seed in range(runs):
        run = simulate(replace(OUTAGE, budget=budget), seed)
        out = _smooth(run, filter_params(budget), seed)
        seconds = (out.stamps - run.stamps[0]) * 1e-9
        inside = (seconds >= 40.0) & (seconds < 100.0)
        assert inside.sum() == 60
        f, s = _errors(run, out.stamps, out.filtered), _errors(run, out.stamps, out.smoothed)
        filtered.append(np.linalg.norm(f[inside, :3], axis=1).mean())
        smoothed.append(np.linalg.norm(s[inside, :3], axis=1).mean())
        whitened = np.linalg.solve(out.smoothed_covariance, s[..., None])[..., 0]
        nees.append(np.einsum('ki,ki->k', s, whitened).mean())
        variance = np.einsum('kii->ki', out.smoothed_covariance)
        before.append((variance / np.einsum('kii->ki', out.filtered_covariance)).max())
    assert np.mean(smoothed) < np.mean(filtered) / better
    low, high = chi2_band(0.999, dof=9, runs=runs)
    assert low < np.mean(nees) < high
    assert max(before) < 1.0 + 1e-6


def test_it_agrees_with_a_copy_of_one_instant_carried_to_the_end():
    # Fixed-point smoothing: the errors at one epoch stay frozen in the state while the whole rest is used.
    # With slips, satellites that come and go, and correlated errors.
    scenario = replace(OUTAGE, duration=60.0, outages=(Outage(30.0, 40.0, 2),))
    budget = replace(DGPS, white=False)
    run = simulate(replace(scenario, budget=budget), 3)
    params = filter_params(budget)
    out = _smooth(run, params, 3)
    instant = 28
    navigation = NavigationFilter(params, copies=at.copied_states(params.channels))
    _start(navigation, run, 3)
    done = 0
    samples = run.imu_samples()
    for number, epoch in enumerate(run.epochs):
        while done < len(samples) and samples[done].stamp <= epoch.stamp:
            navigation.imu(samples[done])
            done += 1
        navigation.gnss(epoch)
        if number == instant:
            navigation.flush()
            _freeze(navigation.state, navigation.channels)
            nav = navigation.nav.copy()
    count = at.copied_states(params.channels)
    change = navigation.state[-count:][:9]
    covariance = navigation.covariance[-count:, -count:][:9, :9]
    assert out.stamps[instant] == run.epochs[instant].stamp
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(error_of(nav, out.smoothed[instant]) / sigma, change / sigma, atol=1e-5)
    np.testing.assert_allclose(
        out.smoothed_covariance[instant] / np.outer(sigma, sigma),
        covariance / np.outer(sigma, sigma),
        atol=1e-5,
    )


def test_the_solution_between_anchors_has_no_steps():
    run = simulate(replace(OUTAGE, duration=80.0, outages=(Outage(30.0, 60.0, 1),)), 4)
    out = _smooth(run, filter_params(DGPS), 4)
    error = _errors(run, out.imu_stamps, out.imu_smoothed)[:, :3]
    assert len(error) > 1500
    assert np.linalg.norm(np.diff(error, axis=0), axis=1).max() < 0.02
    anchors = _errors(run, out.stamps, out.smoothed)[:, :3]
    assert np.linalg.norm(error, axis=1).max() < 1.2 * np.linalg.norm(anchors, axis=1).max()


def test_a_run_that_starts_anew_is_smoothed_in_parts():
    run = simulate(replace(OUTAGE, duration=60.0, outages=()), 5)
    smoother = Smoother(filter_params(DGPS, alignment='velocity', initial_tilt_sigma=0.1))
    _start(smoother.navigation, run, 5)
    keep = (np.arange(len(run.rate)) < 500) | (np.arange(len(run.rate)) > 800)  # 15 s of silence
    epochs = [e for e in run.epochs if not 500 < (e.stamp - run.stamps[0]) * 2e-8 <= 800]
    out = smoother.run(run.stamps[1:][keep], run.rate[keep], run.force[keep], epochs)
    assert smoother.navigation.tally.restarts == ['no IMU for more than 10 s']
    error = np.linalg.norm(_errors(run, out.stamps, out.smoothed)[:, :3], axis=1)
    assert np.isfinite(out.smoothed_covariance).all()
    assert error.max() < 5.0


def test_fixes_alone_are_smoothed_too():
    run = simulate(replace(OUTAGE, trajectory='flight', duration=100.0), 8)
    rng = np.random.default_rng(8)
    samples = []
    for index in range(0, 2001, 20):
        if 900 <= index < 1500:
            continue
        noise = rng.normal(0.0, 0.5, 3) / np.array([6.4e6, 6.0e6, 1.0])
        samples.append(PositionSample(int(run.stamps[index]), run.truth[index, :3] + noise, np.eye(3) * 0.25))
    params = FilterParams(mode='loose', channels=4, accel_bias_sigma=0.05, gyro_bias_sigma=1e-4)
    out = Smoother(params).run(run.stamps[1:], run.rate, run.force, samples)
    inside = (out.stamps > run.stamps[900]) & (out.stamps < run.stamps[1499])
    filtered = np.linalg.norm(_errors(run, out.stamps, out.filtered)[:, :3], axis=1)
    smoothed = np.linalg.norm(_errors(run, out.stamps, out.smoothed)[:, :3], axis=1)
    assert smoothed[inside].max() < 0.5 * filtered[inside].max()


def test_a_memoryless_mode_is_refused():
    with pytest.raises(ParameterError, match='no memory'):
        Smoother(FilterParams(mode='gps'))


def test_a_bag_is_smoothed_from_file_to_file(tmp_path, capsys):
    run = simulate(replace(OUTAGE, duration=40.0, outages=(Outage(15.0, 25.0, 0),)), 6)
    # An epoch that arrives late and rows that say nothing do not matter.
    epochs = [*run.epochs, GnssEpoch(int(run.stamps[-1]), run.epochs[-1].rows[:0])]
    write_run(tmp_path / 'in', replace(run, epochs=epochs[:-1]), {10: 300_000_000})
    target = str(tmp_path / 'out')
    options = ['--ros-args', '-p', 'alignment:=given', '-p', 'initial_attitude:=[0.0, 0.0, 1.5707963]']
    options += ['-p', 'elevation_mask:=0.0', '-p', 'channels:=8']
    assert command([str(tmp_path / 'in'), target, '--copy', '/truth/odometry', *options]) == 0
    assert '41 in   /gnss/observations' in capsys.readouterr().out
    with BagReader(target) as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
        assert counts['/odometry_smoothed'] > 780
        assert counts['/position_smoothed'] >= 41
        assert counts['/truth/odometry'] == 81
        stamps = [time for _, time, _ in bag.messages()]
        assert stamps == sorted(stamps)
        for _, _, data in bag.messages(['/odometry_smoothed']):
            message = bag.decode(data, 'nav_msgs/msg/Odometry')
            assert np.linalg.eigvalsh(np.reshape(message.pose.covariance, (6, 6)))[0] > 0.0


def test_a_bag_without_an_imu_is_named(tmp_path):
    run = simulate(replace(OUTAGE, duration=5.0), 6)
    write_run(tmp_path / 'in', run)
    with pytest.raises(BagError, match='needs /imu/other'):
        smooth_bag(tmp_path / 'in', tmp_path / 'out', FilterParams(), {'imu/data_raw': '/imu/other'})
    with pytest.raises(BagError, match='no position and attitude'):
        smooth_bag(tmp_path / 'in', tmp_path / 'out', FilterParams(alignment_speed=200.0))
    assert not (tmp_path / 'out').exists()
