# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulator: the motion, the field, and the errors of each sensor.

The defaults are those of an MPU6050 (datasheet 3.4: noise 0.005 °/s/√Hz and 400 µg/√Hz) beside a
HMC5883L (2 mG of noise, 0.73 mG of resolution), with the bias it has after a calibration at rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from kalman_core.parameters import ParameterError, parameter

MOTIONS = ('still', 'tilt_steps', 'tumble', 'hand_held', 'rolling_ship', 'vehicle')
BIAS_MODELS = ('gauss_markov', 'flicker')

_DEG = math.pi / 180.0
_G = 9.80665  # m/s^2, standard gravity: datasheets quote accelerations in multiples of it


@dataclass(frozen=True, slots=True)
class SimulatorParams:
    """One simulated inertial and magnetic sensor, moved by a named motion."""

    motion: str = parameter('hand_held', 'truth', choices=MOTIONS)
    seed: int = parameter(1, 'seed of every random quantity', minimum=0, maximum=2**31 - 1)
    rate: float = parameter(100.0, 'samples per second', unit='Hz', minimum=1.0, maximum=1000.0)
    mag_every: int = parameter(1, 'magnetometer: one sample for so many of the gyro', minimum=1, maximum=1000)
    frame_id: str = parameter('imu_link', 'frame of the sensors')
    world_frame: str = parameter('map', 'frame the true orientation refers to (ENU)')

    initial_rest: float = parameter(2.0, 'at rest before the motion starts', unit='s', minimum=0.0)
    motion_time: float = parameter(
        0.0, 'length of a spell of motion; 0: never interrupted', unit='s', minimum=0.0
    )
    rest_time: float = parameter(0.0, 'rest between two spells of motion', unit='s', minimum=0.0)
    orientation: tuple = parameter(
        (0.0, 0.0, 0.0), 'roll, pitch, yaw that the motion starts from or swings about', unit='rad'
    )
    lever_arm: tuple = parameter((0.0, 0.0, 0.0), 'sensor from the centre of rotation, body frame', unit='m')
    ship_roll: float = parameter(
        15.0 * _DEG, 'rolling_ship: roll amplitude', unit='rad', minimum=0.0, maximum=1.0
    )

    gravity: float = parameter(_G, 'normal gravity', unit='m/s^2', minimum=9.7, maximum=9.9)
    field_strength: float = parameter(48.5e-6, 'magnetic field', unit='T', minimum=1e-6, maximum=1e-4)
    field_dip: float = parameter(
        68.0 * _DEG, 'dip of the field, down positive', unit='rad', minimum=-1.57, maximum=1.57
    )
    declination: float = parameter(
        0.0, 'magnetic north from true north, east positive', unit='rad', minimum=-3.15, maximum=3.15
    )

    ambient_temperature: float = parameter(25.0, 'at start', unit='degC', minimum=-40.0, maximum=85.0)
    warm_up_rise: float = parameter(8.0, 'self-heating in the end', unit='K', minimum=0.0, maximum=60.0)
    warm_up_time: float = parameter(300.0, 'time constant of the self-heating', unit='s', minimum=1.0)
    bias_model: str = parameter(
        'flicker', 'bias instability: one first-order process, or 1/f noise', choices=BIAS_MODELS
    )

    gyro_noise: float = parameter(0.005 * _DEG, 'white noise', unit='rad/s/sqrt(Hz)', minimum=0.0)
    gyro_bias: tuple = parameter((0.0, 0.0, 0.0), 'constant bias', unit='rad/s')
    gyro_turn_on: float = parameter(0.2 * _DEG, 'turn-on bias, 1 sigma by seed', unit='rad/s', minimum=0.0)
    gyro_instability: float = parameter(0.005 * _DEG, 'bias instability', unit='rad/s', minimum=0.0)
    gyro_correlation: float = parameter(
        300.0, 'correlation time of the instability (gauss_markov)', unit='s', minimum=0.1
    )
    gyro_walk: float = parameter(0.0, 'random walk of the bias', unit='rad/s/sqrt(s)', minimum=0.0)
    gyro_scale: tuple = parameter((0.0, 0.0, 0.0), 'scale factor errors', unit='1')
    gyro_misalignment: tuple = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 'cross-axis gains xy xz yx yz zx zy', unit='1'
    )
    gyro_temperature: tuple = parameter((0.0, 0.0, 0.0), 'bias per kelvin of self-heating', unit='rad/s/K')
    gyro_g_sensitivity: tuple = parameter(
        (0.0, 0.0, 0.0), 'bias per specific force along the axis', unit='(rad/s)/(m/s^2)'
    )
    gyro_range: float = parameter(500.0 * _DEG, 'saturation', unit='rad/s', minimum=1e-3)
    gyro_resolution: float = parameter(
        500.0 * _DEG / 32768.0, 'quantisation step; 0: none', unit='rad/s', minimum=0.0
    )

    accel_noise: float = parameter(400e-6 * _G, 'white noise', unit='m/s^2/sqrt(Hz)', minimum=0.0)
    accel_bias: tuple = parameter((0.0, 0.0, 0.0), 'constant bias', unit='m/s^2')
    accel_turn_on: float = parameter(2e-3 * _G, 'turn-on bias, 1 sigma by seed', unit='m/s^2', minimum=0.0)
    accel_instability: float = parameter(50e-6 * _G, 'bias instability', unit='m/s^2', minimum=0.0)
    accel_correlation: float = parameter(
        300.0, 'correlation time of the instability (gauss_markov)', unit='s', minimum=0.1
    )
    accel_walk: float = parameter(0.0, 'random walk of the bias', unit='m/s^2/sqrt(s)', minimum=0.0)
    accel_scale: tuple = parameter((0.0, 0.0, 0.0), 'scale factor errors', unit='1')
    accel_misalignment: tuple = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 'cross-axis gains xy xz yx yz zx zy', unit='1'
    )
    accel_temperature: tuple = parameter((0.0, 0.0, 0.0), 'bias per kelvin of self-heating', unit='m/s^2/K')
    accel_range: float = parameter(4.0 * _G, 'saturation', unit='m/s^2', minimum=0.1)
    accel_resolution: float = parameter(
        4.0 * _G / 32768.0, 'quantisation step; 0: none', unit='m/s^2', minimum=0.0
    )

    mag_noise: float = parameter(0.2e-6, 'white noise of one sample, 1 sigma', unit='T', minimum=0.0)
    mag_hard_iron: tuple = parameter((0.0, 0.0, 0.0), 'field that turns with the body', unit='T')
    mag_soft_iron: tuple = parameter(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 'gain of the field, by rows', unit='1'
    )
    mag_range: float = parameter(130e-6, 'saturation', unit='T', minimum=1e-6)
    mag_resolution: float = parameter(73e-9, 'quantisation step; 0: none', unit='T', minimum=0.0)
    mag_disturbance: tuple = parameter((0.0, 0.0, 0.0), 'passing disturbance, world frame', unit='T')
    mag_disturbance_start: float = parameter(10.0, 'when it comes', unit='s', minimum=0.0)
    mag_disturbance_time: float = parameter(0.0, 'how long it stays; 0: never comes', unit='s', minimum=0.0)

    vibration_frequency: tuple = parameter((31.0, 47.0), 'two lines', unit='Hz', minimum=0.0)
    vibration_accel: tuple = parameter((0.0, 0.0), 'amplitude of the two lines', unit='m/s^2', minimum=0.0)
    vibration_gyro: tuple = parameter((0.0, 0.0), 'amplitude of the two lines', unit='rad/s', minimum=0.0)

    def __post_init__(self) -> None:
        # Two ramps of 1 s each start and end a spell of motion (simulation_motion.RAMP).
        if 0.0 < self.motion_time < 2.0:
            raise ParameterError(
                f"parameter 'motion_time' is {self.motion_time:g}, allowed: 0 (never interrupted) or >= 2 s"
            )
