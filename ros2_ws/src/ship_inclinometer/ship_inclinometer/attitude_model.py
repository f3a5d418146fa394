# SPDX-License-Identifier: Apache-2.0
"""Settings of the inertial filter's kernels."""

from __future__ import annotations

import math

import numpy as np

from ship_inclinometer import attitude_layout as k
from ship_inclinometer.params import AttitudeParams

_MG = 1e-3 * k.GRAVITY


def settings(p: AttitudeParams) -> np.ndarray:
    """Return the array (SETTINGS,) that the kernels read, in SI units."""
    c = np.zeros(k.SETTINGS)
    # One-sided density to the variance rate of the integrated noise: half its square.
    c[k.C_GYRO_NOISE] = math.radians(p.gyro_noise) / math.sqrt(2.0)
    c[k.C_BIAS_WALK] = math.radians(p.gyro_bias_walk)
    c[k.C_BIAS_SIGMA] = math.radians(p.gyro_bias_sigma)
    c[k.C_ACC_NOISE] = p.accelerometer_noise / math.sqrt(2.0)
    c[k.C_ACC_BIAS_SIGMA] = p.accelerometer_bias_sigma * _MG
    c[k.C_ACC_BIAS_WALK] = p.accelerometer_bias_walk * _MG
    c[k.C_ALIGN_TIME] = p.align_time
    c[k.C_ALIGN_SIGMA] = p.align_sigma
    c[k.C_WAVE_DAMPING] = p.wave_damping
    c[k.C_WAVE_SIGMA] = p.wave_sigma
    c[k.C_WAVE_PERIOD] = p.wave_period
    c[k.C_WAVE_TIME] = p.wave_time
    c[k.C_AIDING_INTERVAL] = p.aiding_interval
    c[k.C_AIDING_SIGMA] = p.aiding_sigma
    c[k.C_PATH_WALK] = p.path_walk
    c[k.C_PATH_TURN] = p.path_turn
    c[k.C_SPEED_SIGMA] = p.speed_sigma
    c[k.C_LEEWAY_SIGMA] = p.leeway_sigma
    c[k.C_LOG_SIGMA] = p.log_sigma
    c[k.C_GNSS_SIGMA] = p.gnss_sigma
    c[k.C_MAG_NOISE] = 1e-6 * p.magnetometer_noise
    c[k.C_DEVIATION] = math.radians(p.deviation_sigma)
    c[k.C_DEVIATION_ANGLE] = math.radians(p.deviation_angle)
    c[k.C_DECLINATION] = math.radians(p.declination)
    c[k.C_NORM_GATE] = p.field_norm_gate
    c[k.C_DIP_GATE] = math.radians(p.field_dip_gate)
    c[k.C_MAG_LOCKOUT] = p.magnetic_lockout
    c[k.C_LEVER : k.C_LEVER + 3] = p.imu_lever_arm
    c[k.C_ANTENNA : k.C_ANTENNA + 3] = p.antenna_lever_arm
    c[k.C_SWING : k.C_SWING + 5] = np.radians(p.deviation_coefficients)
    return c
