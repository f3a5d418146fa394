# SPDX-License-Identifier: Apache-2.0
"""Parameters of every node of this package: units, bounds and meaning, declared once."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import parameter


@dataclass(frozen=True, slots=True)
class VelocityParams:
    """The joint filter."""

    wheel_radius: float = parameter(0.285, 'nominal rolling radius', unit='m', minimum=0.05, maximum=2.0)
    pulses_per_revolution: float = parameter(36.0, 'encoder pulses per wheel turn', minimum=1.0)
    accelerometer_noise: float = parameter(
        0.0067, 'white noise density of the accelerometer', unit='m/s²/√Hz', minimum=0.0, live=True
    )
    jerk: float = parameter(
        1.5, 'how fast the acceleration may change between two readings', unit='m/s³', minimum=0.0, live=True
    )
    bias_noise: float = parameter(
        0.002, 'random walk of the accelerometer bias', unit='m/s²/√s', minimum=0.0, live=True
    )
    grade_noise: float = parameter(
        0.008,
        'random walk of g·sin(grade) with distance, on a common road',
        unit='m/s²/√m',
        minimum=0.0,
        live=True,
    )
    bias_sigma: float = parameter(0.5, 'bias and grade at start', unit='m/s²', minimum=1e-3)
    pitch_gain: float = parameter(
        0.025, 'share of the acceleration that pitch adds', minimum=-0.2, maximum=0.2
    )
    pitch_gain_sigma: float = parameter(0.02, 'its uncertainty', minimum=0.0, maximum=0.2)
    scale: float = parameter(
        0.0, 'wheel scale error: the wheel reads (1 + scale) times the road', minimum=-0.2, maximum=0.2
    )
    scale_sigma: float = parameter(0.015, 'its uncertainty', minimum=1e-5, maximum=0.2)
    scale_noise: float = parameter(1e-5, 'random walk of the scale with distance', unit='1/√m', minimum=0.0)
    slip: float = parameter(
        0.005,
        'longitudinal slip per acceleration: 1/(g·20), tyre slip stiffness 20',
        unit='s²/m',
        minimum=0.0,
        maximum=0.05,
    )
    slip_sigma: float = parameter(0.003, 'its uncertainty', unit='s²/m', minimum=0.0, maximum=0.05)
    wheel_noise: float = parameter(
        0.001, 'random walk of the rolled distance with distance', unit='m/√m', minimum=0.0, live=True
    )
    wheel_speed_sigma: float = parameter(
        0.15, 'noise of a wheel or vehicle speed signal', unit='m/s', minimum=1e-3, live=True
    )
    wheel_speed_correlation: float = parameter(
        0.1, 'time over which that noise is one and the same', unit='s', minimum=0.0, live=True
    )
    wheel_delay: float = parameter(0.0, 'delay of the encoder', unit='s', minimum=0.0, maximum=1.0)
    wheel_delay_sigma: float = parameter(0.0, 'its uncertainty', unit='s', minimum=0.0, maximum=1.0)
    speed_delay: float = parameter(
        0.1, 'delay of a wheel or vehicle speed signal', unit='s', minimum=0.0, maximum=1.0
    )
    speed_delay_sigma: float = parameter(0.2, 'its uncertainty', unit='s', minimum=0.0, maximum=1.0)
    gps_sigma: float = parameter(
        0.1, 'noise of the GPS speed where the message gives none', unit='m/s', minimum=1e-3, live=True
    )
    gps_delay: float = parameter(
        0.1, 'delay of the GPS speed behind its stamp', unit='s', minimum=0.0, maximum=1.0
    )
    gps_delay_sigma: float = parameter(
        0.2, 'its uncertainty; 0 trusts gps_delay', unit='s', minimum=0.0, maximum=1.0
    )
    delay_noise: float = parameter(1e-4, 'random walk of the delays', unit='s/√s', minimum=0.0)
    gate: float = parameter(
        10.83, 'gate of the normalised innovation squared, 1 degree of freedom, 10⁻³', minimum=1.0, live=True
    )
    lockout_time: float = parameter(
        10.0, 'a sensor refused for longer is believed again', unit='s', minimum=0.5, live=True
    )
    still_time: float = parameter(
        0.6, 'no encoder pulse for this long is standstill', unit='s', minimum=0.05, live=True
    )
    still_speed: float = parameter(
        0.5, 'largest estimated speed at which standstill is believed', unit='m/s', minimum=0.0, live=True
    )
    still_sigma: float = parameter(
        0.002, 'how much a standing car rocks', unit='m/s', minimum=1e-4, live=True
    )
    coast_noise: float = parameter(
        1.5, 'speed noise density while the accelerometer is silent', unit='m/s/√s', minimum=0.0, live=True
    )
    max_gap: float = parameter(
        0.25, 'age at which an accelerometer reading is void', unit='s', minimum=0.01, live=True
    )
    bleed_time: float = parameter(
        0.02, 'time constant with which corrections reach the output', unit='s', minimum=1e-3, live=True
    )
    bleed_step: float = parameter(
        0.012, 'largest correction let out in 2 ms', unit='m/s', minimum=1e-4, live=True
    )
    acceleration_rate: float = parameter(
        100.0, 'rate of vehicle/acceleration', unit='Hz', minimum=1.0, maximum=1000.0, live=True
    )
    calibration_file: str = parameter('', 'file that keeps wheel scale and slip from drive to drive')
    settled_output: bool = parameter(False, 'also give the estimate once the lag window has passed')
    lag_window: float = parameter(
        0.5, 'largest delay of arrival that is repaired', unit='s', minimum=0.0, maximum=5.0
    )


@dataclass(frozen=True, slots=True)
class FusionParams:
    """The paper's fusion. The σ are by phase: accelerating, steady, braking, coasting."""

    variant: str = parameter(
        'corrected',
        'published: a slow sample used N times counts N-fold, phases by the rules as printed',
        choices=('published', 'corrected'),
    )
    wheel_radius: float = parameter(0.285, 'nominal rolling radius', unit='m', minimum=0.05, maximum=2.0)
    wheel_scale: float = parameter(
        0.0, 'the wheel reads (1 + wheel_scale) times the road', minimum=-0.2, maximum=0.2
    )
    sigma_wheel: tuple = parameter(
        (0.4, 0.4, 0.4, 0.4), 'σ of the wheel speed in the weights', unit='m/s', minimum=1e-4, live=True
    )
    sigma_gps: tuple = parameter(
        (0.2, 0.1, 0.2, 0.1), 'σ of the GPS speed in the weights', unit='m/s', minimum=1e-4, live=True
    )
    sigma_accelerometer: tuple = parameter(
        (0.01, 0.007, 0.01, 0.007),
        'σ of one step of the integrated acceleration in the weights',
        unit='m/s',
        minimum=1e-4,
        live=True,
    )
    wheel_noise: float = parameter(
        0.2, 'noise of a wheel speed sample: a count in 0.1 s', unit='m/s', minimum=1e-3, live=True
    )
    gps_noise: float = parameter(0.05, 'noise of a GPS speed sample', unit='m/s', minimum=1e-3, live=True)
    accelerometer_noise: float = parameter(
        0.15, 'noise of an accelerometer sample', unit='m/s²', minimum=1e-3, live=True
    )
    jerk_noise: float = parameter(
        2.0, 'random walk of the acceleration in all filters', unit='m/s²/√s', minimum=1e-3, live=True
    )
    acceleration_threshold: float = parameter(
        0.15, "the rules' e_x: below it the car is steady", unit='m/s²', minimum=0.0, live=True
    )
    pedal_threshold: float = parameter(
        0.2, "the rules' e_a: below it the pedal holds the speed", minimum=0.0, maximum=1.0, live=True
    )
    stale_time: float = parameter(
        2.5, 'a sensor silent for longer has no weight', unit='s', minimum=0.1, live=True
    )
    settled_output: bool = parameter(False, 'also give the estimate once the lag window has passed')
    lag_window: float = parameter(
        0.5, 'largest delay of arrival that is repaired', unit='s', minimum=0.0, maximum=5.0
    )
