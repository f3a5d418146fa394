# SPDX-License-Identifier: Apache-2.0
"""Recorded trials with an optical reference (BROAD, CC BY 4.0, Laidig et al. 2021) against the peers.

The peers run on the same arrays in the same run. The family's own filter carries attitude forward by its
sensors' delay; so that nobody takes that for skill alone, one reference is VQF carried forward alike, and a
row shows the filter without any delays.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import imu_peers
import numpy as np
from imu_metrics import PARTS, best_time, rms
from scipy.spatial.transform import Rotation

from bag_tools.bench import Options, Row
from imu_kalman.attitude_batch import filter_batch
from imu_kalman.params import AttitudeParams
from imu_kalman.smoother import smooth

# Delays (s) that the leave-one-out fit may choose from: from none to twice the default and more.
_SENSOR_DELAYS = (0.0, 1.2e-3, 2.4e-3, 3.6e-3, 4.8e-3, 6.0e-3)
_MAG_DELAYS = (0.0, 3.5e-3, 7e-3, 10.5e-3, 14e-3)


class Trial(NamedTuple):
    """One recording: arrays at `rate` (Hz), field in tesla; `scored` marks what counts."""

    rate: float
    stamp: np.ndarray
    gyr: np.ndarray
    acc: np.ndarray
    mag: np.ndarray
    truth: np.ndarray
    scored: np.ndarray

    def score(self, found: np.ndarray) -> np.ndarray:
        """Return total, heading and inclination error (deg) over the scored samples."""
        return rms(found[self.scored], self.truth[self.scored])

    def after(self, first: int, settle: float) -> Trial:
        """Return the trial from sample `first` on, scored after `settle` seconds."""
        columns = [column[first:] for column in self[1:]]
        columns[-1] = columns[-1] & (np.arange(len(columns[-1])) >= settle * self.rate)
        return Trial(self.rate, *columns)


def trials(limit: int | None) -> list[Trial]:
    """Return the recorded trials that are found, at most `limit`."""
    root = Path(os.environ.get('ESTIMATOR_DATA', Path(__file__).parents[4] / '..' / 'shared' / 'data'))
    out = []
    for path in sorted((root / 'imu').glob('broad_*.npz'))[:limit]:
        data = np.load(path)
        rate = float(data['fs'])
        gyr, acc, mag, truth = (data[name].astype(float) for name in ('gyr', 'acc', 'mag', 'quat'))
        stamp = 10**9 + np.round(np.arange(len(gyr)) * 1e9 / rate).astype(np.int64)
        scored = data['movement'].astype(bool) & np.isfinite(truth).all(axis=1)
        out.append(Trial(rate, stamp, gyr, acc, mag * 1e-6, truth, scored))
    return out


def carried(quat: np.ndarray, gyr: np.ndarray, delay: float) -> np.ndarray:
    """Return attitudes carried forward by rate times `delay` (s)."""
    turned = Rotation.from_quat(quat, scalar_first=True) * Rotation.from_rotvec(gyr * delay)
    return turned.as_quat(scalar_first=True)


def recorded_rows(options: Options) -> Iterable[Row]:
    """Yield accuracy and time per sample beside the peers; nothing where the recordings are missing."""
    found = trials(2 if options.quick else None)
    if not found:
        return
    peers = {'VQF': imu_peers.vqf} if options.quick else imu_peers.CAUSAL
    micro = [(t.gyr, t.acc, t.mag * 1e6, t.rate) for t in found]
    causal = {name: [peer(*arrays) for arrays in micro] for name, peer in peers.items()}
    delay = AttitudeParams().sensor_delay
    causal['VQF carried forward'] = [carried(q, t.gyr, delay) for q, t in zip(causal['VQF'], found)]
    offline = [imu_peers.offline_vqf(*arrays) for arrays in micro]
    acausal = {
        'offlineVQF': offline,
        'offlineVQF carried forward': [carried(q, t.gyr, delay) for q, t in zip(offline, found)],
    }
    ours = [filter_batch(*t[1:5], covariance=False).orientation for t in found]
    smoothed = [smooth(*t[1:5]).orientation for t in found]
    yield from _accuracy('causal', found, ours, causal, 'VQF')
    yield from _accuracy('smoothed', found, smoothed, acausal, 'offlineVQF')
    yield from _left_out(found, causal['VQF'])
    yield from _variants(found, causal['VQF'])
    yield from _speed(found[0])


def _accuracy(kind, found, ours, peers, rival) -> Iterable[Row]:
    value = np.mean([t.score(q) for t, q in zip(found, ours)], axis=0)
    theirs = {
        name: np.mean([t.score(q) for t, q in zip(found, quats)], axis=0) for name, quats in peers.items()
    }
    for i, part in enumerate(PARTS):
        reference = {name: float(scores[i]) for name, scores in theirs.items()}
        yield Row(
            'imu_kalman',
            f'recorded trials, {kind}: mean {part} error',
            float(value[i]),
            '°',
            reference[rival],
            reference=reference,
        )


def _left_out(found, vqf) -> Iterable[Row]:
    """Fit both delays on all trials but one and score that one: what the defaults owe to these trials."""
    grid = [
        dataclasses.replace(AttitudeParams(), sensor_delay=sensor, mag_delay=mag)
        for sensor in _SENSOR_DELAYS
        for mag in _MAG_DELAYS
    ]
    scores = np.array(
        [
            [t.score(filter_batch(*t[1:5], params=p, covariance=False).orientation) for t in found]
            for p in grid
        ]
    )
    total = scores[:, :, 0]
    chosen = [int(np.argmin(total.sum(axis=1) - total[:, k])) for k in range(len(found))]
    value = np.mean([scores[best, k] for k, best in enumerate(chosen)], axis=0)
    rival = np.mean([t.score(q) for t, q in zip(found, vqf)], axis=0)
    for i, part in enumerate(PARTS):
        yield Row(
            'imu_kalman',
            f'recorded trials, delays fitted on the other trials, causal: mean {part} error',
            float(value[i]),
            '°',
            float(rival[i]),
            reference={'VQF': float(rival[i])},
        )
    for name, delays in (
        ('sensor_delay', [grid[best].sensor_delay for best in chosen]),
        ('mag_delay', [grid[best].mag_delay for best in chosen]),
    ):
        yield Row(
            'imu_kalman',
            f'recorded trials, {name} fitted on the other trials: mean',
            1e3 * float(np.mean(delays)),
            'ms',
            reference={'least': 1e3 * min(delays), 'largest': 1e3 * max(delays)},
        )


def _variants(found, vqf) -> Iterable[Row]:
    plain = dataclasses.replace(AttitudeParams(), sensor_delay=0.0, mag_delay=0.0)
    moving = [t.after(int(np.argmax(t.scored)) + round(7 * t.rate), 30.0) for t in found]
    rival = [imu_peers.vqf(t.gyr, t.acc, t.mag * 1e6, t.rate) for t in moving]
    cases = (
        ('without sensor delays, causal', found, plain, vqf),
        ('started in motion, causal', moving, AttitudeParams(), rival),
    )
    for name, chosen, params, peer in cases:
        ours = [filter_batch(*t[1:5], params=params, covariance=False).orientation for t in chosen]
        value = np.mean([t.score(q) for t, q in zip(chosen, ours)], axis=0)
        reference = np.mean([t.score(q) for t, q in zip(chosen, peer)], axis=0)
        for i, part in enumerate(PARTS):
            yield Row(
                'imu_kalman',
                f'recorded trials, {name}: mean {part} error',
                float(value[i]),
                '°',
                reference={'VQF': float(reference[i])},
            )


def _speed(trial: Trial) -> Iterable[Row]:
    arrays = (trial.gyr, trial.acc, trial.mag, trial.rate)
    n = len(trial.gyr) * 1e-6
    ours = best_time(lambda: filter_batch(*trial[1:5], covariance=False)) / n
    theirs = best_time(lambda: imu_peers.vqf(*arrays)) / n
    yield Row(
        'imu_kalman',
        'causal attitude filter over arrays: time per sample as a ratio to VQF in C++',
        ours / theirs,
        '',
        1.0,
        reference={'VQF (us)': theirs, 'ours (us)': ours},
    )
    ours = best_time(lambda: smooth(*trial[1:5])) / n
    theirs = best_time(lambda: imu_peers.offline_vqf(*arrays)) / n
    yield Row(
        'imu_kalman',
        'smoother: time per sample as a ratio to offlineVQF in C++',
        ours / theirs,
        '',
        1.3,
        reference={'offlineVQF (us)': theirs, 'ours (us)': ours},
    )
