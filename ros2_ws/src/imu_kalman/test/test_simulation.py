# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imu_kalman.sim_params import MOTIONS, SimulatorParams
from imu_kalman.simulation import ImuSimulator, simulate
from imu_kalman.simulation_errors import Flicker, GaussMarkov, RandomWalk, White, gain_matrix
from imu_kalman.simulation_motion import TruthModel
from kalman_core.parameters import ParameterError, build

DEG = math.pi / 180.0
PERFECT = {
    'gyro_noise': 0.0,
    'gyro_turn_on': 0.0,
    'gyro_instability': 0.0,
    'gyro_resolution': 0.0,
    'accel_noise': 0.0,
    'accel_turn_on': 0.0,
    'accel_instability': 0.0,
    'accel_resolution': 0.0,
    'mag_noise': 0.0,
    'mag_resolution': 0.0,
    'gyro_range': 100.0,
    'accel_range': 1000.0,
}


def truth_of(times, seed=3, **values):
    params = build(SimulatorParams, values)
    return TruthModel(params, np.random.default_rng(seed))(times)


def rotation_of(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


def overlapping_allan(values, rate, tau):
    """Return the overlapping Allan deviation (IEEE 952, C.11) at `tau` seconds, per axis."""
    m = round(tau * rate)
    angle = np.cumsum(values, axis=0) / rate
    second = angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]
    return np.sqrt((second**2).mean(axis=0) / (2.0 * tau**2))


@pytest.mark.parametrize('motion', MOTIONS)
def test_gyro_integrates_to_the_true_orientation(motion):
    rate = 400.0
    t = np.arange(int(20 * rate) + 1) / rate
    truth = truth_of(t, motion=motion, motion_time=6.0, rest_time=1.0)
    # Three-point Gauss-Legendre quadrature of the rate plus the second-order coning term: error O(dt^5).
    nodes = 0.5 + np.array([-0.5, 0.0, 0.5]) * math.sqrt(0.6)
    w = [truth_of(t[:-1] + c / rate, motion=motion, motion_time=6.0, rest_time=1.0).rate for c in nodes]
    first, middle, last = w
    mean = (5.0 * first + 8.0 * middle + 5.0 * last) / 18.0
    slope = (last - first) / (nodes[2] - nodes[0])
    steps = Rotation.from_rotvec(mean / rate + np.cross(middle, slope) / (12.0 * rate**2))
    q = rotation_of(truth.quaternion[0])
    for i in range(len(steps)):
        q = q * steps[i]
    assert (q.inv() * rotation_of(truth.quaternion[-1])).magnitude() < 1e-7


@pytest.mark.parametrize('motion', MOTIONS)
def test_specific_force_is_the_derivative_of_velocity_less_gravity(motion):
    t = np.linspace(0.5, 30.0, 4001)
    values = {
        'motion': motion,
        'lever_arm': (2.0, 5.0, 8.0),
        'motion_time': 8.0,
        'rest_time': 2.0,
        'gravity': 9.81,
    }
    h = 1e-4
    # The jerk leaps where a spell of motion ends, on whole seconds: no difference across a leap.
    t = t[np.abs(t - np.rint(t)) > 2.0 * h]
    before, here, after = (truth_of(t + s, **values) for s in (-h, 0.0, h))
    acceleration = (after.velocity - before.velocity) / (2.0 * h)
    expected = rotation_of(here.quaternion).inv().apply(acceleration + [0.0, 0.0, 9.81])
    assert np.abs(here.force - expected).max() < 1e-4


def test_lever_arm_velocity_is_the_derivative_of_its_position():
    t, h = np.linspace(3.0, 12.0, 500), 1e-4
    arm = (2.0, 5.0, 8.0)
    values = {'motion': 'tumble', 'lever_arm': arm}
    before, after = (rotation_of(truth_of(t + s, **values).quaternion).apply(arm) for s in (-h, h))
    assert np.abs(truth_of(t, **values).velocity - (after - before) / (2.0 * h)).max() < 1e-5


def test_motions_are_what_their_names_say():
    t = np.arange(0.0, 120.0, 0.02)
    still = truth_of(t, motion='still', orientation=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(
        rotation_of(still.quaternion).as_euler('ZYX')[:, ::-1], [[0.1, 0.2, 0.3]] * len(t), atol=1e-12
    )
    tilt = rotation_of(truth_of(t, motion='tilt_steps').quaternion).as_euler('ZYX', degrees=True)
    np.testing.assert_allclose(np.abs(tilt).max(axis=0), [0.0, 30.0, 30.0], atol=1e-6)
    up = rotation_of(truth_of(t, motion='tumble').quaternion).inv().apply([0.0, 0.0, 1.0])
    assert (up.min(axis=0) < -0.95).all()
    assert (up.max(axis=0) > 0.95).all()
    ship = rotation_of(truth_of(t, motion='rolling_ship', initial_rest=0.0).quaternion)
    roll = ship.as_euler('ZYX', degrees=True)[:, 2]
    assert 14.0 < np.abs(roll).max() <= 15.0
    car = truth_of(t, motion='vehicle', initial_rest=0.0)
    speed = np.linalg.norm(car.velocity, axis=1)
    assert 5.9 < speed.min() < 6.5
    assert 13.5 < speed.max() < 14.1
    lateral = np.linalg.norm(car.force - [0.0, 0.0, 9.80665], axis=1)
    assert 2.0 < lateral.max() < 6.0
    hand = truth_of(t, motion='hand_held')
    assert 60.0 < np.abs(hand.rate).max() / DEG < 500.0


def test_it_rests_when_told_to():
    params = {'motion': 'hand_held', 'initial_rest': 3.0, 'motion_time': 5.0, 'rest_time': 2.0}
    t = np.array([0.5, 2.9, 8.1, 9.9, 15.2, 5.5])
    rate = np.linalg.norm(truth_of(t, **params).rate, axis=1)
    assert (rate[:5] == 0.0).all()
    assert rate[5] > 0.05


@pytest.mark.parametrize('motion', MOTIONS)
def test_motion_starts_without_a_jump_from_the_orientation_given(motion):
    truth = truth_of(np.array([0.0, 1.0, 2.0]), motion=motion, initial_rest=2.0, orientation=(0.0, 0.0, 1.0))
    assert np.abs(np.diff(truth.quaternion, axis=0)).max() == 0.0
    if motion in ('still', 'tilt_steps', 'tumble', 'hand_held'):
        np.testing.assert_allclose(truth.quaternion[0], [math.cos(0.5), 0.0, 0.0, math.sin(0.5)], atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(
    pieces=st.lists(st.integers(1, 700), min_size=1, max_size=6),
    motion=st.sampled_from(MOTIONS),
    seed=st.integers(0, 2**31 - 1),
    model=st.sampled_from(['flicker', 'gauss_markov']),
)
def test_pieces_equal_the_whole_to_the_last_bit(pieces, motion, seed, model):
    params = build(
        SimulatorParams,
        {
            'motion': motion,
            'seed': seed,
            'bias_model': model,
            'gyro_walk': 1e-4,
            'accel_walk': 1e-3,
            'mag_every': 3,
            'vibration_accel': (0.5, 0.1),
            'rate': 142.857,
        },
    )
    stream = ImuSimulator(params)
    parts = [stream.take(n) for n in pieces]
    whole = ImuSimulator(params).take(sum(pieces))
    for field in whole._fields:
        joined = np.concatenate([getattr(part, field) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, field), err_msg=field)


def test_seeds_differ_and_repeat():
    one, again, two = (simulate(SimulatorParams(seed=s), 2.0) for s in (5, 5, 6))
    np.testing.assert_array_equal(one.gyro, again.gyro)
    assert (one.gyro[:, 0] != two.gyro[:, 0]).mean() > 0.9


@pytest.mark.parametrize('rate', [1.0, 100.0, 285.71, 500.0, 1000.0 / 3.0])
def test_stamps_do_not_drift(rate):
    n = 5000
    stamps = simulate(build(SimulatorParams, {'rate': rate}), n / rate, start=7).stamp
    exact = 7 + np.arange(len(stamps)) * 1e9 / rate
    # Rates are taken as fractions with denominators to 1000.
    assert np.abs(stamps - exact).max() < 2.0 + 1e-6 * exact[-1]
    assert np.ptp(np.diff(stamps)) <= 1
    assert stamps.dtype == np.int64


def test_a_perfect_sensor_measures_the_truth():
    block = simulate(build(SimulatorParams, dict(PERFECT, motion='tumble')), 5.0)
    np.testing.assert_array_equal(block.gyro, block.rate)
    np.testing.assert_array_equal(block.accel, block.force)
    north = rotation_of(block.quaternion).apply(block.mag)
    dip = 68.0 * DEG
    expected = 48.5e-6 * np.array([0.0, math.cos(dip), -math.sin(dip)])
    np.testing.assert_allclose(north, np.broadcast_to(expected, north.shape), atol=1e-18)


def test_declination_turns_the_field_to_the_east():
    block = simulate(build(SimulatorParams, dict(PERFECT, motion='still', declination=0.2)), 0.1)
    east, north, _ = block.mag[0]
    assert math.atan2(east, north) == pytest.approx(0.2, abs=1e-12)


def test_white_noise_has_the_allan_deviation_of_its_density():
    rate, density = 100.0, 0.01
    values = White(density, rate, np.random.default_rng(1)).take(200_000)
    for tau in (0.1, 1.0, 10.0):
        np.testing.assert_allclose(overlapping_allan(values, rate, tau), density / math.sqrt(tau), rtol=0.1)


def test_random_walk_has_the_allan_deviation_of_its_density():
    rate, density = 20.0, 0.01
    source = RandomWalk(density, rate, np.random.default_rng(2))
    values = np.concatenate([source.take(250) for _ in range(1600)])
    for tau in (1.0, 10.0, 100.0):
        expected = density * math.sqrt(tau / 3.0)
        deviation = np.sqrt((overlapping_allan(values, rate, tau) ** 2).mean())
        assert deviation == pytest.approx(expected, rel=0.15)


def test_gauss_markov_has_its_allan_deviation():
    rate, sigma, correlation = 10.0, 0.3, 5.0
    source = GaussMarkov(sigma, correlation, rate, np.random.default_rng(3))
    values = np.concatenate([source.take(1000) for _ in range(300)])
    for tau in (1.0, 9.45, 50.0):
        x = tau / correlation
        # IEEE 952 C.21: Allan variance of exponentially correlated noise.
        variance = 2.0 * sigma**2 / x * (1.0 - (3.0 - 4.0 * math.exp(-x) + math.exp(-2.0 * x)) / (2.0 * x))
        deviation = np.sqrt((overlapping_allan(values, rate, tau) ** 2).mean())
        assert deviation == pytest.approx(math.sqrt(variance), rel=0.08)


def test_flicker_noise_is_flat_at_its_instability():
    rate, instability = 10.0, 0.02
    source = Flicker(instability, rate, np.random.default_rng(4))
    values = np.concatenate([source.take(1000) for _ in range(600)])
    floor = instability * math.sqrt(2.0 * math.log(2.0) / math.pi)
    for tau in (1.0, 10.0, 100.0):
        deviation = np.sqrt((overlapping_allan(values, rate, tau) ** 2).mean())
        assert deviation == pytest.approx(floor, rel=0.15)


def test_the_assembled_gyro_has_its_noise_and_walk():
    rate = 50.0
    params = build(
        SimulatorParams,
        dict(PERFECT, motion='still', rate=rate, gyro_noise=1e-3, gyro_walk=1e-4, bias_model='gauss_markov'),
    )
    gyro = simulate(params, 4000.0).gyro
    for tau in (0.2, 2.0, 20.0, 100.0):
        expected = math.sqrt(1e-6 / tau + 1e-8 * tau / 3.0)
        deviation = np.sqrt((overlapping_allan(gyro, rate, tau) ** 2).mean())
        assert deviation == pytest.approx(expected, rel=0.15)


def test_covariances_say_what_is_measured():
    params = build(
        SimulatorParams,
        {
            'motion': 'hand_held',
            'vibration_accel': (0.4, 0.2),
            'vibration_gyro': (0.01, 0.02),
        },
    )
    simulator = ImuSimulator(params)
    block = simulator.take(20_000)
    gyro = (block.gyro - block.rate - block.gyro_bias).var()
    accel = (block.accel - block.force - block.accel_bias).var()
    # The direction of a line is random: per axis the variance differs, together it is exact.
    assert gyro == pytest.approx(simulator.variances.gyro, rel=0.05)
    assert accel == pytest.approx(simulator.variances.accel, rel=0.05)


def test_scale_misalignment_and_g_sensitivity_enter_as_documented():
    gain = gain_matrix((0.01, -0.02, 0.03), (0.001, 0.002, 0.003, 0.004, 0.005, 0.006))
    np.testing.assert_array_equal(gain, [[1.01, 0.001, 0.002], [0.003, 0.98, 0.004], [0.005, 0.006, 1.03]])
    values = dict(
        PERFECT,
        motion='tumble',
        gyro_scale=(0.01, -0.02, 0.03),
        gyro_misalignment=(0.001, 0.002, 0.003, 0.004, 0.005, 0.006),
        gyro_g_sensitivity=(1e-3, 2e-3, 3e-3),
    )
    block = simulate(build(SimulatorParams, values), 4.0)
    expected = block.rate @ gain.T + block.force * [1e-3, 2e-3, 3e-3]
    np.testing.assert_allclose(block.gyro, expected, atol=1e-12)


def test_temperature_moves_the_bias():
    values = dict(
        PERFECT,
        motion='still',
        gyro_temperature=(1e-3, 0.0, -1e-3),
        warm_up_rise=10.0,
        warm_up_time=20.0,
        ambient_temperature=20.0,
    )
    block = simulate(build(SimulatorParams, values), 100.0)
    assert block.temperature[0] == 20.0
    assert block.temperature[-1] == pytest.approx(30.0, abs=0.1)
    np.testing.assert_allclose(block.gyro[-1], [1e-2, 0.0, -1e-2], atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(
    limit=st.floats(0.05, 5.0),
    steps=st.integers(8, 4096),
    seed=st.integers(0, 1000),
)
def test_outputs_stay_within_range_and_on_the_grid(limit, steps, seed):
    resolution = limit / steps
    params = dataclasses.replace(
        SimulatorParams(), motion='tumble', seed=seed, gyro_range=limit, gyro_resolution=resolution
    )
    gyro = simulate(params, 3.0).gyro
    assert np.abs(gyro).max() <= limit * (1.0 + 1e-12)
    counts = gyro / resolution
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)


def test_turn_on_bias_changes_with_the_seed_by_its_sigma():
    values = [
        simulate(build(SimulatorParams, dict(PERFECT, motion='still', gyro_turn_on=0.01, seed=s)), 0.01).gyro[
            0
        ]
        for s in range(100)
    ]
    assert np.std(values) == pytest.approx(0.01, rel=0.15)


def test_iron_disturbance_and_decimation_of_the_magnetometer():
    values = dict(
        PERFECT,
        motion='still',
        mag_every=4,
        mag_hard_iron=(1e-6, 2e-6, 3e-6),
        mag_soft_iron=(1.1, 0.0, 0.0, 0.0, 1.0, 0.1, 0.0, 0.0, 0.9),
        mag_disturbance=(5e-6, 0.0, 0.0),
        mag_disturbance_start=1.0,
        mag_disturbance_time=1.0,
    )
    block = simulate(build(SimulatorParams, values), 3.0)
    there = np.isfinite(block.mag[:, 0])
    assert there.sum() == 75
    assert there[::4].all()
    dip = 68.0 * DEG
    field = 48.5e-6 * np.array([0.0, math.cos(dip), -math.sin(dip)])
    soft = np.array([[1.1, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.9]])
    hard = np.array([1e-6, 2e-6, 3e-6])
    np.testing.assert_allclose(block.mag[0], soft @ field + hard, atol=1e-12)
    np.testing.assert_allclose(block.mag[120], soft @ (field + [5e-6, 0.0, 0.0]) + hard, atol=1e-12)
    np.testing.assert_allclose(block.mag[220], soft @ field + hard, atol=1e-12)


def test_a_spell_shorter_than_its_ramps_is_refused():
    with pytest.raises(ParameterError, match='motion_time'):
        build(SimulatorParams, {'motion_time': 1.0})
