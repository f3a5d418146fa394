# SPDX-License-Identifier: Apache-2.0
"""Simulated figures: the two-state filter, the rolling ship, and whether covariances are honest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import imu_peers
import numpy as np
from filterpy.kalman import KalmanFilter
from imu_metrics import best_time, rms
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bag_tools.bench import Options, Row
from imu_kalman import attitude_layout as layout
from imu_kalman.angle import filter_angles
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.attitude_batch import filter_batch
from imu_kalman.params import AttitudeParams, TwoStateParams
from imu_kalman.samples import ImuSample, MagSample
from imu_kalman.scenario_faults import FAULTS, MOTIONS, faulty, follow
from imu_kalman.scenario_matched import matched_params, matched_world
from imu_kalman.scenarios import ShipParams, rolling_ship
from imu_kalman.smoother import smooth
from imu_kalman.two_state import filter_axis

PACKAGE = 'imu_kalman'
# Seconds left out of the score, by the definition of the scenario.
SETTLE = 30
RATE = 200
# What the README recommends for a ship: believe the gyro for a minute, let the bias walk slowly.
SHIP_SETTING = TwoStateParams(measurement_variance=30.0, angle_noise=1e-5, bias_noise=1e-6)


def two_state_rows(options: Options) -> Iterable[Row]:
    """Yield agreement with filterpy, the cost of the erratum and the ratio of times."""
    rng = np.random.default_rng(0)
    n = 2000 if options.quick else 20_000
    t = np.arange(n) * 0.01
    angles = 0.4 * np.sin(t) + 0.1 * rng.normal(size=n)
    rates = 0.4 * np.cos(t) + 0.05 + 0.02 * rng.normal(size=n)
    noise = (0.005, 0.003, 0.03)

    def peer():
        reference = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
        reference.x = np.zeros((2, 1))
        reference.P = np.zeros((2, 2))
        reference.F = np.array([[1.0, -0.01], [0.0, 1.0]])
        reference.B = np.array([[0.01], [0.0]])
        reference.H = np.array([[1.0, 0.0]])
        reference.Q = np.diag(noise[:2]) * 0.01
        reference.R *= noise[2]
        out = np.empty((n, 2))
        for i in range(n):
            reference.predict(u=rates[i : i + 1, None])
            reference.update(angles[i])
            out[i] = reference.x[:, 0]
        return out

    ours = filter_axis(np.zeros(6), rates, angles, 0.01, *noise, False)
    yield Row(
        PACKAGE,
        'two-state filter, corrected: largest difference to filterpy',
        float(np.abs(ours - peer()).max()),
        '',
        1e-12,
    )
    ratio = best_time(peer, 3) / best_time(
        lambda: filter_axis(np.zeros(6), rates, angles, 0.01, *noise, False)
    )
    yield Row(PACKAGE, 'two-state filter over arrays: times faster than filterpy', ratio, '', 20.0, 'higher')
    truth = 0.4 * np.sin(t)
    for name, published in (('published', True), ('corrected', False)):
        found = filter_axis(np.zeros(6), rates, angles, 0.01, *noise, published)
        value = float(np.degrees(np.sqrt(np.mean((found[n // 4 :, 0] - truth[n // 4 :]) ** 2))))
        yield Row(PACKAGE, f'two-state filter, {name}: angle error, 0.1 rad noise', value, '°')


def ship_rows(options: Options) -> Iterable[Row]:
    """Yield the attitude filter, the smoother and the two-state filter on the rolling ship."""
    seeds = options.seeds or (2 if options.quick else 50)
    duration = 200.0 if options.quick else 600.0
    late = slice(SETTLE * RATE, None)
    for roll in (15.0, 7.5, 3.0):
        causal, smoothed, six, peer, false_rest = [], [], [], [], 0
        for seed in range(seeds):
            ship = rolling_ship(ShipParams(roll=roll, duration=duration), seed)
            state = np.zeros(layout.STATE)
            out = filter_batch(*ship[:4], covariance=False, state=state)
            false_rest += state[layout.RESTS] > 0.0
            causal.append(rms(out.orientation[late], ship.orientation[late]))
            smoothed.append(rms(smooth(*ship[:4]).orientation[late], ship.orientation[late]))
            out = filter_batch(*ship[:3], covariance=False)
            six.append(rms(out.orientation[late], ship.orientation[late]))
            if seed < 5:
                quat = imu_peers.vqf(ship.gyr, ship.acc, ship.mag * 1e6, RATE)
                peer.append(rms(quat[late], ship.orientation[late]))
        reference = np.mean(peer, axis=0)
        name = f'rolling ship {roll:g}°'
        mean, worst = np.mean(causal, axis=0), np.max(causal, axis=0)
        yield Row(PACKAGE, f'{name}: runs with false rest', false_rest, '', 0.0, seeds=seeds)
        yield Row(
            PACKAGE,
            f'{name}, causal: inclination',
            mean[2],
            '°',
            0.35,
            reference={'VQF': reference[2], 'ours, worst seed': worst[2]},
            seeds=seeds,
        )
        yield Row(
            PACKAGE,
            f'{name}, causal: heading',
            mean[1],
            '°',
            1.0,
            reference={'VQF': reference[1], 'ours, worst seed': worst[1]},
            seeds=seeds,
        )
        mean, worst = np.mean(smoothed, axis=0), np.max(smoothed, axis=0)
        yield Row(
            PACKAGE,
            f'{name}, smoothed: inclination',
            mean[2],
            '°',
            0.12,
            reference={'ours, worst seed': worst[2]},
            seeds=seeds,
        )
        yield Row(
            PACKAGE,
            f'{name}, smoothed: heading',
            mean[1],
            '°',
            1.0,
            reference={'ours, worst seed': worst[1]},
            seeds=seeds,
        )
        yield Row(PACKAGE, f'{name}, 6-axis: inclination', float(np.mean(six, axis=0)[2]), '°', seeds=seeds)
    cases = (
        ('documented setting', SHIP_SETTING, 1.0, 1.0),
        ('constants of the listing', TwoStateParams(), 1.0, None),
        ('constants of the listing, no linear acceleration', TwoStateParams(), 0.0, None),
    )
    for name, params, linear, bar in cases:
        values = []
        for seed in range(min(seeds, 10)):
            ship = rolling_ship(ShipParams(duration=duration, linear=linear), seed)
            quat = filter_angles(ship.stamp, ship.gyr, ship.acc, params)
            values.append(rms(quat[late], ship.orientation[late])[2])
        yield Row(
            PACKAGE,
            f'rolling ship 15°, two-state filter, {name}: inclination',
            float(np.mean(values)),
            '°',
            bar,
            seeds=len(values),
        )


def honesty_rows(options: Options) -> Iterable[Row]:
    """Yield NEES and NIS in a world that is what the filter assumes; both ends of the 95 % band are bars."""
    seeds = options.seeds or (10 if options.quick else 100)
    params = matched_params()
    for name, estimate in (('causal', filter_batch), ('smoothed', smooth)):
        nees = []
        for seed in range(seeds):
            world = matched_world(params, seed)
            out = estimate(*world[:4], params=params)
            at = len(world.stamp) // 2
            turned = (
                Rotation.from_quat(world.orientation[at], scalar_first=True)
                * Rotation.from_quat(out.orientation[at], scalar_first=True).inv()
            )
            error = turned.as_rotvec()
            xx, xy, xz, yy, yz, zz = out.covariance[at]
            nees.append(error @ np.linalg.solve(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), error))
        yield from _band(f'attitude NEES, {name}', float(np.mean(nees)), 3 * seeds, seeds)
    motion, heading = _mean_nis(params, max(2, seeds // 10))
    yield Row(
        PACKAGE,
        'matched world: NIS of the motion, 2 degrees of freedom',
        motion,
        '',
        reference={'expected': 2.0},
    )
    yield Row(
        PACKAGE,
        'matched world: NIS of the heading, 1 degree of freedom',
        heading,
        '',
        reference={'expected': 1.0},
    )
    yield from _ship_honesty(min(seeds, 10))


def _ship_honesty(seeds: int) -> Iterable[Row]:
    """Squared error over variance on the ship: by default, and with the noise that the ship's gyro has."""
    ship_gyro = ShipParams(duration=200.0)
    own = dataclasses.replace(
        AttitudeParams(),
        gyro_noise=math.radians(ship_gyro.gyro_noise),
        bias_walk=math.radians(ship_gyro.gyro_walk),
        rate_noise=0.0,
    )
    for name, params, bar in (
        ('rolling ship', AttitudeParams(), 1.0),
        ('rolling ship, noise parameters of its gyro', own, None),
    ):
        axes = []
        for seed in range(seeds):
            ship = rolling_ship(ship_gyro, seed)
            out = filter_batch(*ship[:4], params=params)
            turned = (
                Rotation.from_quat(ship.orientation[6000::100], scalar_first=True)
                * Rotation.from_quat(out.orientation[6000::100], scalar_first=True).inv()
            )
            ratio = turned.as_rotvec() ** 2 / out.covariance[6000::100][:, [0, 3, 5]]
            axes.append(np.mean(ratio, axis=0))
        east, north, up = np.mean(axes, axis=0).tolist()
        yield Row(
            PACKAGE,
            f'{name}: squared error over variance, per axis',
            float(np.mean(axes)),
            '',
            bar,
            reference={'exact': 1.0, 'roll and pitch': 0.5 * (east + north), 'heading': up},
            seeds=seeds,
        )


def fault_rows(options: Options) -> Iterable[Row]:
    """Yield honesty and recovery over random sequences of faults in four motions at three rates."""
    runs = options.seeds or (6 if options.quick else 100)
    nees, tilt, heading = [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        time, sequence = rng.uniform(5.0, 9.0), []
        for kind in rng.choice(FAULTS, rng.integers(1, 7)):
            length = rng.uniform(0.01, 0.8)
            sequence.append((str(kind), time, length))
            time += length + rng.uniform(0.0, 3.0)
        recording = faulty(
            str(rng.choice(MOTIONS)), seed, sequence, time + 3.0, float(rng.choice([50, 100, 200]))
        )
        outcome = follow(recording, AttitudeFilter())
        mended = outcome.time > time + 2.0
        nees.append(outcome.nees.mean())
        tilt.append(outcome.tilt[mended].max())
        heading.append(outcome.heading[mended].max())
    for name, value, unit, bar in (
        ('NEES per degree of freedom, mean of runs', np.mean(nees), '', 1.0),
        ('NEES per degree of freedom, worst run', np.max(nees), '', 4.0),
        ('largest tilt error after 2 s of clean data, worst run', np.max(tilt), '°', 10.0),
        ('largest heading error after 2 s of clean data, worst run', np.max(heading), '°', 25.0),
    ):
        yield Row(PACKAGE, f'random faults: {name}', float(value), unit, bar, seeds=runs)


def _band(name: str, value: float, freedom: int, seeds: int) -> Iterable[Row]:
    low, high = chi2.ppf((0.025, 0.975), freedom) / seeds
    yield Row(
        PACKAGE, f'matched world: {name}, upper end of the 95 % band', value, '', float(high), seeds=seeds
    )
    yield Row(
        PACKAGE,
        f'matched world: {name}, lower end of the 95 % band',
        value,
        '',
        float(low),
        'higher',
        seeds=seeds,
    )


def _mean_nis(params: AttitudeParams, seeds: int) -> tuple[float, float]:
    motion, heading = [], []
    for seed in range(seeds):
        world = matched_world(params, seed, duration=60.0)
        estimator = AttitudeFilter(params)
        for i, (stamp, gyr, acc, mag) in enumerate(zip(*(column.tolist() for column in world[:4]))):
            estimator.on_imu(ImuSample(stamp, tuple(gyr), tuple(acc)))
            estimator.on_mag(MagSample(stamp, tuple(mag)))
            # One value per block, once the start is over.
            if i > 2000 and i % 5 == 0:
                motion.append(estimator.state[layout.MOTION_NIS])
                heading.append(estimator.state[layout.MAG_NIS])
    return float(np.mean(motion)), float(np.mean(heading))
