# SPDX-License-Identifier: Apache-2.0
"""Messages to samples, estimates to messages, and the port tables of both estimators."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from imu_kalman.angle import AngleFilter
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.params import AttitudeParams, TwoStateParams
from imu_kalman.samples import (
    FORCE_COV,
    ORIENTATION_COV,
    RATE_COV,
    Attitude,
    GyroBias,
    ImuSample,
    MagSample,
    RollPitchYaw,
    SettledAttitude,
)
from node_core.messages import NANOSECONDS, finite3, set_stamp, stamp_of
from node_core.ports import BadMessage, Input, Output, Ports


def decode_imu(message: Any) -> ImuSample:
    """Decode a sensor_msgs/Imu without using its orientation; raise BadMessage for what is not usable."""
    header = message.header
    stamp = header.stamp
    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
    if stamp_ns <= 0:
        raise BadMessage('zero stamp')
    # REP-145: what is not measured has -1 as the first entry of its covariance.
    gyr_var = float(message.angular_velocity_covariance[0])
    if gyr_var == -1.0:
        raise BadMessage('no angular velocity')
    if message.linear_acceleration_covariance[0] == -1.0:
        raise BadMessage('no specific force')
    rate = message.angular_velocity
    force = message.linear_acceleration
    gx, gy, gz = rate.x, rate.y, rate.z
    ax, ay, az = force.x, force.y, force.z
    if not math.isfinite(gx + gy + gz):
        raise BadMessage('angular velocity not finite')
    if not math.isfinite(ax + ay + az):
        raise BadMessage('specific force not finite')
    return ImuSample(stamp_ns, (gx, gy, gz), (ax, ay, az), header.frame_id, gyr_var)


def decode_mag(message: Any) -> MagSample:
    """Decode a sensor_msgs/MagneticField (tesla); raise BadMessage for what is not usable."""
    field = finite3(message.magnetic_field, 'magnetic field')
    return MagSample(stamp_of(message), field, message.header.frame_id)


def encode_attitude(estimate: Attitude, message: Any) -> None:
    """Fill a sensor_msgs/Imu: orientation body to ENU, corrected rate, specific force, covariances."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    values = estimate.values
    qw, qx, qy, qz, gx, gy, gz, ax, ay, az = values[:10].tolist()
    orientation = message.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = qx, qy, qz, qw
    rate = message.angular_velocity
    rate.x, rate.y, rate.z = gx, gy, gz
    force = message.linear_acceleration
    force.x, force.y, force.z = ax, ay, az
    message.orientation_covariance = values[ORIENTATION_COV]
    message.angular_velocity_covariance = values[RATE_COV]
    message.linear_acceleration_covariance = values[FORCE_COV]


def encode_angles(estimate: RollPitchYaw, message: Any) -> None:
    """Fill a geometry_msgs/Vector3Stamped with roll, pitch, yaw (rad)."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    message.vector.x, message.vector.y, message.vector.z = estimate.angles


def encode_bias(estimate: GyroBias, message: Any) -> None:
    """Fill a geometry_msgs/TwistWithCovarianceStamped: angular part bias (rad/s); linear part zero."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    angular = message.twist.twist.angular
    angular.x, angular.y, angular.z = estimate.bias
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = estimate.covariance
    message.twist.covariance = covariance.ravel()


_IMU = 'sensor_msgs/msg/Imu'
_VECTOR = 'geometry_msgs/msg/Vector3Stamped'

ANGLE_PORTS = Ports(
    name='angle_estimator',
    params=TwoStateParams,
    estimator=AngleFilter,
    inputs=(Input('imu/data_raw', _IMU, decode_imu, 'on_imu', timeout=0.5),),
    outputs={
        Attitude: Output('imu/data', _IMU, encode_attitude),
        RollPitchYaw: Output('imu/rpy', _VECTOR, encode_angles),
        SettledAttitude: Output('imu/data_settled', _IMU, encode_attitude),
    },
)

ATTITUDE_PORTS = Ports(
    name='attitude_estimator',
    params=AttitudeParams,
    estimator=AttitudeFilter,
    inputs=(
        Input('imu/data_raw', _IMU, decode_imu, 'on_imu', timeout=0.5),
        Input('imu/mag', 'sensor_msgs/msg/MagneticField', decode_mag, 'on_mag'),
    ),
    outputs={
        Attitude: Output('imu/data', _IMU, encode_attitude),
        GyroBias: Output('imu/bias', 'geometry_msgs/msg/TwistWithCovarianceStamped', encode_bias),
        SettledAttitude: Output('imu/data_settled', _IMU, encode_attitude),
    },
)

ESTIMATORS = {ports.name: ports for ports in (ANGLE_PORTS, ATTITUDE_PORTS)}
