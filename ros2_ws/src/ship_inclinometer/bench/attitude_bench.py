# SPDX-License-Identifier: Apache-2.0
"""Attitude over simulated seas: this filter, the low-pass, the paper's filter and smsfusion in one run."""

from __future__ import annotations

import functools
import math
import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import butter, sosfilt

from ship_inclinometer import published_kernels as published
from ship_inclinometer.attitude_batch import AttitudeErrors, attitude_errors, run_recording
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.published_model import settings as published_settings
from ship_inclinometer.simulation import Recording, rotation_matrices, scenario, simulate

# Scored once every filter has had a minute; BENCHMARKS' bars speak of a filter that runs.
SETTLED = 60.0
# At 50 Hz nothing of a ship's motion is lost.
_EVERY = 4
ANTENNA = (10.0, 3.0, 10.0)  # the simulated antenna from the simulated IMU
LEVER = (-20.0, -3.0, 15.0)  # the simulated IMU from the roll centre


@dataclass
class Score:
    """Per seed: RMSE and largest error of roll, pitch, heading [deg], 95 % of roll and pitch."""

    rmse: list = field(default_factory=list)
    largest: list = field(default_factory=list)
    within: list = field(default_factory=list)

    def add(self, error: np.ndarray) -> None:
        """Take the errors (N, 3) [deg] of one seed."""
        self.rmse.append(np.sqrt(np.mean(error**2, axis=0)))
        self.largest.append(np.max(np.abs(error), axis=0))
        self.within.append(np.quantile(np.abs(error[:, :2]), 0.95, axis=0))

    def total(self) -> dict[str, float]:
        """Return pooled RMSE, the mean 95 % and the mean of the largest errors, by the worse of two axes."""
        rmse = np.sqrt(np.mean(np.square(self.rmse), axis=0))
        return {
            'tilt': float(np.max(rmse[:2])),
            'heading': float(rmse[2]),
            'within': float(np.max(np.mean(self.within, axis=0))),
            'largest_tilt': float(np.max(np.mean(self.largest, axis=0)[:2])),
            'largest_heading': float(np.mean(self.largest, axis=0)[2]),
        }


def raw_angles(recording: Recording) -> np.ndarray:
    """Return roll and pitch (N, 2) [deg] of the specific force alone."""
    x, y, z = recording.accelerometer.T
    return np.degrees(np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))]))


def low_pass_error(recording: Recording, cutoff: float = 0.5) -> np.ndarray:
    """Return the errors (N, 3) of the baseline: second-order low-pass on the accelerometer's angles."""
    filtered = sosfilt(
        butter(2, cutoff, fs=recording.params.rate, output='sos'), raw_angles(recording), axis=0
    )
    error = filtered - np.degrees(recording.truth.angles[:, :2])
    return np.column_stack([error, np.zeros(len(error))])


def published_run(recording: Recording, params: AttitudeParams) -> tuple[np.ndarray, float]:
    """Return the errors (N, 3) of the paper's filter and its processing time [s]."""
    out, state = np.zeros((len(recording.truth.t), 4)), np.zeros(published.SIZE)
    begin = time.perf_counter()
    published.published_run(
        state,
        published_settings(params),
        1.0 + recording.truth.t,
        recording.gyro,
        recording.accelerometer,
        1.0 + recording.magnetometer_t,
        recording.magnetometer,
        out,
    )
    elapsed = time.perf_counter() - begin
    q = out / np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None]
    return euler_error(recording, q), elapsed


def euler_error(recording: Recording, q: np.ndarray) -> np.ndarray:
    """Return roll, pitch, yaw errors (N, 3) [deg] of quaternions (N, 4) wxyz, ENU."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    error = np.column_stack([roll, pitch, yaw]) - recording.truth.angles
    return np.degrees((error + np.pi) % (2 * np.pi) - np.pi)


def smsfusion_error(recording: Recording) -> np.ndarray | None:
    """Return the errors (N, 3) of smsfusion's vertical reference unit, None where it is not installed.

    It works in a NED frame with x forward, y starboard, z down.
    """
    try:
        import smsfusion
    except ImportError:
        return None
    turned = np.array([1.0, -1.0, -1.0])
    density = math.sqrt(2.0 / 100.0)
    noise = {'bg': 0.004, 'tau_cb': 50.0, 'N': math.radians(0.12) * density, 'B': math.radians(0.01)}
    err_gyro = {'N': noise['N'], 'B': noise['B'], 'tau_cb': 50.0}
    err_acc = {'N': 3.1e-3 * 9.80665 * density, 'B': 1e-3 * 9.80665, 'tau_cb': 50.0}
    vru = smsfusion.VRU(recording.params.rate, err_acc=err_acc, err_gyro=err_gyro)
    angles = np.zeros((len(recording.truth.t), 2))
    for i, (force, rate) in enumerate(zip(recording.accelerometer * turned, recording.gyro * turned)):
        vru.update(force, rate)
        angles[i] = vru.euler()[:2]
    roll, pitch = angles.T
    error = np.degrees(np.column_stack([roll, -pitch]) - recording.truth.angles[:, :2])
    return np.column_stack([error, np.zeros(len(error))])


class Measured(NamedTuple):
    """Score, and by seed the mean NEES of tilt (2 dof) and attitude (3 dof) and the mean NIS by source."""

    score: Score
    nees_tilt: np.ndarray
    nees: np.ndarray
    nis: dict[str, np.ndarray]


@functools.cache
def measure_scenario(
    name: str, seeds: range, params: AttitudeParams, use_log: bool = False, **changes: Any
) -> Measured:
    """Return what the filter does in the named scenario over `seeds`, measured once however often asked."""
    one_seed = functools.partial(_measure_seed, name, params, use_log, changes)
    score, tilt, full, nis = Score(), [], [], {}
    for errors, by_source in over_seeds(one_seed, seeds):
        score.add(errors.angles)
        tilt.append(float(np.mean(errors.nees_tilt)))
        full.append(float(np.mean(errors.nees)))
        for source, value in by_source.items():
            nis.setdefault(source, []).append(value)
    return Measured(score, np.array(tilt), np.array(full), {k: np.array(v) for k, v in nis.items()})


def over_seeds(function: Callable, seeds: Iterable[int]) -> Iterator:
    """Yield ``function(seed)`` in order of `seeds`, on all cores."""
    # Forked: the modules beside bench.py are known to this process alone.
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context('fork')) as pool:
        yield from pool.map(function, seeds)


def _measure_seed(
    name: str, params: AttitudeParams, use_log: bool, changes: dict, seed: int
) -> tuple[AttitudeErrors, dict[str, float]]:
    recording = simulate(scenario(name, **changes), seed)
    result = run_recording(recording, params, use_log)
    errors = attitude_errors(recording, result.rows, _EVERY)
    scored = recording.truth.t[::_EVERY] >= SETTLED
    return AttitudeErrors(*(values[scored] for values in errors)), result.nis


def response(recording: Recording, estimate: np.ndarray) -> float:
    """Return the delay [s] of the best correlation between a roll (N,) [deg] and truth, within ±1 s."""
    truth = np.degrees(recording.truth.angles[:, 0])
    rate = recording.params.rate
    inner = slice(int((SETTLED + 2.0) * rate), -int(2.0 * rate))
    errors = {}
    for shift in range(-int(rate), int(rate) + 1):
        start, stop = inner.start + shift, len(truth) + inner.stop + shift
        errors[shift] = float(np.mean((estimate[start:stop] - truth[inner]) ** 2))
    return min(errors, key=lambda s: errors[s]) / rate


def step_response(params: AttitudeParams) -> float:
    """Return the time [s] to 63 % of a heel step of 10° within 0.1 s, on an otherwise calm ship."""
    recording = simulate(scenario('calm', largest_roll=0.01, largest_pitch=0.01, largest_yaw=0.01), 0)
    t, rate = recording.truth.t, recording.params.rate
    start, length, height = 300.0, 0.1, math.radians(10.0)
    x = np.clip((t - start) / length, 0.0, 1.0)
    step = height * x * x * (3.0 - 2.0 * x)
    angles = recording.truth.angles.copy()
    before = rotation_matrices(angles)
    angles[:, 0] += step
    after = rotation_matrices(angles)
    # The same level-frame specific force, seen from the heeled body; the heel's rate added to the gyro.
    level = np.einsum('nij,nj->ni', before, recording.accelerometer)
    force = np.einsum('nji,nj->ni', after, level)
    gyro = recording.gyro.copy()
    gyro[:, 0] += np.gradient(step, 1.0 / rate)
    field_n = np.einsum('nij,nj->ni', _at(before, recording.magnetometer_t, rate), recording.magnetometer)
    field = np.einsum('nji,nj->ni', _at(after, recording.magnetometer_t, rate), field_n)
    import dataclasses

    stepped = dataclasses.replace(
        recording,
        gyro=gyro,
        accelerometer=force,
        magnetometer=field,
        truth=dataclasses.replace(recording.truth, angles=angles),
    )
    errors = attitude_errors(stepped, run_recording(stepped, params).rows)
    roll = errors.angles[:, 0] + np.degrees(angles[:, 0])
    base = float(np.mean(roll[int((start - 1.0) * rate) : int(start * rate)]))
    risen = np.flatnonzero((t >= start) & (roll - base >= 0.632 * 10.0))
    truth_risen = np.flatnonzero((t >= start) & (step >= 0.632 * height))
    return float(t[risen[0]] - t[truth_risen[0]])


def _at(matrices: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    return matrices[np.minimum(np.round(times * rate).astype(int), len(matrices) - 1)]


def published_index(raw: np.ndarray, filtered: np.ndarray) -> float:
    """Return the paper's eq. 20 [dB]: energy of the filtered signal over that of what was removed."""
    return 10.0 * math.log10(float(np.sum(filtered**2) / np.sum((filtered - raw) ** 2)))


def true_gain(raw: np.ndarray, filtered: np.ndarray, truth: np.ndarray) -> float:
    """Return 10 log10 of the mean square error before over after [dB]."""
    return 10.0 * math.log10(float(np.mean((raw - truth) ** 2) / np.mean((filtered - truth) ** 2)))
