# SPDX-License-Identifier: Apache-2.0
"""Messages to samples, estimates to messages, and the port tables of both estimators.

Wheels, pedals and gear are sensor_msgs/JointState with names: ``encoder`` (position, rad, cumulative),
``wheel_*`` (velocity, rad/s), ``accelerator`` and ``brake`` (position, 0…1), ``gear`` (position: 1 forward,
−1 reverse, 0 neutral or unknown).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Any

from ev_velocity.calibration import calibrated
from ev_velocity.fusion import FusionEstimator
from ev_velocity.fusion import warm as warm_fusion
from ev_velocity.params import FusionParams, VelocityParams
from ev_velocity.samples import (
    CONSTANT_NAMES,
    AccelerationEstimate,
    AngleSample,
    ConstantsEstimate,
    ForceSample,
    FusionEstimate,
    GearSample,
    GpsSample,
    PedalSample,
    RoadEstimate,
    SettledFusion,
    SettledSpeed,
    SlipEstimate,
    SpeedEstimate,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.velocity import warm as warm_velocity
from node_core.messages import NANOSECONDS, set_floats, set_stamp, stamp_of
from node_core.ports import BadMessage, Input, Output, Ports

IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
TWIST = 'geometry_msgs/msg/TwistWithCovarianceStamped'
ACCEL = 'geometry_msgs/msg/AccelWithCovarianceStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'

BODY = 'base_link'
ROAD = 'road'
# Variance of what is not estimated: lateral and vertical speed, rotation, place beside the road.
UNKNOWN = 1e6


def decode_force(message: Any) -> ForceSample:
    """Take x of a sensor_msgs/Imu's specific force; raise BadMessage if it is not finite or unknown."""
    stamp = message.header.stamp
    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
    if stamp_ns <= 0:
        raise BadMessage('zero stamp')
    if message.linear_acceleration_covariance[0] == -1.0:  # as sensor_msgs has it
        raise BadMessage('no specific force')
    force = message.linear_acceleration.x
    if not math.isfinite(force):
        raise BadMessage('specific force not finite')
    return ForceSample(stamp_ns, force)


def _speed_and_variance(message: Any) -> tuple[float, float]:
    linear = message.twist.twist.linear
    speed = math.hypot(linear.x, linear.y)
    variance = float(message.twist.covariance[0])
    if not math.isfinite(speed):
        raise BadMessage('speed not finite')
    # A negative variance says unknown, as in sensor_msgs.
    if math.isnan(variance) or variance == math.inf:
        raise BadMessage('variance not finite')
    return speed, max(variance, 0.0)


def decode_gps(message: Any) -> GpsSample:
    """Take the length of the horizontal velocity of a TwistWithCovarianceStamped, in whatever frame."""
    speed, variance = _speed_and_variance(message)
    return GpsSample(stamp_of(message), speed, variance)


def decode_wheel_speed(message: Any) -> WheelSpeedSample:
    """Take the speed of a TwistWithCovarianceStamped that comes from the wheels."""
    speed, variance = _speed_and_variance(message)
    return WheelSpeedSample(stamp_of(message), speed, variance)


def _joint(message: Any, field: str, name: str) -> float:
    names = list(message.name)
    values = getattr(message, field)
    if name not in names:
        raise BadMessage(f"no '{name}'")
    if len(values) != len(names):
        raise BadMessage(f'{len(names)} names but {len(values)} values')
    value = float(values[names.index(name)])
    if not math.isfinite(value):
        raise BadMessage(f"'{name}' not finite")
    return value


def decode_encoder(message: Any) -> AngleSample:
    """Take the cumulative angle of the joint ``encoder``."""
    return AngleSample(stamp_of(message), _joint(message, 'position', 'encoder'))


def decode_wheels(message: Any) -> WheelRateSample:
    """Take the rates of all joints named ``wheel_*`` that are finite: a silent wheel is NaN."""
    names = list(message.name)
    if len(message.velocity) != len(names):
        raise BadMessage(f'{len(names)} names but {len(message.velocity)} values')
    rates = tuple(
        float(rate)
        for name, rate in zip(names, message.velocity)
        if name.startswith('wheel_') and math.isfinite(rate)
    )
    if not rates:
        raise BadMessage('no finite wheel rate')
    return WheelRateSample(stamp_of(message), rates)


def decode_pedals(message: Any) -> PedalSample:
    """Take the joints ``accelerator`` and ``brake``."""
    accelerator = _joint(message, 'position', 'accelerator')
    return PedalSample(stamp_of(message), accelerator, _joint(message, 'position', 'brake'))


def decode_gear(message: Any) -> GearSample:
    """Take the joint ``gear``: 1, −1 or 0."""
    value = _joint(message, 'position', 'gear')
    if value not in (-1.0, 0.0, 1.0):
        raise BadMessage(f'gear {value:g}')
    return GearSample(stamp_of(message), int(value))


def _diagonal(first: float) -> list[float]:
    covariance = [0.0] * 36
    covariance[0] = first
    for i in range(1, 6):
        covariance[7 * i] = UNKNOWN
    return covariance


def _header(message: Any, stamp: int, frame: str = BODY) -> None:
    set_stamp(message.header, stamp)
    message.header.frame_id = frame


def _encoder(
    parts: Callable[[Any], tuple[Any, Any]], value: Callable[[Any], float]
) -> Callable[[Any, Any], None]:
    """Return an encoder that writes stamp, one number along x and its variance: what changes at 500 Hz.

    `parts(message)` gives the vector and the holder of the covariance. They are looked up, and the rest of
    the message filled, once: a port fills one message again and again.
    """
    seen: Any = None
    clock: Any = None
    vector: Any = None
    covariance: Any = None

    def encode(estimate: Any, message: Any) -> None:
        nonlocal seen, clock, vector, covariance
        if message is not seen:
            message.header.frame_id = BODY
            vector, holder = parts(message)
            holder.covariance[:] = _diagonal(0.0)
            seen, clock, covariance = message, message.header.stamp, holder.covariance
        clock.sec, clock.nanosec = divmod(estimate.stamp, NANOSECONDS)
        vector.x = value(estimate)
        covariance[0] = estimate.variance

    return encode


def _twist_encoder() -> Callable[[Any, Any], None]:
    return _encoder(lambda message: (message.twist.twist.linear, message.twist), attrgetter('speed'))


def _acceleration_encoder() -> Callable[[Any, Any], None]:
    return _encoder(lambda message: (message.accel.accel.linear, message.accel), attrgetter('acceleration'))


def encode_road(estimate: RoadEstimate, message: Any) -> None:
    """Fill a nav_msgs/Odometry whose frame `road` runs along the road."""
    _header(message, estimate.stamp, ROAD)
    message.child_frame_id = BODY
    message.pose.pose.position.x = estimate.distance
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance[:] = _diagonal(estimate.distance_variance)
    message.twist.twist.linear.x = estimate.speed
    message.twist.covariance[:] = _diagonal(estimate.speed_variance)


def encode_slip(estimate: SlipEstimate, message: Any) -> None:
    """Fill a JointState: slip ratio, phase (0 accelerating, 1 steady, 2 braking, 3 coasting), refusal."""
    _header(message, estimate.stamp)
    message.name = ['slip_ratio', 'phase', 'slipping']
    set_floats(message, 'position', [estimate.slip, float(estimate.phase), float(estimate.slipping)])


def encode_constants(estimate: ConstantsEstimate, message: Any) -> None:
    """Fill a JointState: learned constants as positions, their standard deviations as efforts."""
    _header(message, estimate.stamp)
    message.name = list(CONSTANT_NAMES)
    set_floats(message, 'position', estimate.values)
    set_floats(message, 'effort', estimate.sigmas)


def _inputs() -> tuple[Input, ...]:
    return (
        Input('imu/data_raw', IMU, decode_force, 'on_force', timeout=0.25),
        Input('gps/speed', TWIST, decode_gps, 'on_gps', timeout=2.5),
        Input('wheel/encoder', JOINTS, decode_encoder, 'on_angle'),
        Input('wheel/states', JOINTS, decode_wheels, 'on_wheel_rates'),
        Input('vehicle/speed', TWIST, decode_wheel_speed, 'on_wheel_speed'),
        Input('obd/speed', TWIST, decode_wheel_speed, 'on_obd_speed'),
        Input('vehicle/pedals', JOINTS, decode_pedals, 'on_pedals'),
        Input('vehicle/gear', JOINTS, decode_gear, 'on_gear'),
    )


VELOCITY_PORTS = Ports(
    name='velocity_estimator',
    params=VelocityParams,
    estimator=calibrated,
    inputs=_inputs(),
    outputs={
        SpeedEstimate: Output('vehicle/velocity', TWIST, _twist_encoder()),
        SettledSpeed: Output('vehicle/velocity_settled', TWIST, _twist_encoder()),
        AccelerationEstimate: Output('vehicle/acceleration', ACCEL, _acceleration_encoder()),
        SlipEstimate: Output('vehicle/slip', JOINTS, encode_slip),
        RoadEstimate: Output('vehicle/odometry', ODOMETRY, encode_road),
        ConstantsEstimate: Output('vehicle/learned', JOINTS, encode_constants),
    },
    warm=warm_velocity,
)

FUSION_PORTS = Ports(
    name='fusion_estimator',
    params=FusionParams,
    estimator=FusionEstimator,
    inputs=_inputs(),
    outputs={
        FusionEstimate: Output('fusion/velocity', TWIST, _twist_encoder()),
        SettledFusion: Output('fusion/velocity_settled', TWIST, _twist_encoder()),
    },
    warm=warm_fusion,
)

ESTIMATORS = {ports.name: ports for ports in (VELOCITY_PORTS, FUSION_PORTS)}
