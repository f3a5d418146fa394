# SPDX-License-Identifier: Apache-2.0
"""A ship in a sea and the sensors aboard: truth and measurements, vectorised and seeded.

Body frame x forward, y left (port), z up; level frame ENU. A positive roll lowers the starboard side, a
positive pitch lowers the bow, yaw is counted from east, counter-clockwise.

The sea is a sum of Gaussian wave components (JONSWAP or Pierson-Moskowitz, DNV-RP-C205 section 3.5); roll,
pitch and yaw answer its slope as second-order systems (Perez, "Ship Motion Control", 2005, chapter 3). All
derivatives come from the components, so that accelerations are exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ship_inclinometer.sea import Motion, manoeuvre, sea_motion, sine_motion, tumble_motion
from ship_inclinometer.simulation_params import SCENARIOS, SimulatorParams, scenario

__all__ = ['SCENARIOS', 'Recording', 'SimulatorParams', 'Truth', 'scenario', 'simulate']

GRAVITY = 9.80665
# One gauss in tesla.
GAUSS = 1e-4


@dataclass(frozen=True)
class Truth:
    """What is true at the IMU, one row per IMU sample, t in s since the start.

    angles (N, 3): roll, pitch, yaw [rad], not wrapped; rates (N, 3): body rates [rad/s]; velocity (N, 3):
    of the IMU in ENU [m/s]; gyro_bias (N, 3) [rad/s]; accelerometer_bias (3,) [m/s²]; speed (N,): of the
    ship along its course [m/s].
    """

    t: np.ndarray
    angles: np.ndarray
    rates: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accelerometer_bias: np.ndarray
    speed: np.ndarray
    turn_rate: np.ndarray


@dataclass(frozen=True)
class Recording:
    """Truth and what the sensors said.

    gyro (N, 3) [rad/s] and accelerometer (N, 3) [m/s², specific force] at truth.t; magnetometer (M, 3) [T]
    at magnetometer_t; GNSS velocity (K, 3) ENU [m/s], valid at gnss_t - params.gnss_delay; log_speed (L,)
    [m/s] at log_t.
    """

    params: SimulatorParams
    truth: Truth
    gyro: np.ndarray
    accelerometer: np.ndarray
    magnetometer_t: np.ndarray
    magnetometer: np.ndarray
    gnss_t: np.ndarray
    gnss_velocity: np.ndarray
    log_t: np.ndarray
    log_speed: np.ndarray


def simulate(params: SimulatorParams, seed: int = 0) -> Recording:
    """Return one recording; equal `params` and `seed` give equal numbers."""
    rng = np.random.default_rng(seed)
    samples = round(params.duration * params.rate)
    t = np.arange(samples) / params.rate
    if params.sea == 'tumble':
        motion = tumble_motion(t)
    else:
        motion = sine_motion(params, t, rng) if params.sea == 'sine' else sea_motion(params, t, rng)
    motion = manoeuvre(params, t, motion)

    lever = np.array([params.imu_forward, -params.imu_starboard, -params.imu_down])
    antenna = np.array([params.antenna_forward, -params.antenna_starboard, -params.antenna_down])
    mats = rotation_matrices(motion.angles)
    rates, accelerations = body_rates(motion)
    turning = np.cross(rates, np.broadcast_to(lever, rates.shape))
    tangential = np.cross(accelerations, np.broadcast_to(lever, rates.shape))
    lever_acceleration = tangential + np.cross(rates, turning)
    specific = np.einsum('nji,nj->ni', mats, motion.acceleration + [0.0, 0.0, GRAVITY]) + lever_acceleration
    velocity = motion.velocity + np.einsum('nij,nj->ni', mats, turning)
    velocity_antenna = motion.velocity + np.einsum(
        'nij,nj->ni', mats, np.cross(rates, np.broadcast_to(antenna, rates.shape))
    )

    gyro_bias = _gyro_bias(params, t, rng)
    accelerometer_bias = 1e-3 * params.accelerometer_bias * GRAVITY * rng.choice([-1.0, 1.0], 3)
    truth = Truth(
        t,
        motion.angles,
        rates,
        velocity,
        gyro_bias,
        accelerometer_bias,
        motion.speed,
        motion.turn_rate,
    )
    # The still log was taken at 100 Hz: equal noise density at another rate means another deviation.
    density = math.sqrt(params.rate / 100.0)
    gyro = rates + gyro_bias + math.radians(params.gyro_noise) * density * rng.standard_normal((samples, 3))
    noise = 1e-3 * GRAVITY * np.array(params.accelerometer_noise) * density
    noise = np.hypot(noise, math.radians(params.angle_noise) * GRAVITY)
    accelerometer = specific + accelerometer_bias + noise * rng.standard_normal((samples, 3))
    accelerometer += _engine(params, t, rng)
    magnetometer_t, magnetometer = _magnetometer(params, t, motion.angles, mats, rng)
    gnss_t, gnss_velocity = _gnss(params, t, velocity_antenna, rng)
    log_t = np.arange(1.0, params.duration, 1.0)
    scale = 1.0 + params.log_scale_error * rng.standard_normal()
    log_speed = scale * np.interp(log_t, t, motion.speed)
    log_speed = log_speed + params.log_noise * rng.standard_normal(len(log_t))
    return Recording(
        params,
        truth,
        gyro,
        accelerometer,
        magnetometer_t,
        magnetometer,
        gnss_t,
        gnss_velocity,
        log_t,
        log_speed,
    )


def rotation_matrices(angles: np.ndarray) -> np.ndarray:
    """Return ``mat_nb`` (N, 3, 3) of (N, 3) roll, pitch, yaw [rad], intrinsic ZYX."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T), np.sin(angles.T)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def body_rates(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return body rates [rad/s] and their derivatives [rad/s²], (N, 3) each, from ZYX angles.

    Source: Fossen, "Handbook of Marine Craft Hydrodynamics and Motion Control" (2011), eq. 2.26, for the
    axes of this workspace.
    """
    roll, pitch, _ = motion.angles.T
    dr, dp, dy = motion.angle_rates.T
    ddr, ddp, ddy = motion.angle_accelerations.T
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    rates = np.column_stack([dr - sp * dy, cr * dp + sr * cp * dy, -sr * dp + cr * cp * dy])
    accelerations = np.column_stack(
        [
            ddr - sp * ddy - cp * dp * dy,
            cr * ddp - sr * dr * dp + sr * cp * ddy + (cr * cp * dr - sr * sp * dp) * dy,
            -sr * ddp - cr * dr * dp + cr * cp * ddy - (sr * cp * dr + cr * sp * dp) * dy,
        ]
    )
    return rates, accelerations


def _gyro_bias(params: SimulatorParams, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    sign = rng.choice([-1.0, 1.0], 3)
    # Ends of the warm-up are rounded off: 95 % of it is over after gyro_warmup_time.
    warming = 1.0 - np.exp(-3.0 * t / params.gyro_warmup_time)
    warmup = params.gyro_warmup * rng.choice([-1.0, 1.0], 3) * warming[:, None]
    steps = params.gyro_bias_walk / math.sqrt(params.rate) * rng.standard_normal((len(t), 3))
    return np.radians(params.gyro_bias * sign + warmup + np.cumsum(steps, axis=0))


def _engine(params: SimulatorParams, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    lines = np.zeros((len(t), 3))
    for frequency in params.engine_frequencies:
        if frequency == 0.0:
            continue
        phase = rng.uniform(0.0, 2.0 * math.pi, 3)
        lines += params.engine_acceleration * np.sin(2.0 * math.pi * frequency * t[:, None] + phase)
    return lines


def _magnetometer(
    params: SimulatorParams, t: np.ndarray, angles: np.ndarray, mats: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    times = np.arange(0.0, t[-1], 1.0 / params.magnetometer_rate)
    # Linear between two IMU samples: 2.5 ms of roll at 10 deg/s is 0.02 deg at most, far below the noise.
    low = np.minimum(np.floor(times * params.rate).astype(int), len(t) - 2)
    weight = (times * params.rate - low)[:, None]
    between = (1.0 - weight) * angles[low] + weight * angles[low + 1]
    dip, declination = math.radians(params.field_dip), math.radians(params.declination)
    horizontal = math.cos(dip)
    field = params.field_norm * np.array(
        [horizontal * math.sin(declination), horizontal * math.cos(declination), -math.sin(dip)]
    )
    soft = params.soft_iron * rng.standard_normal((3, 3))
    hard = rng.standard_normal(3)
    hard *= params.hard_iron / np.linalg.norm(hard)
    body = np.einsum('nji,j->ni', rotation_matrices(between), field)
    milligauss = body + body @ (0.5 * (soft + soft.T)) + hard
    noise = math.hypot(
        params.magnetometer_noise, math.radians(params.angle_noise) * horizontal * params.field_norm
    )
    milligauss += noise * rng.standard_normal(body.shape)
    disturbed = (times >= params.disturbance_start) & (
        times < params.disturbance_start + params.disturbance_time
    )
    milligauss[disturbed] += [0.7 * params.disturbance, 0.6 * params.disturbance, 0.4 * params.disturbance]
    return times, 1e-3 * GAUSS * milligauss


def _gnss(
    params: SimulatorParams, t: np.ndarray, velocity: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    if params.gnss_rate <= 0.0:
        return np.empty(0), np.empty((0, 3))
    valid = np.arange(1.0, t[-1], 1.0 / params.gnss_rate)
    kept = (valid < params.gnss_dropout_start) | (
        valid >= params.gnss_dropout_start + params.gnss_dropout_time
    )
    valid = valid[kept]
    interpolated = np.column_stack([np.interp(valid, t, velocity[:, i]) for i in range(3)])
    noise = params.gnss_noise * rng.standard_normal(interpolated.shape)
    return valid + params.gnss_delay, interpolated + noise
