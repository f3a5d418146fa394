# SPDX-License-Identifier: Apache-2.0
"""Typed samples and estimates that travel between simulator, filter, controller and ESC driver."""

from __future__ import annotations

from typing import NamedTuple

Vector = tuple[float, float, float]


class ImuSample(NamedTuple):
    """Stamp (ns), body rates (rad/s), specific force (m/s²), body axes; frame id of the sensor."""

    stamp: int
    rate: Vector
    force: Vector
    frame: str = 'base_link'


class Attitude(NamedTuple):
    """What the attitude filter says at `stamp` (ns).

    quaternion ``q_nb`` (wxyz), bias-free body rates (rad/s), specific force (m/s²), variances of the
    attitude error about x, y, z (rad², local level) and of the rates ((rad/s)², gyro noise and bias).
    """

    stamp: int
    quaternion: tuple[float, float, float, float]
    rate: Vector
    force: Vector
    attitude_variance: Vector
    rate_variance: Vector
    frame: str = 'base_link'


class SettledAttitude(Attitude):
    """The same once every sample of the lag window is in."""

    __slots__ = ()


class RawAngle(NamedTuple):
    """Roll and pitch (rad) from one accelerometer sample, as the paper's eqs. 5 and 6 have them."""

    stamp: int
    roll: float
    pitch: float
    frame: str = 'base_link'


class Setpoint(NamedTuple):
    """What the pilot asks: angles (rad), yaw rate (rad/s), throttle 0…1, arm switch, altitude hold switch."""

    stamp: int
    roll: float
    pitch: float
    yaw_rate: float
    throttle: float
    arm: bool
    hold: bool = False


class RangeSample(NamedTuple):
    """Height above ground (m)."""

    stamp: int
    height: float


class PressureSample(NamedTuple):
    """Air pressure (Pa)."""

    stamp: int
    pressure: float


class BatterySample(NamedTuple):
    """Battery voltage (V) under load."""

    stamp: int
    voltage: float


class MotorCommand(NamedTuple):
    """Pulse widths (µs) and thrust fractions of the four motors, in the order of `craft.MOTORS`."""

    stamp: int
    pulses: tuple[float, float, float, float]
    thrust: tuple[float, float, float, float]


class ControlReport(NamedTuple):
    """Setpoint, measurement and achieved torque of each axis, for plots and anti-windup checks.

    `setpoint` (rad, rad, rad/s), `measured` likewise, `demand` and `achieved` in thrust fractions
    (roll, pitch, yaw, throttle).
    """

    stamp: int
    setpoint: Vector
    measured: Vector
    demand: tuple[float, float, float, float]
    achieved: tuple[float, float, float, float]


class Event(NamedTuple):
    """Something the pilot must know: a change of the arming state, a trial, a revert, an autotune result."""

    stamp: int
    kind: str
    text: str


class ArmingState(NamedTuple):
    """Name of the arming state, one of `arming.NAMES`."""

    stamp: int
    name: str


class Truth(NamedTuple):
    """The simulator's truth: position (m, ENU), velocity (m/s, ENU), ``q_nb``, body rates, rotors (rad/s)."""

    stamp: int
    position: Vector
    velocity: Vector
    quaternion: tuple[float, float, float, float]
    rate: Vector
    rotors: tuple[float, float, float, float]
