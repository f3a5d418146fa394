# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bag_tools.bag import BagWriter, zeroed
from imu_kalman import sensor_codec as codec
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import ImuBlock, ImuSimulator, Variances, simulate

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
_RAW, _MAG, _TRUTH = '/imu/data_raw', '/imu/mag', '/truth/orientation'
_DEG = math.pi / 180.0


def write_block(
    path: Path,
    block: ImuBlock,
    params: SimulatorParams,
    variances: Variances,
    arrival: np.ndarray | None = None,
) -> None:
    """Write samples into a bag (mcap, zstd) at `path`; `arrival` (n,) ns are bag times, default the stamps.

    Rows whose quaternion is NaN have no truth, rows whose magnetic field is NaN no field.
    """
    imu, mag, truth = (zeroed(t) for t in (codec.IMU, codec.MAGNETIC_FIELD, codec.QUATERNION))
    codec.prepare_imu(imu, params.frame_id, variances.gyro, variances.accel)
    codec.prepare_mag(mag, params.frame_id, variances.mag)
    truth.header.frame_id = params.world_frame
    times = block.stamp if arrival is None else arrival
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        bag.add(_RAW, codec.IMU)
        bag.add(_MAG, codec.MAGNETIC_FIELD)
        bag.add(_TRUTH, codec.QUATERNION)
        for row, (stamp, time) in enumerate(zip(block.stamp.tolist(), times.tolist())):
            codec.encode_imu(imu, stamp, block.gyro[row], block.accel[row])
            bag.write(_RAW, time, imu)
            if np.isfinite(block.mag[row, 0]):
                codec.encode_mag(mag, stamp, block.mag[row])
                bag.write(_MAG, time, mag)
            if np.isfinite(block.quaternion[row, 0]):
                codec.encode_orientation(truth, stamp, block.quaternion[row])
                bag.write(_TRUTH, time, truth)


def write_bag(path: Path, params: SimulatorParams, duration: float) -> None:
    """Write `duration` seconds of the simulator into a bag."""
    simulator = ImuSimulator(params, START)
    block = simulator.take(round(duration * params.rate))
    write_block(path, block, params, simulator.variances)


# Like BENCHMARKS' rolling ship in its errors; a magnetometer at half the rate, as the HMC5883L has.
SHIP = SimulatorParams(
    motion='rolling_ship',
    seed=43,
    mag_every=2,
    initial_rest=0.0,
    lever_arm=(2.0, 5.0, 8.0),
    bias_model='gauss_markov',
    gyro_noise=0.01 * _DEG,
    gyro_bias=(0.5 * _DEG, -0.3 * _DEG, 0.4 * _DEG),
    gyro_turn_on=0.0,
    gyro_instability=0.0,
    gyro_walk=0.003 * _DEG,
    accel_noise=300e-6 * 9.80665,
    accel_turn_on=0.0,
    mag_noise=0.6e-6,
    mag_hard_iron=(0.3e-6, -0.2e-6, 0.2e-6),
)
TILT = SimulatorParams(motion='tilt_steps', seed=41, mag_every=2, initial_rest=4.0)
HAND = SimulatorParams(
    motion='hand_held', seed=42, initial_rest=3.0, motion_time=12.0, rest_time=3.0, mag_every=2
)


def _tilt(path: Path) -> None:
    """40 s: rest, then steps of ±30° in roll and in pitch."""
    write_bag(path, TILT, 40.0)


def _hand_held(path: Path) -> None:
    """60 s: turned and swung in a hand, with rests of 3 s."""
    write_bag(path, HAND, 60.0)


def _rolling_ship(path: Path) -> None:
    """60 s: a rolling ship, sensor off the roll centre, started in motion with a gyro bias of 0.7 °/s."""
    write_bag(path, SHIP, 60.0)


def _bad_data(path: Path) -> None:
    """40 s: NaN, infinity, zeros, leaps, bad stamps, frozen values, a gap, duplicates; clean data between."""
    params = replace(HAND, seed=44, motion_time=0.0)
    block = simulate(params, 40.0, START)
    fields = {name: values.copy() for name, values in block._asdict().items()}
    rows = np.arange(len(block.stamp))
    seconds = rows / params.rate
    stamp, gyro, accel, mag = (fields[name] for name in ('stamp', 'gyro', 'accel', 'mag'))
    gyro[_within(seconds, 6.0, 6.05), 0] = np.nan
    accel[_within(seconds, 8.0, 8.05)] = np.inf
    accel[_within(seconds, 10.0, 10.05)] = 0.0
    gyro[_within(seconds, 12.0, 12.02)] = 1e6
    mag[_within(seconds, 14.0, 14.1) & np.isfinite(mag[:, 0])] = 0.0
    mag[_within(seconds, 16.0, 17.0) & np.isfinite(mag[:, 0])] = 2e-3
    stamp[_within(seconds, 18.0, 18.02)] = 0
    stamp[_within(seconds, 20.0, 20.1)] -= 300_000_000
    frozen = _within(seconds, 22.0, 22.5)
    gyro[frozen], accel[frozen] = gyro[frozen][0], accel[frozen][0]
    # A gap of one second, and every sample of half a second twice.
    order = np.concatenate([rows[~_within(seconds, 26.0, 27.0)], rows[_within(seconds, 30.0, 30.5)]])
    order = np.sort(order, kind='stable')
    arrival = block.stamp[order]
    bad = ImuBlock(*(fields[name][order] for name in ImuBlock._fields))
    # Truth belongs to the moment, not to what the faulty stamp says.
    bad.quaternion[bad.stamp != arrival] = np.nan
    write_block(path, bad, params, ImuSimulator(params).variances, arrival)


def _loop(path: Path) -> None:
    """10 s twice: the stamps go back as when a bag loops, the bag times go on."""
    params = replace(HAND, seed=45, initial_rest=2.0, motion_time=0.0)
    block = simulate(params, 10.0, START)
    twice = ImuBlock(*(np.concatenate([field, field]) for field in block))
    length = round(10.0 * 1e9)
    arrival = np.concatenate([block.stamp, block.stamp + length])
    write_block(path, twice, params, ImuSimulator(params).variances, arrival)


def _within(seconds: np.ndarray, start: float, end: float) -> np.ndarray:
    # Half a sample of tolerance, so that rounding does not decide which rows are meant.
    return (seconds > start - 1e-6) & (seconds < end - 1e-6)


FIXTURES: dict[str, Callable[[Path], None]] = {
    'imu_tilt': _tilt,
    'imu_hand_held': _hand_held,
    'imu_rolling_ship': _rolling_ship,
    'imu_bad_data': _bad_data,
    'imu_loop': _loop,
}
