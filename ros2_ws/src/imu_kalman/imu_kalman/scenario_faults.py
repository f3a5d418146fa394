# SPDX-License-Identifier: Apache-2.0
"""Simulated motions with faults of every kind, and what the attitude filter makes of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from imu_kalman.attitude import AttitudeFilter
from imu_kalman.samples import Attitude, ImuSample, MagSample
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import ImuBlock, ImuSimulator

MOTIONS = ('hand_held', 'tumble', 'rolling_ship', 'tilt_steps')
FAULTS = (
    'not a number',
    'huge rate',
    'spike',
    'offset burst',
    'noise burst',
    'frozen',
    'stuck axis',
    'gap',
    'stamps back',
    'duplicates',
    'force spike',
    'force frozen',
    'field zero',
    'field disturbed',
    'field frozen',
)
# Noise that lasts longer than half a second is taken for the motion, so bursts are shorter.
_BURST = 0.25  # s
# The sensor is at rest at first, as after power-up; s.
_REST = 3.0

# A fault: its kind, where it starts (s) and how long it lasts (s).
Fault = tuple[str, float, float]


class Faulty(NamedTuple):
    """A recording with faults: rows that arrive, in order of arrival.

    `stamp` (n,) ns as the message says, `due` (n,) as it should; gyr rad/s, acc m/s², mag T (NaN: none), all
    (n, 3); `orientation` (n, 4) wxyz, the truth at `due`.
    """

    stamp: np.ndarray
    due: np.ndarray
    gyr: np.ndarray
    acc: np.ndarray
    mag: np.ndarray
    orientation: np.ndarray


class Outcome(NamedTuple):
    """Per estimate (n,): time (s), tilt and heading error (deg), NEES per degree of freedom."""

    time: np.ndarray
    tilt: np.ndarray
    heading: np.ndarray
    nees: np.ndarray


def faulty(motion: str, seed: int, faults: Iterable[Fault], duration: float, rate: float = 100.0) -> Faulty:
    """Return `duration` s of `motion` at `rate` (Hz) with `faults`; equal arguments give equal arrays."""
    params = SimulatorParams(motion=motion, seed=seed, rate=rate, mag_every=2, initial_rest=_REST)
    clean = ImuSimulator(params, 10**9).take(round(duration * rate))
    stamp, gyr, acc, mag = (np.array(column) for column in (clean.stamp, clean.gyro, clean.accel, clean.mag))
    out = Faulty(stamp, clean.stamp, gyr, acc, mag, clean.quaternion)
    rng = np.random.default_rng(seed)
    order = [np.arange(len(stamp))]
    keep = np.ones(len(stamp), dtype=bool)
    for kind, start, length in faults:
        first = round(start * rate)
        rows = slice(first, first + max(1, round(length * rate)))
        burst = slice(first, first + max(3, round(min(length, _BURST) * rate)))
        if kind == 'gap':
            keep[rows] = False
        elif kind == 'duplicates':
            order.append(order[0][rows])
        elif kind == 'stamps back':
            stamp[burst] -= int(rng.uniform(0.05, 0.45) * 1e9)
        elif kind.startswith('field'):
            _spoil_field(kind, mag, clean, rows, rng)
        else:
            _spoil_motion(kind, gyr, acc, first, rows, burst, rng)
    arriving = np.sort(np.concatenate(order), kind='stable')
    arriving = arriving[keep[arriving]]
    return Faulty(*(column[arriving] for column in out))


def _spoil_motion(
    kind: str,
    gyr: np.ndarray,
    acc: np.ndarray,
    first: int,
    rows: slice,
    burst: slice,
    rng: np.random.Generator,
) -> None:
    if kind == 'not a number':
        gyr[rows, rng.integers(3)] = np.nan
    elif kind == 'huge rate':
        gyr[rows] = 1e6
    elif kind == 'spike':
        gyr[first : first + 2] += rng.uniform(-60.0, 60.0, 3)
    elif kind == 'offset burst':
        gyr[first : first + 8] += rng.uniform(-40.0, 40.0, 3)
    elif kind == 'noise burst':
        gyr[burst] = rng.uniform(-50.0, 50.0, gyr[burst].shape)
    elif kind == 'frozen':
        gyr[rows], acc[rows] = gyr[first], acc[first]
    elif kind == 'stuck axis':
        axis = rng.integers(3)
        gyr[rows, axis] = gyr[first, axis]
    elif kind == 'force spike':
        acc[first : first + 3] += rng.uniform(-150.0, 150.0, 3)
    elif kind == 'force frozen':
        acc[rows] = acc[first]
    else:
        raise ValueError(f'unknown fault {kind!r}')


def _spoil_field(kind: str, mag: np.ndarray, clean: ImuBlock, rows: slice, rng: np.random.Generator) -> None:
    if kind == 'field zero':
        mag[rows] *= 0.0
    elif kind == 'field disturbed':
        mag[rows] += rng.uniform(-2e-4, 2e-4, 3)
    elif kind == 'field frozen':
        present = np.isfinite(mag[rows, 0])
        mag[rows][present] = clean.mag[rows.start - rows.start % 2]
    else:
        raise ValueError(f'unknown fault {kind!r}')


def follow(recording: Faulty, estimator: AttitudeFilter) -> Outcome:
    """Feed a recording as it arrives; estimates count where the message's stamp is the sample's own.

    Raises ValueError if an estimate is not finite.
    """
    rows, found, covariance = [], [], []
    columns = (recording.stamp, recording.gyr, recording.acc, recording.mag)
    for row, (stamp, gyr, acc, mag) in enumerate(zip(*(column.tolist() for column in columns))):
        for estimate in estimator.on_imu(ImuSample(stamp, tuple(gyr), tuple(acc))):
            if type(estimate) is not Attitude:
                continue
            if not np.isfinite(estimate.values).all():
                raise ValueError(f'estimate at {stamp} ns is not finite')
            if stamp == recording.due[row]:
                rows.append(row)
                found.append(estimate.orientation)
                covariance.append(estimate.orientation_covariance)
        if np.isfinite(mag).all():
            estimator.on_mag(MagSample(stamp, tuple(mag)))
    true = Rotation.from_quat(recording.orientation[rows], scalar_first=True)
    error = (true * Rotation.from_quat(np.array(found), scalar_first=True).inv()).as_rotvec()
    weighted = np.linalg.solve(np.array(covariance), error[:, :, None])[:, :, 0]
    degrees = np.degrees(error)
    return Outcome(
        (recording.due[rows] - recording.due[0]) * 1e-9,
        np.hypot(degrees[:, 0], degrees[:, 1]),
        np.abs(degrees[:, 2]),
        np.einsum('ni,ni->n', error, weighted) / 3.0,
    )
