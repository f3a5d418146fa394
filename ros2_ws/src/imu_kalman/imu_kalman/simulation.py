# SPDX-License-Identifier: Apache-2.0
"""Simulated inertial and magnetic sensor: seeded, endless, the same in pieces as in one.

Samples are made in blocks of fixed length from sample 0 on and cut to what is asked for, so that any way of
asking gives the same bits.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation_errors import Triad, TriadSpec, digitise, sample_variance
from imu_kalman.simulation_motion import TruthModel, conjugate, rotate

NANOSECONDS = 1_000_000_000
# Long enough that numpy's overhead does not count, short enough for a first sample at once.
BLOCK = 256


class ImuBlock(NamedTuple):
    """n consecutive samples: truth (first four) and measurements.

    stamp: (n,) int64 ns; quaternion: (n, 4) wxyz, body to ENU; rate: (n, 3) rad/s and force: (n, 3) m/s²,
    body frame; gyro, accel: the same as measured; gyro_bias, accel_bias: the slow part of their errors;
    mag: (n, 3) tesla, NaN in rows without a magnetometer sample; temperature: (n,) °C.
    """

    stamp: np.ndarray
    quaternion: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    mag: np.ndarray
    temperature: np.ndarray


class Variances(NamedTuple):
    """Variance per axis of one sample about truth + bias: (rad/s)², (m/s²)², T²."""

    gyro: float
    accel: float
    mag: float


class ImuSimulator:
    """An endless stream of samples; `take` returns the next ones.

    `start` is the stamp (ns) of sample 0; sample i has the stamp start + ⌊i·10⁹/rate⌋.
    """

    def __init__(self, params: SimulatorParams, start: int = NANOSECONDS) -> None:
        self._params = params
        self._start = start
        self._rate = Fraction(params.rate).limit_denominator(1000)
        motion, gyro, accel, mag = np.random.SeedSequence(params.seed).spawn(4)
        self._truth = TruthModel(params, np.random.default_rng(motion))
        args = (params.bias_model, params.vibration_frequency, params.rate)
        self._gyro = Triad(_gyro_spec(params), *args, gyro)
        self._accel = Triad(_accel_spec(params), *args, accel)
        self._mag_rng = np.random.default_rng(mag)
        self._soft_iron = np.asarray(params.mag_soft_iron).reshape(3, 3)
        self._field = field_vector(params)
        self._next_index = 0
        self._waiting: ImuBlock | None = None

    @property
    def variances(self) -> Variances:
        """What the covariances of the messages should say; biases are correlated and not included."""
        p = self._params
        return Variances(
            self._gyro.variance, self._accel.variance, sample_variance(p.mag_noise, p.mag_resolution)
        )

    def take(self, count: int) -> ImuBlock:
        """Return the next `count` samples."""
        parts = []
        missing = count
        while True:
            if self._waiting is None:
                self._waiting = self._block()
            have = len(self._waiting.stamp)
            used = min(missing, have)
            parts.append(ImuBlock(*(field[:used] for field in self._waiting)))
            self._waiting = None if used == have else ImuBlock(*(field[used:] for field in self._waiting))
            missing -= used
            if missing == 0:
                return ImuBlock(*(np.concatenate(fields) for fields in zip(*parts)))

    def _block(self) -> ImuBlock:
        p = self._params
        index = self._next_index + np.arange(BLOCK)
        times = index / p.rate
        truth = self._truth(times)
        warming = p.warm_up_rise * -np.expm1(-times / p.warm_up_time)
        accel, accel_bias = self._accel.take(truth.force, times, warming)
        leak = np.asarray(p.gyro_g_sensitivity) * truth.force
        gyro, gyro_bias = self._gyro.take(truth.rate, times, warming, leak)
        stamps = self._stamps()
        self._next_index += BLOCK
        return ImuBlock(
            stamps,
            truth.quaternion,
            truth.rate,
            truth.force,
            gyro,
            accel,
            gyro_bias,
            accel_bias,
            self._magnetometer(truth.quaternion, times, index),
            p.ambient_temperature + warming,
        )

    def _stamps(self) -> np.ndarray:
        # Exact for ever: whole nanoseconds and the remainder are split before int64 can overflow.
        numerator = NANOSECONDS * self._rate.denominator
        whole, rest = divmod(self._next_index * numerator, self._rate.numerator)
        return self._start + whole + (rest + np.arange(BLOCK) * numerator) // self._rate.numerator

    def _magnetometer(self, quaternion: np.ndarray, times: np.ndarray, index: np.ndarray) -> np.ndarray:
        p = self._params
        since = times - p.mag_disturbance_start
        disturbed = (since >= 0.0) & (since < p.mag_disturbance_time)
        field_n = self._field + disturbed[:, None] * np.asarray(p.mag_disturbance)
        field_b = np.einsum('ij,nj->ni', self._soft_iron, rotate(conjugate(quaternion), field_n))
        noise = p.mag_noise * self._mag_rng.standard_normal((BLOCK, 3))
        measured = digitise(field_b + np.asarray(p.mag_hard_iron) + noise, p.mag_range, p.mag_resolution)
        measured[index % p.mag_every != 0] = np.nan
        return measured


def field_vector(params: SimulatorParams) -> np.ndarray:
    """Return the magnetic field (3,) in ENU (T); dip is positive downwards, declination eastwards."""
    level = params.field_strength * math.cos(params.field_dip)
    return np.array(
        [
            level * math.sin(params.declination),
            level * math.cos(params.declination),
            -params.field_strength * math.sin(params.field_dip),
        ]
    )


def simulate(params: SimulatorParams, duration: float, start: int = NANOSECONDS) -> ImuBlock:
    """Return the samples of the first `duration` seconds; sample 0 has the stamp `start` (ns)."""
    return ImuSimulator(params, start).take(max(1, round(duration * params.rate)))


def _gyro_spec(p: SimulatorParams) -> TriadSpec:
    return TriadSpec(
        noise=p.gyro_noise,
        bias=p.gyro_bias,
        turn_on=p.gyro_turn_on,
        instability=p.gyro_instability,
        correlation=p.gyro_correlation,
        walk=p.gyro_walk,
        scale=p.gyro_scale,
        misalignment=p.gyro_misalignment,
        temperature=p.gyro_temperature,
        range=p.gyro_range,
        resolution=p.gyro_resolution,
        vibration=p.vibration_gyro,
    )


def _accel_spec(p: SimulatorParams) -> TriadSpec:
    return TriadSpec(
        noise=p.accel_noise,
        bias=p.accel_bias,
        turn_on=p.accel_turn_on,
        instability=p.accel_instability,
        correlation=p.accel_correlation,
        walk=p.accel_walk,
        scale=p.accel_scale,
        misalignment=p.accel_misalignment,
        temperature=p.accel_temperature,
        range=p.accel_range,
        resolution=p.accel_resolution,
        vibration=p.vibration_accel,
    )
