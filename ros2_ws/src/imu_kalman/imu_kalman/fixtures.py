# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bag_tools.bag import BagWriter, zeroed
from imu_kalman import sensor_codec as codec
from imu_kalman.scenarios import GRAVITY, ShipParams, rolling_ship
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import ImuSimulator, Variances
from imu_kalman.simulation_errors import digitise, sample_variance

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
_RAW, _MAG, _TRUTH = '/imu/data_raw', '/imu/mag', '/truth/orientation'
_FRAME = 'imu_link'
_DEG = math.pi / 180.0


class Recording(NamedTuple):
    """n samples for a bag: stamp (n,) int64 ns; gyro rad/s, accel m/s², mag T (n, 3); quaternion (n, 4) wxyz.

    Rows whose quaternion is NaN have no truth, rows whose magnetic field is NaN no field.
    """

    stamp: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    mag: np.ndarray
    quaternion: np.ndarray


def write_recording(
    path: Path, recording: Recording, variances: Variances, arrival: np.ndarray | None = None
) -> None:
    """Write a recording into a bag (mcap, zstd); `arrival` (n,) ns are bag times, default the stamps."""
    imu, mag, truth = (zeroed(t) for t in (codec.IMU, codec.MAGNETIC_FIELD, codec.QUATERNION))
    codec.prepare_imu(imu, _FRAME, variances.gyro, variances.accel)
    codec.prepare_mag(mag, _FRAME, variances.mag)
    truth.header.frame_id = 'map'
    times = recording.stamp if arrival is None else arrival
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        bag.add(_RAW, codec.IMU)
        bag.add(_MAG, codec.MAGNETIC_FIELD)
        bag.add(_TRUTH, codec.QUATERNION)
        for row, (stamp, time) in enumerate(zip(recording.stamp.tolist(), times.tolist())):
            codec.encode_imu(imu, stamp, recording.gyro[row], recording.accel[row])
            bag.write(_RAW, time, imu)
            if np.isfinite(recording.mag[row, 0]):
                codec.encode_mag(mag, stamp, recording.mag[row])
                bag.write(_MAG, time, mag)
            if np.isfinite(recording.quaternion[row, 0]):
                codec.encode_orientation(truth, stamp, recording.quaternion[row])
                bag.write(_TRUTH, time, truth)


def record(params: SimulatorParams, duration: float) -> tuple[Recording, Variances]:
    """Return the first `duration` seconds of the simulator from START on."""
    simulator = ImuSimulator(params, START)
    block = simulator.take(round(duration * params.rate))
    fields = (block.stamp, block.gyro, block.accel, block.mag, block.quaternion)
    return Recording(*fields), simulator.variances


def write_bag(path: Path, params: SimulatorParams, duration: float) -> None:
    """Write `duration` seconds of the simulator into a bag."""
    write_recording(path, *record(params, duration))


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
    """60 s: the benchmark's rolling ship, sensor off the roll centre, started in motion with a gyro bias."""
    params = ShipParams(duration=60.0, rate=100.0)
    ship = rolling_ship(params, seed=43, start=START)
    # Rounded as the simulator's sensors round: full doubles of noise would double the size of the bag.
    chip = SimulatorParams()
    gyro = digitise(ship.gyr, chip.gyro_range, chip.gyro_resolution)
    accel = digitise(ship.acc, chip.accel_range, chip.accel_resolution)
    mag = digitise(ship.mag, chip.mag_range, chip.mag_resolution)
    root_rate = math.sqrt(params.rate)
    variances = Variances(
        sample_variance(params.gyro_noise * _DEG * root_rate, chip.gyro_resolution),
        sample_variance(params.accel_noise * 1e-6 * GRAVITY * root_rate, chip.accel_resolution),
        sample_variance(params.mag_noise * 1e-6, chip.mag_resolution),
    )
    write_recording(path, Recording(ship.stamp, gyro, accel, mag, ship.orientation), variances)


def _bad_data(path: Path) -> None:
    """40 s: NaN, infinity, zeros, leaps, bad stamps, frozen values, a gap, duplicates; clean data between."""
    params = replace(HAND, seed=44, motion_time=0.0)
    clean, variances = record(params, 40.0)
    faulty = Recording(*(field.copy() for field in clean))
    stamp, gyro, accel, mag, _ = faulty
    rows = np.arange(len(stamp))
    seconds = rows / params.rate
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
    arrival = clean.stamp[order]
    faulty = Recording(*(field[order] for field in faulty))
    # Truth belongs to the moment, not to what the faulty stamp says.
    faulty.quaternion[faulty.stamp != arrival] = np.nan
    write_recording(path, faulty, variances, arrival)


def _loop(path: Path) -> None:
    """10 s twice: the stamps go back as when a bag loops, the bag times go on."""
    params = replace(HAND, seed=45, initial_rest=2.0, motion_time=0.0)
    once, variances = record(params, 10.0)
    twice = Recording(*(np.concatenate([field, field]) for field in once))
    arrival = np.concatenate([once.stamp, once.stamp + round(10.0 * 1e9)])
    write_recording(path, twice, variances, arrival)


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
