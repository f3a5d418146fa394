# SPDX-License-Identifier: Apache-2.0
"""Sensor samples to messages, in place, for rclpy's and rosbags' message objects alike.

Covariances are those of one sample about its slowly varying bias, which is not white and so not in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from node_core.messages import set3, set_quaternion, set_stamp

Vector = Sequence[float] | np.ndarray

IMU = 'sensor_msgs/msg/Imu'
MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
QUATERNION = 'geometry_msgs/msg/QuaternionStamped'


def prepare_imu(message: Any, frame: str, gyro_variance: float, accel_variance: float) -> None:
    """Fill what is the same in every raw Imu message; the orientation is marked as absent (REP-145)."""
    message.header.frame_id = frame
    absent = np.zeros(9)
    absent[0] = -1.0
    message.orientation_covariance = absent
    message.angular_velocity_covariance = np.diag([gyro_variance] * 3).ravel()
    message.linear_acceleration_covariance = np.diag([accel_variance] * 3).ravel()


def encode_imu(message: Any, stamp: int, gyro: Vector, accel: Vector) -> None:
    """Fill a prepared sensor_msgs/Imu: stamp (ns), gyro (rad/s), specific force (m/s²)."""
    set_stamp(message.header, stamp)
    set3(message.angular_velocity, gyro)
    set3(message.linear_acceleration, accel)


def prepare_mag(message: Any, frame: str, variance: float) -> None:
    """Fill what is the same in every MagneticField message; `variance` in T²."""
    message.header.frame_id = frame
    message.magnetic_field_covariance = np.diag([variance] * 3).ravel()


def encode_mag(message: Any, stamp: int, field: Vector) -> None:
    """Fill a prepared sensor_msgs/MagneticField: stamp (ns), field (T)."""
    set_stamp(message.header, stamp)
    set3(message.magnetic_field, field)


def encode_orientation(message: Any, stamp: int, quaternion: Vector) -> None:
    """Fill a geometry_msgs/QuaternionStamped: stamp (ns), wxyz, body to ENU; the frame is set before."""
    set_stamp(message.header, stamp)
    set_quaternion(message.quaternion, quaternion)


def encode_temperature(message: Any, stamp: int, celsius: float) -> None:
    """Fill a sensor_msgs/Temperature; 0 as variance says unknown, as the message defines."""
    set_stamp(message.header, stamp)
    message.temperature = float(celsius)
    message.variance = 0.0
