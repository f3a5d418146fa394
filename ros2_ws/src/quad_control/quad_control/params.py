# SPDX-License-Identifier: Apache-2.0
"""Parameters of the attitude filter, the controller (with mixer and arming), and the ESC driver."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

from kalman_core.parameters import ParameterError, parameter

# Standard gravity, m/s² (BIPM).
GRAVITY = 9.80665


@dataclass(frozen=True)
class AttitudeParams:
    """The attitude filter: paper 000 section 2 (`published`, `corrected`) and the gyro-driven filter."""

    filter: str = parameter(
        'gyro_driven', 'which filter publishes', choices=('published', 'corrected', 'gyro_driven')
    )
    period: float = parameter(0.005, 'time step of the published filter', unit='s', minimum=1e-4, maximum=0.1)
    angle_variance: float = parameter(
        8.0e-4, 'R of the accelerometer angle (paper)', unit='rad^2', minimum=1e-8
    )
    angular_acceleration: float = parameter(
        0.8, 'process noise sigma_alpha (paper)', unit='rad/s^2', minimum=1e-6
    )
    adaptive_gain: float = parameter(3.0, 'k of the adaptive R (paper)', minimum=0.0)
    adaptive_deadband: float = parameter(0.1, 'deadband of the adaptive R (paper)', unit='g', minimum=0.0)
    rate_variance: float = parameter(
        4.0e-6, 'R of the gyro rate, corrected filter', unit='(rad/s)^2', minimum=1e-12
    )
    gyro_noise: float = parameter(
        1.0e-3, 'gyro noise incl. vibration rectified', unit='rad/s/sqrt(Hz)', minimum=1e-7
    )
    bias_walk: float = parameter(1.0e-4, 'random walk of the gyro bias', unit='rad/s/sqrt(s)', minimum=0.0)
    bias_prior: float = parameter(
        0.05, 'sigma of the gyro bias before calibration', unit='rad/s', minimum=1e-6
    )
    tilt_prior: float = parameter(
        0.4, 'sigma of the first tilt (the craft may already fly)', unit='rad', minimum=1e-4
    )
    velocity_prior: float = parameter(2.0, 'sigma of the velocity at start', unit='m/s', minimum=1e-3)
    specific_force_noise: float = parameter(
        0.1, 'accelerometer noise that enters the velocity', unit='m/s^2/sqrt(Hz)', minimum=1e-6
    )
    hover_noise: float = parameter(
        2.0,
        'noise of the pseudo-measurement velocity = 0: how far the craft strays from hover',
        unit='m/s/sqrt(Hz)',
        minimum=1e-3,
    )
    climb_noise: float = parameter(
        0.6,
        'the same for the vertical velocity: height is held better than place',
        unit='m/s/sqrt(Hz)',
        minimum=1e-3,
    )
    drag: float = parameter(
        0.4, 'rotor drag: horizontal specific force per airspeed; 0 turns it off', unit='1/s', minimum=0.0
    )
    drag_noise: float = parameter(
        0.7, 'noise of the drag measurement, wind included', unit='m/s^2/sqrt(Hz)', minimum=1e-3
    )
    calibration_time: float = parameter(1.0, 'length of a still window', unit='s', minimum=0.1, maximum=60.0)
    still_rate: float = parameter(0.03, 'largest gyro spread in a still window', unit='rad/s', minimum=0.0)
    still_acceleration: float = parameter(
        0.5, 'largest accelerometer spread in a still window', unit='m/s^2', minimum=0.0
    )
    ground_acceleration: float = parameter(
        0.15,
        'accelerometer spread under which a still craft stands with its motors off',
        unit='m/s^2',
        minimum=0.0,
    )
    ground_departure: float = parameter(
        0.5, 'change of specific force that ends standing', unit='m/s^2', minimum=0.01
    )
    ground_noise: float = parameter(
        0.05, 'noise of velocity = 0 while standing', unit='m/s/sqrt(Hz)', minimum=1e-4
    )
    accelerometer_offset: tuple = parameter(
        (0.0, 0.0, 0.0), 'accelerometer bias to subtract, from a calibration', unit='m/s^2'
    )
    accelerometer_bias: float = parameter(
        0.05,
        'sigma of what is left of the accelerometer bias: the floor of the tilt error',
        unit='m/s^2',
        minimum=0.0,
    )
    still_bias: float = parameter(
        0.12, 'a mean rate above this is a turn, not a bias', unit='rad/s', minimum=0.0
    )
    bias_sigma: float = parameter(
        2.0e-3, 'sigma of the bias a still window gives', unit='rad/s', minimum=1e-6
    )
    frozen_samples: int = parameter(
        8, 'equal samples in a row after which the sensor is called frozen; 0 = never', minimum=0
    )
    window: float = parameter(
        0.5, 'late samples up to this age are repaired', unit='s', minimum=0.01, maximum=5.0
    )


@dataclass(frozen=True)
class PidParams:
    """The published controller: one PID per axis on the angle (paper 000, eq. 1)."""

    roll_kp: float = parameter(0.46, 'published Kp, roll', unit='1', minimum=0.0, maximum=20.0, live=True)
    roll_ki: float = parameter(9.58, 'published Ki, roll', unit='1/s', minimum=0.0, maximum=200.0, live=True)
    roll_kd: float = parameter(0.0043, 'published Kd, roll', unit='s', minimum=0.0, maximum=5.0, live=True)
    pitch_kp: float = parameter(0.46, 'published Kp, pitch', unit='1', minimum=0.0, maximum=20.0, live=True)
    pitch_ki: float = parameter(
        9.58, 'published Ki, pitch', unit='1/s', minimum=0.0, maximum=200.0, live=True
    )
    pitch_kd: float = parameter(0.0043, 'published Kd, pitch', unit='s', minimum=0.0, maximum=5.0, live=True)
    yaw_kp: float = parameter(0.46, 'published Kp, yaw', unit='1', minimum=0.0, maximum=20.0, live=True)
    yaw_ki: float = parameter(0.0, 'published Ki, yaw', unit='1/s', minimum=0.0, maximum=200.0, live=True)
    yaw_kd: float = parameter(0.0043, 'published Kd, yaw', unit='s', minimum=0.0, maximum=5.0, live=True)
    published_scale: float = parameter(
        0.31,
        'motor thrust fraction per unit of the published output',
        unit='1/rad',
        minimum=1e-4,
        maximum=10.0,
    )


@dataclass(frozen=True)
class CascadeParams:
    """The first-class controller: angle P, then rate PID with derivative on the measurement."""

    roll_angle_p: float = parameter(8.5, 'angle gain, roll', unit='1/s', minimum=0.0, maximum=30.0, live=True)
    roll_rate_p: float = parameter(0.06, 'rate gain, roll', unit='s/rad', minimum=0.0, maximum=1.0, live=True)
    roll_rate_i: float = parameter(
        0.08, 'rate integral gain, roll', unit='1/rad', minimum=0.0, maximum=5.0, live=True
    )
    roll_rate_d: float = parameter(
        0.0016, 'rate derivative gain, roll', unit='s^2/rad', minimum=0.0, maximum=0.1, live=True
    )
    pitch_angle_p: float = parameter(
        8.5, 'angle gain, pitch', unit='1/s', minimum=0.0, maximum=30.0, live=True
    )
    pitch_rate_p: float = parameter(
        0.06, 'rate gain, pitch', unit='s/rad', minimum=0.0, maximum=1.0, live=True
    )
    pitch_rate_i: float = parameter(
        0.08, 'rate integral gain, pitch', unit='1/rad', minimum=0.0, maximum=5.0, live=True
    )
    pitch_rate_d: float = parameter(
        0.0016, 'rate derivative gain, pitch', unit='s^2/rad', minimum=0.0, maximum=0.1, live=True
    )
    yaw_angle_p: float = parameter(
        2.5,
        'heading-hold gain while the yaw stick is centred',
        unit='1/s',
        minimum=0.0,
        maximum=30.0,
        live=True,
    )
    yaw_rate_p: float = parameter(0.3, 'rate gain, yaw', unit='s/rad', minimum=0.0, maximum=5.0, live=True)
    yaw_rate_i: float = parameter(
        0.2, 'rate integral gain, yaw', unit='1/rad', minimum=0.0, maximum=5.0, live=True
    )
    yaw_rate_d: float = parameter(
        0.0, 'rate derivative gain, yaw', unit='s^2/rad', minimum=0.0, maximum=0.5, live=True
    )
    setpoint_weight: float = parameter(
        1.0, 'weight of the rate setpoint in the P term', minimum=0.0, maximum=1.0, live=True
    )
    max_rate: float = parameter(
        4.0, 'largest rate setpoint, roll and pitch', unit='rad/s', minimum=0.1, maximum=35.0, live=True
    )
    max_yaw_rate: float = parameter(
        2.0, 'largest rate setpoint, yaw', unit='rad/s', minimum=0.1, maximum=35.0, live=True
    )
    integral_limit: float = parameter(
        0.2, 'largest integral term per axis', unit='thrust fraction', minimum=0.0, maximum=1.0, live=True
    )
    derivative_cutoff: float = parameter(
        60.0, 'low-pass of the derivative', unit='Hz', minimum=1.0, maximum=1000.0, live=True
    )
    rate_cutoff: float = parameter(
        0.0, 'low-pass of the rate; 0 = off', unit='Hz', minimum=0.0, maximum=1000.0, live=True
    )
    notch_frequency: float = parameter(
        0.0,
        'notch on the rate at the motor vibration; 0 = off',
        unit='Hz',
        minimum=0.0,
        maximum=1000.0,
        live=True,
    )
    notch_quality: float = parameter(3.0, 'quality of the notch', minimum=0.3, maximum=50.0, live=True)
    gain_blend_time: float = parameter(
        0.04, 'a live gain change moves in over this time', unit='s', minimum=0.0, maximum=5.0, live=True
    )


@dataclass(frozen=True)
class MixerParams:
    """Geometry-free X mixer and the way from thrust to pulse width."""

    idle_thrust: float = parameter(
        0.006, 'least thrust of an armed motor', unit='fraction', minimum=0.0, maximum=0.3
    )
    pulse_min: float = parameter(1000.0, 'pulse of a stopped motor', unit='us', minimum=500.0, maximum=2000.0)
    pulse_max: float = parameter(2000.0, 'pulse of full thrust', unit='us', minimum=1000.0, maximum=2500.0)
    thrust_curve: float = parameter(
        1.0,
        'thrust = c d^2 + (1 - c) d of the duty d; 1 = square, 0 = linear',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    sag_compensation: bool = parameter(
        True, 'divide the duty by the battery voltage over voltage_full', live=True
    )
    voltage_full: float = parameter(25.2, 'voltage at which duty 1 is full thrust', unit='V', minimum=1.0)

    def __post_init__(self) -> None:
        """Check the rules that span fields."""
        if self.pulse_max <= self.pulse_min:
            raise ParameterError(
                f"parameter 'pulse_max' is {self.pulse_max:g}, allowed: above pulse_min {self.pulse_min:g}"
            )


@dataclass(frozen=True)
class ArmingParams:
    """When the motors may turn, and what happens when something is missing."""

    imu_timeout: float = parameter(
        0.035, 'attitude older than this stops the motors', unit='s', minimum=0.005, maximum=0.04
    )
    link_timeout: float = parameter(
        0.5, 'setpoint older than this is a lost link', unit='s', minimum=0.05, maximum=5.0
    )
    descent_rate: float = parameter(
        0.7, 'speed of a descent while a range is heard', unit='m/s', minimum=0.1, maximum=5.0
    )
    descent_throttle: float = parameter(
        0.95,
        'thrust, per hover thrust, of a descent without height of a craft never seen to leave the ground',
        minimum=0.0,
        maximum=1.0,
    )
    inflow: float = parameter(
        0.6,
        'loss of specific thrust per climb rate (estimate): tells a steady climb from a hover without height',
        unit='1/s',
        minimum=0.0,
        maximum=5.0,
    )
    descent_time: float = parameter(
        60.0,
        'the motors stop when a descent has not been seen to sink for this long',
        unit='s',
        minimum=1.0,
        maximum=1000.0,
    )
    max_arming_tilt: float = parameter(0.2, 'no arming beyond this tilt', unit='rad', minimum=0.01)
    max_arming_throttle: float = parameter(
        0.05, 'no arming above this throttle', unit='fraction', minimum=0.0, maximum=0.5
    )
    max_rate_sigma: float = parameter(
        0.05, 'no arming, and a stop, while the rates are less well known', unit='rad/s', minimum=1e-5
    )
    battery_warn: float = parameter(20.4, 'voltage that starts the descent', unit='V', minimum=1.0)
    battery_hold: float = parameter(
        1.0, 'the voltage must be low for this long', unit='s', minimum=0.0, maximum=30.0
    )


@dataclass(frozen=True)
class TrialParams:
    """Automatic tuning and the trial of new gains."""

    guard_gain_changes: bool = parameter(True, 'put every live gain change on trial while armed', live=True)
    trial_time: float = parameter(4.0, 'length of a trial', unit='s', minimum=0.5, maximum=30.0, live=True)
    trial_rate: float = parameter(
        0.5, 'rate amplitude that counts as oscillation', unit='rad/s', minimum=0.05, maximum=10.0, live=True
    )
    trial_frequency: float = parameter(
        2.0, 'slowest swing that counts as oscillation', unit='Hz', minimum=0.5, maximum=20.0, live=True
    )
    trial_error: float = parameter(
        0.6, 'angle error that ends a trial at once', unit='rad', minimum=0.05, maximum=3.0, live=True
    )
    relay_amplitude: float = parameter(
        0.03, 'relay amplitude of the autotune', unit='thrust fraction', minimum=0.001, maximum=0.3, live=True
    )
    relay_hysteresis: float = parameter(
        0.02, 'hysteresis of the relay', unit='rad/s', minimum=0.0, maximum=1.0, live=True
    )


@dataclass(frozen=True)
class ControllerParams(PidParams, CascadeParams, MixerParams, ArmingParams, TrialParams):
    """Everything the attitude controller node takes."""

    controller: str = parameter(
        'cascade', 'which controller flies', choices=('published', 'cascade'), live=True
    )
    max_tilt: float = parameter(
        0.6, 'largest roll and pitch setpoint', unit='rad', minimum=0.05, maximum=1.2, live=True
    )
    altitude_p: float = parameter(
        1.2,
        'altitude gain, used while a range is heard and hold is asked',
        unit='1/s',
        minimum=0.0,
        live=True,
    )
    climb_p: float = parameter(0.06, 'climb-rate gain', unit='s/m', minimum=0.0, live=True)
    climb_i: float = parameter(0.04, 'climb-rate integral gain', unit='1/m', minimum=0.0, live=True)


@dataclass(frozen=True)
class EscParams:
    """The ESC driver: PWM chip and watchdog."""

    watchdog: float = parameter(
        0.05, 'no command for this long: all channels to pulse_idle', unit='s', minimum=0.005, maximum=1.0
    )
    pulse_idle: float = parameter(
        1000.0, 'pulse of a stopped motor', unit='us', minimum=500.0, maximum=2000.0
    )
    frequency: float = parameter(400.0, 'PWM frequency', unit='Hz', minimum=24.0, maximum=450.0)
    bus: str = parameter('/dev/i2c-1', "I2C bus of the chip; 'fake' = a simulated chip")
    address: int = parameter(0x40, 'I2C address of the PCA9685', minimum=0x08, maximum=0x77)
    channels: tuple = parameter(
        (0.0, 1.0, 2.0, 3.0), 'channel of each motor, in the order of the mixer', minimum=0.0, maximum=15.0
    )

    def __post_init__(self) -> None:
        """Check the rules that span fields."""
        if self.bus != 'fake' and not self.bus.startswith('/dev/i2c-'):
            raise ParameterError(f"parameter 'bus' is '{self.bus}', allowed: /dev/i2c-N or fake")
        if len(set(self.channels)) != len(self.channels) or any(c != int(c) for c in self.channels):
            raise ParameterError(
                f"parameter 'channels' is {list(self.channels)}, allowed: four different whole numbers"
            )


@dataclass(frozen=True)
class WebParams:
    """The tuning page."""

    host: str = parameter('127.0.0.1', 'address to listen on; others than loopback need a token of your own')
    port: int = parameter(8090, 'port; 0 = any free one', minimum=0, maximum=65535)
    token: str = parameter('', 'secret of the page; empty = a new one at each start, printed with the link')
    proxy_host: str = parameter(
        '', 'name[:port] by which browsers reach the page through a TLS proxy; empty = no proxy'
    )

    def __post_init__(self) -> None:
        """Check the rules that span fields."""
        if self.proxy_host and not re.fullmatch(r'[a-z0-9.\-\[\]:]+', self.proxy_host):
            raise ParameterError(
                f"parameter 'proxy_host' is '{self.proxy_host}', allowed: a name in lower case, and a port"
            )
        loopback = self.host in ('127.0.0.1', 'localhost', '::1')
        if (self.token or not loopback) and len(self.token) < 16:
            raise ParameterError("parameter 'token' is too short, allowed: 16 characters or more")


GAINS = tuple(
    field.name
    for cls in (PidParams, CascadeParams)
    for field in dataclasses.fields(cls)
    if field.metadata['live'] and field.name != 'gain_blend_time'
)
"""Names of the parameters that shape the loop; a change of one of them is put on trial."""
