# SPDX-License-Identifier: Apache-2.0
"""The craft that is simulated: geometry, masses, motors, battery, air, IMU errors, as parameters.

Motor order, seen from above with x forward and y left: front left, front right, rear left, rear right (the
paper's M1…M4). Front left and rear right turn counter-clockwise, as the paper's text has it; the reaction
on the body is the other way round, so more of front right and rear left turns the body counter-clockwise
(positive yaw). Roll > 0 lifts the left side, pitch > 0 lowers the nose (REP-103).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kalman_core.parameters import parameter
from quad_control.params import GRAVITY

MOTORS = ('front_left', 'front_right', 'rear_left', 'rear_right')
ROLL_SIGN = np.array([1.0, -1.0, 1.0, -1.0])
PITCH_SIGN = np.array([-1.0, -1.0, 1.0, 1.0])
YAW_SIGN = np.array([-1.0, 1.0, 1.0, -1.0])

# kg/m³, ISA at sea level.
AIR_DENSITY = 1.225


@dataclass(frozen=True)
class CraftParams:
    """Body, motors, battery and surroundings. Estimates are marked; the rest is the benchmark's craft."""

    mass: float = parameter(2.0, 'mass without payload', unit='kg', minimum=0.05)
    inertia: tuple = parameter(
        (0.022, 0.022, 0.038), 'principal inertia without payload', unit='kg m^2', minimum=1e-5
    )
    arm: float = parameter(0.225, 'distance of a motor from the centre', unit='m', minimum=0.02)
    thrust_coefficient: float = parameter(
        1.11e-5, 'thrust per squared rotor speed (9450 propeller, estimate)', unit='N s^2', minimum=1e-9
    )
    torque_coefficient: float = parameter(
        1.72e-7, 'drag torque per squared rotor speed (estimate)', unit='N m s^2', minimum=1e-11
    )
    rotor_max: float = parameter(1500.0, 'rotor speed at duty 1, full battery', unit='rad/s', minimum=10.0)
    rotor_inertia: float = parameter(
        6.0e-5, 'inertia of propeller and bell (estimate)', unit='kg m^2', minimum=0.0
    )
    motor_time: float = parameter(0.03, 'time constant of the rotor speed', unit='s', minimum=1e-3)
    motor_droop: float = parameter(
        0.3, 'load droop at full speed: w + droop w^2 / w_max = duty (estimate)', minimum=0.0, maximum=5.0
    )
    command_delay: float = parameter(
        0.005, 'from command to ESC, one sample', unit='s', minimum=0.0, maximum=0.1
    )
    drag_linear: float = parameter(
        0.25, 'rotor drag per airspeed, across the rotor axis (estimate)', unit='N s/m', minimum=0.0
    )
    drag_quadratic: float = parameter(0.03, 'body drag (estimate)', unit='N s^2/m^2', minimum=0.0)
    inflow_damping: float = parameter(
        1.5, 'loss of thrust per climb rate, all rotors (estimate)', unit='N s/m', minimum=0.0
    )
    cells: int = parameter(6, 'LiPo cells in series', minimum=1, maximum=14)
    capacity: float = parameter(5.0, 'battery capacity (the paper gives none)', unit='Ah', minimum=0.1)
    battery_resistance: float = parameter(
        0.025, 'internal resistance of the pack (estimate)', unit='ohm', minimum=0.0
    )
    power_efficiency: float = parameter(
        0.8, 'shaft power over battery power, motor and ESC (estimate)', minimum=0.1, maximum=1.0
    )
    avionics_power: float = parameter(5.0, 'power of the electronics (estimate)', unit='W', minimum=0.0)
    payload: float = parameter(0.0, 'payload', unit='kg', minimum=0.0, maximum=10.0)
    payload_offset: tuple = parameter((0.0, 0.0, -0.05), 'centre of the payload', unit='m')
    payload_size: float = parameter(0.1, 'edge of the payload, a cube', unit='m', minimum=0.0)
    pinned: bool = parameter(False, 'on the test stand: the centre cannot move')
    stand_friction: float = parameter(
        0.005, 'viscous friction of the stand bearing', unit='N m s/rad', minimum=0.0
    )
    wind: tuple = parameter((0.0, 0.0, 0.0), 'mean wind, ENU', unit='m/s')
    gust: float = parameter(0.0, 'sigma of the gusts per axis', unit='m/s', minimum=0.0)
    gust_time: float = parameter(2.0, 'correlation time of the gusts', unit='s', minimum=0.01)
    imu_position: tuple = parameter((0.0, 0.0, 0.0), 'IMU from the centre', unit='m')


@dataclass(frozen=True)
class ImuErrorParams:
    """Errors of the IMU. Defaults: MPU6050 on a frame; `benchmark_imu` gives the benchmark's."""

    gyro_noise: float = parameter(8.7e-5, 'gyro noise', unit='rad/s/sqrt(Hz)', minimum=0.0)
    gyro_bias: float = parameter(0.03, 'sigma of the start bias', unit='rad/s', minimum=0.0)
    gyro_walk: float = parameter(3.5e-5, 'random walk of the gyro bias', unit='rad/s/sqrt(s)', minimum=0.0)
    accelerometer_noise: float = parameter(3.9e-3, 'accelerometer noise', unit='m/s^2/sqrt(Hz)', minimum=0.0)
    accelerometer_bias: float = parameter(
        0.05, 'sigma of the accelerometer bias left after a calibration', unit='m/s^2', minimum=0.0
    )
    misalignment: float = parameter(0.005, 'sigma of scale and cross-axis errors', minimum=0.0, maximum=0.1)
    white_vibration: float = parameter(
        0.0, 'white vibration per sample, motors at hover', unit='m/s^2', minimum=0.0
    )
    rotor_vibration: float = parameter(
        1.0, 'amplitude at the rotor frequency at hover, each motor', unit='m/s^2', minimum=0.0
    )
    gyro_vibration: float = parameter(
        0.01, 'gyro amplitude at the rotor frequency at hover', unit='rad/s', minimum=0.0
    )
    quantise: bool = parameter(True, 'steps and range of the MPU6050 at 500 deg/s and 8 g')


@dataclass(frozen=True)
class SimulatorParams(CraftParams, ImuErrorParams):
    """Parameters of the simulator node."""

    rate: float = parameter(200.0, 'IMU rate', unit='Hz', minimum=50.0, maximum=1000.0)
    seed: int = parameter(0, 'seed of every random draw', minimum=0)
    start_roll: float = parameter(0.0, 'roll at start', unit='rad', minimum=-3.0, maximum=3.0)
    start_height: float = parameter(0.0, 'height at start', unit='m', minimum=0.0, maximum=500.0)
    pace: str = parameter(
        'realtime',
        'realtime: a timer; lockstep: a motor command asks for the next sample',
        choices=('realtime', 'lockstep'),
    )


def total_mass(craft: CraftParams) -> float:
    """Return the mass with payload (kg)."""
    return craft.mass + craft.payload


def centre_of_mass(craft: CraftParams) -> np.ndarray:
    """Return the centre of mass (3,) from the geometric centre [m], payload included."""
    return np.asarray(craft.payload_offset) * (craft.payload / total_mass(craft))


def inertia_about(craft: CraftParams, point: np.ndarray) -> np.ndarray:
    """Return the inertia matrix (3, 3) [kg m²] about `point` (3,) [m, from the geometric centre]."""

    def parallel(mass: float, offset: np.ndarray) -> np.ndarray:
        return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))

    offset = np.asarray(craft.payload_offset) - point
    cube = craft.payload * craft.payload_size**2 / 6.0
    return (
        np.diag(craft.inertia)
        + parallel(craft.mass, -np.asarray(point))
        + cube * np.eye(3)
        + parallel(craft.payload, offset)
    )


def lever(craft: CraftParams) -> float:
    """Return the lever of a motor about the roll and pitch axes (m)."""
    return craft.arm / np.sqrt(2.0)


def max_thrust(craft: CraftParams) -> float:
    """Return the thrust of one motor at duty 1 with a full battery (N)."""
    return craft.thrust_coefficient * craft.rotor_max**2


def hover_fraction(craft: CraftParams) -> float:
    """Return the thrust fraction per motor at hover."""
    return total_mass(craft) * GRAVITY / (4.0 * max_thrust(craft))


def benchmark_craft(payload: float = 0.0, **changes) -> CraftParams:
    """Return the craft of the shared benchmark settings with 0, 1 or 3.2 kg of payload.

    There the inertia with payload is given, not built from a cube: the payload is part of the body. The
    air is still and free of drag, duty is rotor speed, the battery does not sag.
    """
    inertia = {0.0: (0.022, 0.022, 0.038), 1.0: (0.024, 0.024, 0.041), 3.2: (0.030, 0.030, 0.045)}[payload]
    craft = CraftParams(
        mass=2.0 + payload,
        inertia=inertia,
        motor_droop=0.0,
        drag_linear=0.0,
        drag_quadratic=0.0,
        inflow_damping=0.0,
        battery_resistance=0.0,
        rotor_inertia=0.0,
        capacity=1e6,
    )
    return replace(craft, **changes)


def benchmark_imu(**changes) -> ImuErrorParams:
    """Return the IMU of the shared benchmark settings: gyro 0.005 °/s/√Hz, 400 µg/√Hz, 1 m/s² vibration."""
    imu = ImuErrorParams(
        gyro_noise=np.radians(0.005),
        gyro_bias=0.0,
        gyro_walk=0.0,
        accelerometer_noise=400e-6 * GRAVITY,
        accelerometer_bias=0.0,
        misalignment=0.0,
        white_vibration=1.0,
        rotor_vibration=0.0,
        gyro_vibration=0.0,
        quantise=False,
    )
    return replace(imu, **changes)
