# SPDX-License-Identifier: Apache-2.0
"""Zero velocity and the non-holonomic constraint on a car whose truth is made here."""

import math

import numpy as np
import pytest

from ins_gps.filter import NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.samples import ImuSample
from ins_gps.solution import displaced, error_of
from ins_gps.strapdown import mechanise_series
from kalman_core.consistency import chi2_band
from kalman_core.rotation import quat_from_euler

RATE = 50  # Hz
DT = 1.0 / RATE
START = 1_700_000_000 * 1_000_000_000
NOISE = {'gyro_noise': 2e-4, 'accel_noise': 2e-3}
SIGMAS = np.r_[[0.5] * 3, [0.05] * 3, [0.003, 0.003, 0.01]]


def _drive(speed_change, yaw_rate, seed, sideways=None):
    """Return stamps, truth (n + 1, 10), measured rate and force of a car on level ground.

    speed_change: (n,) m/s² ahead; yaw_rate: (n,) rad/s; sideways: (n,) m/s² of a skid.
    """
    count = len(speed_change)
    truth = np.zeros((count + 1, 10))
    rate, force = np.zeros((count, 3)), np.zeros((count, 3))
    yaw, speed = 0.3, 0.0
    nav = np.r_[0.8, 0.2, 100.0, 0.0, 0.0, 0.0, quat_from_euler(0.0, 0.0, yaw)]
    truth[0] = nav
    skid = np.zeros(count) if sideways is None else sideways
    for k in range(count):
        # The force that keeps the car on the ground and on its wheels, found by trying without one.
        w = np.array([0.0, 0.0, yaw_rate[k]])
        free = mechanise_series(nav.copy(), w[None], np.zeros((1, 3)), DT)[-1]
        speed += speed_change[k] * DT
        yaw += yaw_rate[k] * DT
        drift = np.sum(skid[: k + 1]) * DT
        ahead, right = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
        wanted = np.r_[speed * ahead + drift * right, 0.0]
        middle = yaw - 0.5 * yaw_rate[k] * DT
        c, s = math.cos(middle), math.sin(middle)
        mat = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        f = mat.T @ (wanted - free[3:6]) / DT
        nav = mechanise_series(nav, w[None], f[None], DT)[-1]
        rate[k], force[k], truth[k + 1] = w, f, nav
    rng = np.random.default_rng(seed)
    rate = rate + NOISE['gyro_noise'] / math.sqrt(DT) * rng.standard_normal(rate.shape)
    force = force + NOISE['accel_noise'] / math.sqrt(DT) * rng.standard_normal(force.shape)
    bias_g, bias_a = 1e-4 * rng.standard_normal(3), 0.02 * rng.standard_normal(3)
    stamps = START + np.round(np.arange(count + 1) * DT * 1e9).astype(np.int64)
    return stamps, truth, rate + bias_g, force + bias_a


def _run(data, seed, **options):
    stamps, truth, rate, force = data
    params = FilterParams(
        mode='ins', channels=4, gyro_bias_walk=0.0, accel_bias_walk=0.0, gyro_bias_sigma=1e-4,
        accel_bias_sigma=0.02, **NOISE, **options,
    )  # fmt: skip
    navigation = NavigationFilter(params)
    rng = np.random.default_rng([seed, 5])
    navigation.initialise(int(stamps[0]), displaced(truth[0], SIGMAS * rng.standard_normal(9)), SIGMAS)
    for k in range(len(rate)):
        navigation.imu(ImuSample(int(stamps[k + 1]), rate[k], force[k]))
    navigation.flush()
    error = error_of(navigation.nav, truth[-1])
    return navigation, error


def _nees(navigation, error):
    return float(error[3:9] @ np.linalg.solve(navigation.covariance[3:9, 3:9], error[3:9]))


def _stop_and_go(seconds):
    """Accelerate 4 s, brake 4 s, stand."""
    change = np.zeros(seconds * RATE)
    change[2 * RATE : 6 * RATE], change[6 * RATE : 10 * RATE] = 1.0, -1.0
    return change


def _turns(seconds):
    t = np.arange(seconds * RATE) * DT
    return np.where(t < 8.0, 1.2, 0.0), np.where(t > 10.0, 0.15 * np.sin(0.5 * t), 0.0)


@pytest.fixture(scope='module')
def stops():
    """Twelve runs that stand at their end."""
    change = _stop_and_go(20)
    return [_drive(change, np.zeros(len(change)), seed) for seed in range(12)]


@pytest.fixture(scope='module')
def bends():
    """Twelve runs through bends."""
    change, yaw_rate = _turns(40)
    return [_drive(change, yaw_rate, seed) for seed in range(12)]


def test_standing_still_is_used_and_the_covariance_stays_honest(stops):
    nees, used, free = [], [], []
    for seed, data in enumerate(stops):
        navigation, error = _run(data, seed, zero_velocity=True)
        assert navigation.tally.sensor('zero velocity').accepted > 20
        nees.append(_nees(navigation, error))
        used.append(np.linalg.norm(error[3:6]))
        free.append(np.linalg.norm(_run(data, seed)[1][3:6]))
    _, high = chi2_band(0.999, dof=6, runs=len(stops))
    # The filter believes 2 cm/s although the car stands: it may only be too careful.
    assert np.mean(nees) < high
    assert np.mean(used) < 0.03
    assert np.mean(used) < 0.1 * np.mean(free)


def test_a_moving_car_is_not_taken_for_a_still_one():
    t = np.arange(30 * RATE) * DT
    for change, yaw_rate in (
        (np.where(t < 5.0, 2.0, 0.0), np.zeros(len(t))),  # a steady cruise after 5 s
        (np.where(t < 10.0, 0.5, 0.0), 0.1 * np.sin(t)),  # bends
    ):
        navigation, _ = _run(_drive(change, yaw_rate, 3), 3, zero_velocity=True)
        assert navigation.tally.sensor('zero velocity').accepted <= 8  # before it moves off


def test_the_wheels_hold_the_speed_and_the_covariance_says_how_well(bends):
    nees, held, free = [], [], []
    for seed, data in enumerate(bends):
        navigation, error = _run(data, seed, non_holonomic=True, non_holonomic_sigma=0.05)
        nees.append(_nees(navigation, error))
        held.append(np.linalg.norm(error[:3]))
        free.append(np.linalg.norm(_run(data, seed)[1][:3]))
        assert navigation.tally.sensor('non-holonomic').accepted > 150
    _, high = chi2_band(0.999, dof=6, runs=len(bends))
    # This car does not slip at all: the filter, which allows 5 cm/s, may only be too careful.
    assert np.mean(nees) < high
    assert np.mean(held) < 0.5 * np.mean(free)


def test_a_skid_is_refused_not_believed():
    change, yaw_rate = _turns(30)
    t = np.arange(len(change)) * DT
    # For two seconds the car slides 3 m/s to the right, then it grips again.
    sideways = np.where((t > 20.0) & (t < 21.0), 3.0, 0.0) - np.where((t > 23.0) & (t < 24.0), 3.0, 0.0)
    data = _drive(change, yaw_rate, 4, sideways)
    clean, _ = _run(_drive(change, yaw_rate, 4), 4, non_holonomic=True)
    navigation, error = _run(data, 4, non_holonomic=True)
    refused = navigation.tally.sensor('non-holonomic').rejected['gate']
    assert clean.tally.sensor('non-holonomic').rejected['gate'] == 0
    assert refused >= 8
    assert np.abs(error[3:5]).max() < 1.0
