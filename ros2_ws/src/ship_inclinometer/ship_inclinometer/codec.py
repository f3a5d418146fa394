# SPDX-License-Identifier: Apache-2.0
"""Messages to samples, estimates to messages, and the port tables of both estimators."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from node_core.messages import finite3, set3, set_floats, set_quaternion, set_stamp, stamp_of
from node_core.ports import BadMessage, Input, Output, Ports
from ship_inclinometer import topics
from ship_inclinometer.attitude_estimator import AttitudeEstimator
from ship_inclinometer.bridge_params import AlarmParams, DisplayParams, ModbusParams, NmeaParams
from ship_inclinometer.hmc5883l_params import Hmc5883lParams
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.roll_analysis import RollAnalysis, RollCycle, RollState
from ship_inclinometer.roll_params import RollParams
from ship_inclinometer.samples import (
    Angles,
    Attitude,
    ImuSample,
    MagSample,
    SettledAttitude,
    SpeedSample,
    Validity,
    VelocitySample,
)
from ship_inclinometer.simulation_params import ShipSimulatorParams

IMU = 'sensor_msgs/msg/Imu'
FIELD = 'sensor_msgs/msg/MagneticField'
TWIST = 'geometry_msgs/msg/TwistWithCovarianceStamped'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
VALUES = 'sensor_msgs/msg/JointState'

# Order of the numbers in ship/roll, by name.
ROLL_NAMES = (
    'status',
    'heel',
    'roll_period',
    'amplitude_port',
    'amplitude_starboard',
    'peak_port',
    'peak_starboard',
    'peak_age',
    'delay',
    'mean_heel',
    'spectral_period',
    'synchronous_warning',
    'parametric_warning',
)
CYCLE_NAMES = ('maximum_age', 'side', 'heel', 'roll_period')
_REASON = 'reason: '
NANOSECONDS = 1_000_000_000


def decode_imu(message: Any) -> ImuSample:
    """Decode a sensor_msgs/Imu without using its orientation."""
    if message.angular_velocity_covariance[0] == -1.0 or message.linear_acceleration_covariance[0] == -1.0:
        raise BadMessage('rate or specific force not measured')
    gyro = finite3(message.angular_velocity, 'angular velocity')
    force = finite3(message.linear_acceleration, 'specific force')
    return ImuSample(stamp_of(message), gyro, force, message.header.frame_id)


def decode_mag(message: Any) -> MagSample:
    """Decode a sensor_msgs/MagneticField (T)."""
    return MagSample(stamp_of(message), finite3(message.magnetic_field, 'magnetic field'))


def decode_gnss(message: Any) -> VelocitySample:
    """Decode a geometry_msgs/TwistWithCovarianceStamped: velocity of the antenna in ENU."""
    velocity = finite3(message.twist.twist.linear, 'velocity')
    covariance = message.twist.covariance
    variance = (float(covariance[0]), float(covariance[7]), float(covariance[14]))
    if not math.isfinite(sum(variance)):
        raise BadMessage('covariance not finite')
    return VelocitySample(stamp_of(message), velocity, variance)


def decode_log(message: Any) -> SpeedSample:
    """Decode a geometry_msgs/TwistWithCovarianceStamped: linear.x is the speed through water."""
    speed = float(message.twist.twist.linear.x)
    if not math.isfinite(speed):
        raise BadMessage('speed not finite')
    return SpeedSample(stamp_of(message), speed)


def encode_attitude(estimate: Attitude | SettledAttitude, message: Any) -> None:
    """Fill a sensor_msgs/Imu: orientation body to ENU, corrected rate and specific force.

    The covariances of rate and force stay zero: "unknown" (sensor_msgs/Imu; -1 would say "not measured").
    """
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    set_quaternion(message.orientation, estimate.q)
    set3(message.angular_velocity, estimate.rate)
    set3(message.linear_acceleration, estimate.force)
    message.orientation_covariance[:] = estimate.covariance.ravel()


def decode_attitude(message: Any) -> Attitude:
    """Decode what `encode_attitude` wrote; the validity is not in it."""
    orientation = message.orientation
    q = np.array([orientation.w, orientation.x, orientation.y, orientation.z], dtype=np.float64)
    norm = float(np.sqrt(q @ q))
    if not abs(norm - 1.0) < 1e-3:
        raise BadMessage('quaternion norm')
    covariance = np.array(message.orientation_covariance, dtype=np.float64).reshape(3, 3)
    if not np.all(np.isfinite(covariance)):
        raise BadMessage('covariance not finite')
    rate = np.array(finite3(message.angular_velocity, 'angular velocity'))
    force = np.array(finite3(message.linear_acceleration, 'specific force'))
    return Attitude(stamp_of(message), message.header.frame_id, q / norm, rate, force, covariance, 0)


def encode_angles(estimate: Angles, message: Any) -> None:
    """Fill a geometry_msgs/Vector3Stamped with roll, pitch, yaw (rad)."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    set3(message.vector, estimate.angles)


def decode_angles(message: Any) -> Angles:
    """Decode what `encode_angles` wrote; 1σ and rates are not in it."""
    zeros = (0.0, 0.0, 0.0)
    angles = finite3(message.vector, 'angle')
    return Angles(stamp_of(message), message.header.frame_id, angles, zeros, zeros, 0)


def encode_validity(estimate: Validity, message: Any) -> None:
    """Fill a sensor_msgs/JointState of named numbers; the reason is a name of its own, of value 1."""
    numbers = {
        'validity': float(estimate.validity),
        'heading_valid': float(estimate.heading_valid),
        'sigma_roll': estimate.sigmas[0],
        'sigma_pitch': estimate.sigmas[1],
        'sigma_heading': estimate.sigmas[2],
    }
    if estimate.reason:
        numbers[_REASON + estimate.reason] = 1.0
    encode_numbers(message, estimate.stamp, numbers)


def decode_validity(message: Any) -> Validity:
    """Decode what `encode_validity` wrote."""
    numbers = decode_numbers(message)
    reason = next((n.removeprefix(_REASON) for n in numbers if n.startswith(_REASON)), '')
    try:
        validity = int(numbers['validity'])
        sigmas = (numbers['sigma_roll'], numbers['sigma_pitch'], numbers['sigma_heading'])
        return Validity(stamp_of(message), validity, reason, bool(numbers['heading_valid']), sigmas)
    except (KeyError, ValueError, OverflowError):
        raise BadMessage('not a validity') from None


def encode_roll(estimate: RollState, message: Any) -> None:
    """Fill a sensor_msgs/JointState with ROLL_NAMES: rad and s, NaN where not known."""
    values = (
        float(estimate.status),
        estimate.heel,
        estimate.period,
        estimate.amplitude_port,
        estimate.amplitude_starboard,
        estimate.peak_port,
        estimate.peak_starboard,
        (estimate.stamp - estimate.peak_reset) / NANOSECONDS,
        estimate.delay,
        estimate.mean_heel,
        estimate.spectral_period,
        float(estimate.synchronous),
        float(estimate.parametric),
    )
    encode_numbers(message, estimate.stamp, dict(zip(ROLL_NAMES, values)))


def encode_cycle(estimate: RollCycle, message: Any) -> None:
    """Fill a sensor_msgs/JointState with CYCLE_NAMES: one maximum of heel."""
    values = (estimate.delay, float(estimate.side), estimate.heel, estimate.period)
    encode_numbers(message, estimate.stamp, dict(zip(CYCLE_NAMES, values)))


def encode_numbers(message: Any, stamp: int, numbers: dict[str, float]) -> None:
    """Fill a sensor_msgs/JointState with named numbers as positions."""
    set_stamp(message.header, stamp)
    message.name = list(numbers)
    set_floats(message, 'position', list(numbers.values()))


def decode_numbers(message: Any) -> dict[str, float]:
    """Return the named positions of a sensor_msgs/JointState."""
    names = list(message.name)
    if len(names) != len(message.position):
        raise BadMessage('names and positions differ in number')
    return dict(zip(names, (float(v) for v in message.position)))


def _warm_attitude() -> None:
    """Compile or load the kernels with two samples of each kind."""
    for schedule in ('full', 'published'):
        estimator = AttitudeEstimator(AttitudeParams(schedule=schedule, align_time=2.0))
        start = 10**9
        for n in range(900):
            stamp = start + n * 5_000_000
            estimator.on_imu(ImuSample(stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
            if n % 50 == 1:
                estimator.on_mag(MagSample(stamp + 1, (2e-5, 0.0, -4e-5)))
                estimator.on_log(SpeedSample(stamp + 2, 5.0))
                estimator.on_gnss(VelocitySample(stamp + 3, (0.0, 0.0, 0.0)))


ATTITUDE_PORTS = Ports(
    name='attitude_estimator',
    params=AttitudeParams,
    estimator=AttitudeEstimator,
    inputs=(
        Input(topics.IMU, IMU, decode_imu, 'on_imu', timeout=0.5),
        Input(topics.MAG, FIELD, decode_mag, 'on_mag'),
        Input(topics.GNSS, TWIST, decode_gnss, 'on_gnss'),
        Input(topics.LOG, TWIST, decode_log, 'on_log'),
    ),
    outputs={
        Attitude: Output(topics.ATTITUDE, IMU, encode_attitude),
        Angles: Output(topics.ANGLES, VECTOR, encode_angles),
        Validity: Output(topics.VALIDITY, VALUES, encode_validity, latched=True),
        SettledAttitude: Output(topics.SETTLED, IMU, encode_attitude),
    },
    warm=_warm_attitude,
)

ROLL_PORTS = Ports(
    name='roll_analysis',
    params=RollParams,
    estimator=RollAnalysis,
    inputs=(
        Input(topics.ANGLES, VECTOR, decode_angles, 'on_angles', timeout=1.0),
        Input(topics.VALIDITY, VALUES, decode_validity, 'on_validity'),
    ),
    outputs={
        RollState: Output(topics.ROLL, VALUES, encode_roll),
        RollCycle: Output(topics.MAXIMA, VALUES, encode_cycle),
    },
)

NODE_PARAMETERS = {
    'ship_simulator': ShipSimulatorParams,
    'hmc5883l_driver': Hmc5883lParams,
    'alarm_monitor': AlarmParams,
    'nmea_bridge': NmeaParams,
    'modbus_bridge': ModbusParams,
    'display': DisplayParams,
}

ESTIMATORS = {ports.name: ports for ports in (ATTITUDE_PORTS, ROLL_PORTS)}
