# SPDX-License-Identifier: Apache-2.0
"""Readings of the CAN and GPS drivers to messages."""

from __future__ import annotations

from typing import Any

from ev_velocity.can_frames import Acceleration, Gear, Pedals, Reading, Speed, Wheels
from ev_velocity.codec import BODY, IMU, JOINTS, TWIST, UNKNOWN
from ev_velocity.gps_stream import GpsSpeed
from node_core.messages import set_floats, set_stamp

# What a CAN speed signal is good for: 1 km/h steps at worst, and its filtering in the car.
SPEED_SIGMA = 0.15  # m/s

TOPICS = {
    Wheels: ('wheel/states', JOINTS),
    Pedals: ('vehicle/pedals', JOINTS),
    Speed: ('vehicle/speed', TWIST),
    Gear: ('vehicle/gear', JOINTS),
    Acceleration: ('imu/data_raw', IMU),
}


def _unknown_but_first(covariance: Any, count: int, variance: float) -> None:
    covariance[:] = [0.0] * len(covariance)
    for i in range(count):
        covariance[(count + 1) * i] = UNKNOWN
    covariance[0] = variance


def encode_reading(reading: Reading, message: Any, stamp: int, wheel_radius: float) -> None:
    """Fill the message of `TOPICS` for a reading; wheels are turned into rad/s."""
    set_stamp(message.header, stamp)
    message.header.frame_id = BODY
    if isinstance(reading, Wheels):
        message.name = list(reading.names)
        set_floats(message, 'velocity', [speed / wheel_radius for speed in reading.speeds])
    elif isinstance(reading, Pedals):
        message.name = ['accelerator', 'brake']
        set_floats(message, 'position', [reading.accelerator, reading.brake])
    elif isinstance(reading, Gear):
        message.name = ['gear']
        set_floats(message, 'position', [float(reading.direction)])
    elif isinstance(reading, Speed):
        message.twist.twist.linear.x = reading.speed
        _unknown_but_first(message.twist.covariance, 6, SPEED_SIGMA**2)
    else:
        message.linear_acceleration.x = reading.acceleration
        message.orientation_covariance[0] = -1.0
        message.angular_velocity_covariance[0] = -1.0
        _unknown_but_first(message.linear_acceleration_covariance, 3, 1.0)


def encode_gps(speed: GpsSpeed, message: Any, stamp: int, frame_id: str) -> None:
    """Fill a TwistWithCovarianceStamped in east and north."""
    set_stamp(message.header, stamp)
    message.header.frame_id = frame_id
    message.twist.twist.linear.x = speed.east
    message.twist.twist.linear.y = speed.north
    variance = speed.sigma * speed.sigma
    _unknown_but_first(message.twist.covariance, 6, variance)
    message.twist.covariance[7] = variance
