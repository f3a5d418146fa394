# SPDX-License-Identifier: Apache-2.0
"""Messages to samples, estimates to messages, and the port tables of filter and controller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalman_core.rotation import quat_rotate_inverse
from node_core.messages import finite3, get_quaternion, set3, set_floats, set_quaternion, set_stamp, stamp_of
from node_core.ports import BadMessage, Input, Output, Ports
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import MOTORS, SimulatorParams
from quad_control.params import AttitudeParams, ControllerParams, EscParams, WebParams
from quad_control.pilot import PilotParams
from quad_control.samples import (
    ArmingState,
    Attitude,
    BatterySample,
    ControlReport,
    Event,
    ImuSample,
    MotorCommand,
    PressureSample,
    RangeSample,
    RawAngle,
    Setpoint,
    SettledAttitude,
    Truth,
)
from quad_control.warm import warm

IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
RANGE = 'sensor_msgs/msg/Range'
BATTERY = 'sensor_msgs/msg/BatteryState'
PRESSURE = 'sensor_msgs/msg/FluidPressure'
STRING = 'std_msgs/msg/String'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
ODOMETRY = 'nav_msgs/msg/Odometry'

STICKS = ('roll', 'pitch', 'yaw_rate', 'throttle', 'arm', 'hold')
AXES = ('roll', 'pitch', 'yaw', 'throttle')
# Pulses outside this are no servo pulses (µs).
_SHORTEST, _LONGEST = 500.0, 2500.0
# Air pressure on Earth, from 9 km up to below sea level (Pa).
_LEAST_PRESSURE, _MOST_PRESSURE = 3.0e4, 1.15e5
# A frame for sensors and truth where none is given by a message.
BODY, WORLD = 'base_link', 'map'


def decode_imu(message: Any) -> ImuSample:
    """Decode a raw sensor_msgs/Imu, not its orientation; raise BadMessage when it carries no rates."""
    _need_rates(message)
    return ImuSample(
        stamp_of(message),
        finite3(message.angular_velocity, 'angular velocity'),
        finite3(message.linear_acceleration, 'specific force'),
        message.header.frame_id,
    )


def _need_rates(message: Any) -> None:
    if message.angular_velocity_covariance[0] < 0.0:  # REP-145: not measured
        raise BadMessage('no rates')


def encode_imu(sample: ImuSample, message: Any) -> None:
    """Fill a raw sensor_msgs/Imu; REP-145: an orientation covariance of -1 says that there is none."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = sample.frame
    set3(message.angular_velocity, sample.rate)
    set3(message.linear_acceleration, sample.force)
    message.orientation_covariance[0] = -1.0


def decode_attitude(message: Any) -> Attitude:
    """Decode a sensor_msgs/Imu with orientation; raise BadMessage when it carries none, or no rates.

    A covariance of zeros is unknown: rate variances are then infinite, and nothing arms.
    """
    _need_rates(message)
    if message.orientation_covariance[0] < 0.0:
        raise BadMessage('no orientation')
    tilt, rate = message.orientation_covariance, message.angular_velocity_covariance
    variances = [float(c[i]) for c in (tilt, rate) for i in (0, 4, 8)]
    if not all(map(math.isfinite, variances)):
        raise BadMessage('covariance not finite')
    if not any(rate):
        variances[3:] = [math.inf] * 3
    w, x, y, z = (float(v) for v in get_quaternion(message.orientation))
    return Attitude(
        stamp_of(message),
        (w, x, y, z),
        finite3(message.angular_velocity, 'angular velocity'),
        finite3(message.linear_acceleration, 'specific force'),
        (variances[0], variances[1], variances[2]),
        (variances[3], variances[4], variances[5]),
        message.header.frame_id,
    )


def encode_attitude(estimate: Attitude, message: Any) -> None:
    """Fill a sensor_msgs/Imu with orientation, bias-free rates, specific force and covariances."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    set_quaternion(message.orientation, estimate.quaternion)
    set3(message.angular_velocity, estimate.rate)
    set3(message.linear_acceleration, estimate.force)
    for axis in range(3):
        message.orientation_covariance[4 * axis] = estimate.attitude_variance[axis]
        message.angular_velocity_covariance[4 * axis] = estimate.rate_variance[axis]


def encode_raw_angle(estimate: RawAngle, message: Any) -> None:
    """Fill a geometry_msgs/Vector3Stamped: x roll, y pitch (rad), z 0."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = estimate.frame
    set3(message.vector, (estimate.roll, estimate.pitch, 0.0))


def _by_name(message: Any, names: tuple[str, ...], optional: int = 0) -> list[float]:
    """Return positions in the order of `names`; the last `optional` names may be missing and are 0."""
    given = dict(zip(message.name, message.position))
    values = []
    for index, name in enumerate(names):
        if name not in given:
            if index < len(names) - optional:
                raise BadMessage(f"no '{name}'")
            values.append(0.0)
            continue
        value = float(given[name])
        if not math.isfinite(value):
            raise BadMessage(f"'{name}' not finite")
        values.append(value)
    return values


def decode_setpoint(message: Any) -> Setpoint:
    """Decode sticks from a sensor_msgs/JointState by name; 'arm' and 'hold' are switches, on above 0.5."""
    roll, pitch, yaw_rate, throttle, arm, hold = _by_name(message, STICKS, optional=1)
    return Setpoint(stamp_of(message), roll, pitch, yaw_rate, throttle, arm > 0.5, hold > 0.5)


def encode_setpoint(sample: Setpoint, message: Any) -> None:
    """Fill a sensor_msgs/JointState with the sticks as positions."""
    set_stamp(message.header, sample.stamp)
    message.name = list(STICKS)
    set_floats(message, 'position', [float(v) for v in sample[1:]])


def decode_range(message: Any) -> RangeSample:
    """Decode a sensor_msgs/Range; out of its own limits (REP-117: infinite) is no measurement."""
    height = message.range
    if not math.isfinite(height) or not message.min_range <= height <= message.max_range:
        raise BadMessage('out of range')
    return RangeSample(stamp_of(message), float(height))


def encode_range(sample: RangeSample, message: Any) -> None:
    """Fill a sensor_msgs/Range of an infrared finder, 0…40 m."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = BODY
    message.radiation_type = 1
    message.min_range, message.max_range = 0.0, 40.0
    message.field_of_view = 0.05
    message.range = float(sample.height)


def decode_pressure(message: Any) -> PressureSample:
    """Decode a sensor_msgs/FluidPressure (Pa)."""
    pressure = message.fluid_pressure
    if not _LEAST_PRESSURE < pressure < _MOST_PRESSURE:
        raise BadMessage('no air pressure')
    return PressureSample(stamp_of(message), float(pressure))


def decode_battery(message: Any) -> BatterySample:
    """Decode a sensor_msgs/BatteryState."""
    if not math.isfinite(message.voltage) or message.voltage <= 0.0:
        raise BadMessage('voltage not positive')
    return BatterySample(stamp_of(message), float(message.voltage))


def encode_battery(sample: BatterySample, message: Any) -> None:
    """Fill a sensor_msgs/BatteryState; what is not measured is NaN, as the message defines."""
    set_stamp(message.header, sample.stamp)
    message.voltage = float(sample.voltage)
    for name in ('current', 'charge', 'capacity', 'design_capacity', 'percentage', 'temperature'):
        setattr(message, name, math.nan)
    message.power_supply_technology = 3
    message.present = True


def decode_motors(message: Any) -> tuple[int, tuple[float, float, float, float]]:
    """Decode (stamp, pulses in µs in the order of MOTORS) from a sensor_msgs/JointState."""
    a, b, c, d = _by_name(message, MOTORS)
    if not all(_SHORTEST <= value <= _LONGEST for value in (a, b, c, d)):
        raise BadMessage('pulse out of range')
    return stamp_of(message), (a, b, c, d)


def encode_motors(estimate: MotorCommand, message: Any) -> None:
    """Fill a sensor_msgs/JointState: position = pulse (µs), effort = thrust fraction."""
    set_stamp(message.header, estimate.stamp)
    message.name = list(MOTORS)
    set_floats(message, 'position', estimate.pulses)
    set_floats(message, 'effort', estimate.thrust)


def encode_pulses(stamp: int, pulses: tuple[float, ...], message: Any) -> None:
    """Fill a sensor_msgs/JointState with pulses (µs) as positions: what the motors are given."""
    set_stamp(message.header, stamp)
    message.name = list(MOTORS)
    set_floats(message, 'position', pulses)


def encode_report(estimate: ControlReport, message: Any) -> None:
    """Fill a sensor_msgs/JointState: position = setpoint, velocity = measured, effort = achieved torque."""
    set_stamp(message.header, estimate.stamp)
    message.name = list(AXES)
    set_floats(message, 'position', (*estimate.setpoint, estimate.demand[3]))
    set_floats(message, 'velocity', (*estimate.measured, 0.0))
    set_floats(message, 'effort', estimate.achieved)


def encode_event(estimate: Event, message: Any) -> None:
    """Fill a std_msgs/String with ``kind: text``."""
    message.data = f'{estimate.kind}: {estimate.text}'


def encode_arming(estimate: ArmingState, message: Any) -> None:
    """Fill a std_msgs/String with the name of the state."""
    message.data = estimate.name


def encode_truth(sample: Truth, message: Any) -> None:
    """Fill a nav_msgs/Odometry; its twist is in body axes, as the message defines."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = WORLD
    message.child_frame_id = BODY
    set3(message.pose.pose.position, sample.position)
    set_quaternion(message.pose.pose.orientation, sample.quaternion)
    velocity = quat_rotate_inverse(np.array(sample.quaternion), np.array(sample.velocity))
    set3(message.twist.twist.linear, velocity)
    set3(message.twist.twist.angular, sample.rate)


FILTER_PORTS = Ports(
    name='attitude_filter',
    params=AttitudeParams,
    estimator=AttitudeFilter,
    inputs=(Input('imu/data_raw', IMU, decode_imu, 'on_imu', timeout=0.5),),
    outputs={
        Attitude: Output('imu/data', IMU, encode_attitude),
        RawAngle: Output('imu/angle_raw', VECTOR, encode_raw_angle),
        SettledAttitude: Output('imu/data_settled', IMU, encode_attitude),
    },
    warm=warm,
)

CONTROLLER_PORTS = Ports(
    name='attitude_controller',
    params=ControllerParams,
    estimator=AttitudeController,
    inputs=(
        Input('imu/data', IMU, decode_attitude, 'on_attitude', timeout=0.1),
        Input('setpoint', JOINTS, decode_setpoint, 'on_setpoint', timeout=0.5),
        Input('range', RANGE, decode_range, 'on_range'),
        Input('pressure', PRESSURE, decode_pressure, 'on_pressure'),
        Input('battery', BATTERY, decode_battery, 'on_battery'),
    ),
    outputs={
        MotorCommand: Output('motors/command', JOINTS, encode_motors),
        ControlReport: Output('controller/report', JOINTS, encode_report),
        Event: Output('controller/events', STRING, encode_event),
        ArmingState: Output('arming/state', STRING, encode_arming, latched=True),
    },
    warm=warm,
)

NODE_PARAMETERS = {
    'quad_simulator': SimulatorParams,
    'pilot': PilotParams,
    'esc_driver': EscParams,
    'web_tuner': WebParams,
}

ESTIMATORS = {ports.name: ports for ports in (FILTER_PORTS, CONTROLLER_PORTS)}
