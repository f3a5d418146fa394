# SPDX-License-Identifier: Apache-2.0
"""Parameters of the attitude estimators."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import parameter


@dataclass(frozen=True, slots=True)
class TwoStateParams:
    """The two-state filter of paper 004 for roll and pitch, with integrated yaw."""

    variant: str = parameter(
        'corrected',
        'published: covariance update in the printed order; corrected: in its right order',
        choices=('published', 'corrected'),
    )
    start: str = parameter(
        'accelerometer',
        'first angle: from the accelerometer, or zero with zero covariance as printed',
        choices=('accelerometer', 'zero'),
    )
    angle_noise: float = parameter(
        5e-3, 'process noise of an angle (Q_angle)', unit='rad^2/s', minimum=0.0, maximum=1e3, live=True
    )
    bias_noise: float = parameter(
        3e-3, 'random walk of a bias (Q_bias)', unit='(rad/s)^2/s', minimum=0.0, maximum=1e3, live=True
    )
    measurement_variance: float = parameter(
        3e-2,
        'variance of an accelerometer angle (R_measure)',
        unit='rad^2',
        minimum=1e-12,
        maximum=1e6,
        live=True,
    )
    bias_sigma: float = parameter(
        0.05, 'gyro bias at the start, one sigma per axis', unit='rad/s', minimum=0.0, maximum=10.0
    )
    gyro_noise: float = parameter(
        1e-4,
        'white noise of the gyro, for the growth of yaw',
        unit='rad/s/sqrt(Hz)',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    accel_noise: float = parameter(
        0.05, 'white noise of one specific force sample', unit='m/s^2', minimum=0.0, maximum=100.0, live=True
    )
    gimbal_limit: float = parameter(
        1.4,
        'beyond this pitch roll is not corrected and yaw is lost',
        unit='rad',
        minimum=0.1,
        maximum=1.55,
        live=True,
    )
    min_force: float = parameter(
        0.5,
        'weaker specific force has no usable direction',
        unit='m/s^2',
        minimum=1e-3,
        maximum=9.0,
        live=True,
    )
    max_force: float = parameter(
        1000.0, 'larger specific force is rejected', unit='m/s^2', minimum=10.0, maximum=1e5, live=True
    )
    max_rate: float = parameter(
        100.0, 'larger angular velocity is rejected', unit='rad/s', minimum=1.0, maximum=1e4, live=True
    )
    max_gap: float = parameter(
        1.0,
        'after a longer gap the angles start anew from the accelerometer',
        unit='s',
        minimum=0.01,
        maximum=10.0,
        live=True,
    )
    lag_window: float = parameter(
        0.5, 'largest delay of arrival that is repaired; 0 = none', unit='s', minimum=0.0, maximum=5.0
    )
    settled_output: bool = parameter(False, 'publish imu/data_settled, lag_window behind', live=True)
    frame_id: str = parameter('', 'accept only this frame; empty = any', live=True)


@dataclass(frozen=True, slots=True)
class AttitudeParams:
    """The 6- or 9-axis error-state filter."""

    use_magnetometer: bool = parameter(True, 'correct heading with imu/mag; false = 6-axis', live=True)
    block: float = parameter(
        0.05,
        'span over which samples are pre-integrated before one update',
        unit='s',
        minimum=0.005,
        maximum=0.5,
    )
    gyro_noise: float = parameter(
        8.7e-4, 'attitude process noise at rest', unit='rad/s/sqrt(Hz)', minimum=1e-6, maximum=1.0, live=True
    )
    rate_noise: float = parameter(
        3e-3,
        'attitude process noise per root of turned angle and rate: scale, alignment, rectified vibration',
        unit='sqrt(s)',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    bias_walk: float = parameter(
        7e-5, 'random walk of the gyro bias', unit='rad/s/sqrt(s)', minimum=0.0, maximum=0.1, live=True
    )
    bias_sigma: float = parameter(
        0.03, 'gyro bias at the start, one sigma per axis', unit='rad/s', minimum=1e-6, maximum=1.0
    )
    accel_noise: float = parameter(
        0.02, 'white noise of the accelerometer', unit='m/s^2/sqrt(Hz)', minimum=1e-6, maximum=10.0, live=True
    )
    tilt_sigma: float = parameter(
        0.2, 'roll and pitch of the first sample, one sigma', unit='rad', minimum=1e-3, maximum=3.0
    )
    start_time: float = parameter(
        1.0,
        'time over which specific force is averaged for roll and pitch after a start',
        unit='s',
        minimum=0.0,
        maximum=10.0,
    )
    start_speed: float = parameter(
        1.0, 'horizontal speed at the start, one sigma per axis', unit='m/s', minimum=1e-3, maximum=1e3
    )
    motion_frequency: float = parameter(
        0.1,
        'least frequency below which linear acceleration vanishes, since the motion stays in place',
        unit='Hz',
        minimum=1e-3,
        maximum=10.0,
        live=True,
    )
    motion_frequency_max: float = parameter(
        0.5, 'largest such frequency', unit='Hz', minimum=1e-3, maximum=10.0, live=True
    )
    motion_share: float = parameter(
        0.25,
        'that frequency as a share of the measured frequency of the motion',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    motion_damping: float = parameter(
        0.7, 'damping of the motion model', minimum=0.05, maximum=5.0, live=True
    )
    motion_noise: float = parameter(
        1.0,
        'least density of linear acceleration above that frequency',
        unit='m/s^2/sqrt(Hz)',
        minimum=1e-3,
        maximum=100.0,
        live=True,
    )
    motion_span: float = parameter(
        0.5,
        'time over which linear acceleration is correlated',
        unit='s',
        minimum=0.0,
        maximum=100.0,
        live=True,
    )
    motion_memory: float = parameter(
        2.0,
        'time constant with which the measured level of linear acceleration decays',
        unit='s',
        minimum=0.05,
        maximum=100.0,
        live=True,
    )
    rest_rate: float = parameter(
        5.2e-3,
        'at rest block means of the rate stay this close to their mean',
        unit='rad/s',
        minimum=1e-5,
        maximum=1.0,
        live=True,
    )
    rest_force: float = parameter(
        0.1,
        'at rest block means of the specific force stay this close to their mean',
        unit='m/s^2',
        minimum=1e-3,
        maximum=10.0,
        live=True,
    )
    rest_time: float = parameter(
        1.5, 'quiet time before rest is believed', unit='s', minimum=0.1, maximum=60.0, live=True
    )
    rest_noise: float = parameter(
        2.8e-4,
        'noise of the rate at rest as a measurement of the bias',
        unit='rad/s/sqrt(Hz)',
        minimum=1e-7,
        maximum=1.0,
        live=True,
    )
    mag_noise: float = parameter(
        0.026,
        'least noise of the magnetic heading',
        unit='rad/sqrt(Hz)',
        minimum=1e-5,
        maximum=10.0,
        live=True,
    )
    mag_span: float = parameter(
        3.0,
        'time over which a disturbance of the field is correlated',
        unit='s',
        minimum=0.0,
        maximum=1e3,
        live=True,
    )
    mag_memory: float = parameter(
        0.5,
        'time constant with which the measured level of disturbance decays',
        unit='s',
        minimum=0.05,
        maximum=100.0,
        live=True,
    )
    mag_norm_gate: float = parameter(
        0.1,
        'relative deviation of the field strength that is rejected beyond',
        minimum=0.001,
        maximum=1.0,
        live=True,
    )
    mag_dip_gate: float = parameter(
        0.175,
        'deviation of the dip that is rejected beyond',
        unit='rad',
        minimum=0.001,
        maximum=3.2,
        live=True,
    )
    mag_reference: float = parameter(
        20.0,
        'time constant with which strength and dip of the accepted field are followed',
        unit='s',
        minimum=0.1,
        maximum=1e4,
        live=True,
    )
    mag_recovery: float = parameter(
        20.0,
        'a different field steady for this long becomes the new reference',
        unit='s',
        minimum=0.1,
        maximum=1e4,
        live=True,
    )
    sensor_delay: float = parameter(
        4.2e-3,
        'group delay of gyro and accelerometer; attitude is carried forward by rate times delay',
        unit='s',
        minimum=0.0,
        maximum=0.05,
        live=True,
    )
    mag_delay: float = parameter(
        10.5e-3, 'delay of the magnetometer behind the gyro', unit='s', minimum=0.0, maximum=0.05, live=True
    )
    delay_sigma: float = parameter(
        1e-3, 'uncertainty of sensor_delay, one sigma', unit='s', minimum=0.0, maximum=0.05, live=True
    )
    heading_sigma: float = parameter(
        0.0175,
        'lasting error of magnetic heading (calibration, declination) added to its variance',
        unit='rad',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    max_rate: float = parameter(
        100.0, 'larger angular velocity is rejected', unit='rad/s', minimum=1.0, maximum=1e4, live=True
    )
    max_force: float = parameter(
        320.0, 'larger specific force is rejected', unit='m/s^2', minimum=10.0, maximum=1e5, live=True
    )
    max_angular_acceleration: float = parameter(
        3000.0,
        'a faster change of rate is taken for a fault for up to two samples',
        unit='rad/s^2',
        minimum=1.0,
        maximum=1e9,
        live=True,
    )
    min_jump: float = parameter(
        100.0,
        'a slower change of rate is never taken for a fault; a faster one is if the last seconds had none',
        unit='rad/s^2',
        minimum=0.0,
        maximum=1e9,
        live=True,
    )
    min_push: float = parameter(
        1000.0,
        'a slower change of specific force is never taken for a fault',
        unit='m/s^3',
        minimum=0.0,
        maximum=1e9,
        live=True,
    )
    hidden_acceleration: float = parameter(
        1.0,
        'least angular acceleration that is reckoned with while the rate is not measured',
        unit='rad/s^2',
        minimum=0.0,
        maximum=1e3,
        live=True,
    )
    max_jerk: float = parameter(
        3e4,
        'a faster change of specific force is taken for a fault for up to two samples',
        unit='m/s^3',
        minimum=1.0,
        maximum=1e9,
        live=True,
    )
    min_force: float = parameter(
        0.5,
        'weaker specific force cannot start the filter',
        unit='m/s^2',
        minimum=1e-3,
        maximum=9.0,
        live=True,
    )
    max_field: float = parameter(
        0.01, 'larger field is rejected', unit='T', minimum=1e-4, maximum=10.0, live=True
    )
    max_gap: float = parameter(
        1.0,
        'after a longer gap attitude starts anew from the next sample; the bias is kept',
        unit='s',
        minimum=0.02,
        maximum=9.0,
        live=True,
    )
    bias_period: float = parameter(
        1.0,
        'imu/bias is published once in this time; 0 = with every sample',
        unit='s',
        minimum=0.0,
        maximum=1e3,
        live=True,
    )
    lag_window: float = parameter(
        0.5, 'largest delay of arrival that is repaired; 0 = none', unit='s', minimum=0.0, maximum=5.0
    )
    settled_output: bool = parameter(False, 'publish imu/data_settled, lag_window behind', live=True)
    frame_id: str = parameter('', 'accept only this frame; empty = any', live=True)
