# SPDX-License-Identifier: Apache-2.0
"""Parameters of the estimators."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import ParameterError, parameter


@dataclass(frozen=True)
class AttitudeParams:
    """Attitude estimator. Noise defaults are those of a still MPU6050/HMC5883L pair."""

    schedule: str = parameter(
        'full',
        "full: inertial filter, every sample used; published: the paper's 200/5 Hz vector filter",
        choices=('full', 'published'),
    )
    gyro_noise: float = parameter(
        0.017, 'gyro white noise, root power spectral density', unit='°/s/√Hz', minimum=1e-5, maximum=1.0
    )
    gyro_bias_sigma: float = parameter(
        5.0, 'standard deviation of the gyro bias at start', unit='°/s', minimum=1e-3, maximum=30.0
    )
    gyro_bias_walk: float = parameter(
        0.0034, 'random walk of the gyro bias, warm-up included', unit='°/s/√s', minimum=1e-7, maximum=1.0
    )
    accelerometer_noise: float = parameter(
        0.006, 'accelerometer white noise', unit='m/s²/√Hz', minimum=1e-5, maximum=1.0
    )
    accelerometer_bias_sigma: float = parameter(
        1.0,
        'standard deviation of the accelerometer bias left by calibration',
        unit='mg',
        minimum=0.01,
        maximum=200.0,
    )
    accelerometer_bias_walk: float = parameter(
        0.01, 'random walk of the accelerometer bias', unit='mg/√s', minimum=0.0, maximum=10.0
    )
    align_time: float = parameter(
        20.0, 'length of the coarse alignment', unit='s', minimum=2.0, maximum=120.0
    )
    align_sigma: float = parameter(
        1.5, 'wave acceleration distrusted while aligning', unit='m/s²', minimum=0.1, maximum=20.0
    )
    wave_damping: float = parameter(
        0.2, 'relative width of the wave displacement spectrum', minimum=0.02, maximum=1.0
    )
    wave_sigma: float = parameter(
        2.0, 'wave displacement assumed at start, learned afterwards', unit='m', minimum=0.05, maximum=30.0
    )
    wave_period: float = parameter(9.0, 'wave period assumed at start', unit='s', minimum=4.0, maximum=30.0)
    wave_time: float = parameter(
        60.0, 'time constant of learning the waves', unit='s', minimum=5.0, maximum=3600.0
    )
    aiding_interval: float = parameter(
        1.5, 'interval of the displacement pseudo-measurement', unit='s', minimum=0.02, maximum=5.0
    )
    aiding_sigma: float = parameter(
        0.03, 'mismatch of the wave model as a share of the displacement', minimum=0.001, maximum=2.0
    )
    path_walk: float = parameter(
        0.01, "random walk of the mean path's velocity", unit='m/s/√s', minimum=1e-5, maximum=5.0
    )
    path_turn: float = parameter(
        0.3, 'current and drift that do not turn with the ship', unit='m/s', minimum=0.0, maximum=5.0
    )
    speed_sigma: float = parameter(
        8.0, 'speed of the ship while nothing measures it', unit='m/s', minimum=0.1, maximum=30.0
    )
    leeway_sigma: float = parameter(
        0.5, 'athwart speed through water', unit='m/s', minimum=0.05, maximum=10.0
    )
    log_sigma: float = parameter(0.2, 'error of the speed log', unit='m/s', minimum=0.01, maximum=5.0)
    gnss_sigma: float = parameter(
        0.05,
        'GNSS velocity error per axis where the message has none',
        unit='m/s',
        minimum=0.005,
        maximum=10.0,
    )
    gnss_delay: float = parameter(
        0.0, 'how much later than its validity a GNSS velocity is stamped', unit='s', minimum=0.0, maximum=0.5
    )
    magnetometer_noise: float = parameter(
        0.15,
        'magnetometer noise of a sample at start, adapted afterwards',
        unit='µT',
        minimum=0.001,
        maximum=10.0,
    )
    deviation_sigma: float = parameter(
        0.5, 'magnetic deviation left after calibration', unit='°', minimum=0.05, maximum=20.0
    )
    deviation_angle: float = parameter(
        60.0, 'heading change over which the deviation is forgotten', unit='°', minimum=5.0, maximum=360.0
    )
    deviation_coefficients: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0),
        'calibration: A, B, C, D, E of the ship swing, added to the magnetic heading',
        unit='°',
        minimum=-45.0,
        maximum=45.0,
    )
    declination: float = parameter(
        0.0, 'magnetic declination, east positive', unit='°', minimum=-180.0, maximum=180.0
    )
    field_norm_gate: float = parameter(
        0.1, 'largest relative change of the field norm', minimum=0.01, maximum=1.0
    )
    field_dip_gate: float = parameter(5.0, 'largest change of the dip', unit='°', minimum=0.5, maximum=45.0)
    magnetic_lockout: float = parameter(
        120.0, 'a field that stays changed this long is learned anew', unit='s', minimum=5.0, maximum=3600.0
    )
    imu_lever_arm: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), 'IMU from the roll centre, x forward y left z up; zero: unknown', unit='m'
    )
    antenna_lever_arm: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), 'GNSS antenna from the IMU, x forward y left z up', unit='m'
    )
    magnetometer_matrix: tuple[float, ...] = parameter(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 'calibration: matrix (row by row) of raw - offset'
    )
    magnetometer_offset: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'calibration: hard iron', unit='T')
    accelerometer_matrix: tuple[float, ...] = parameter(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 'calibration: matrix (row by row) of raw - offset'
    )
    accelerometer_offset: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'calibration: offset', unit='m/s²')
    gyro_offset: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'calibration: rate at rest', unit='rad/s')
    published_interval: float = parameter(
        0.2, 'interval of the update of the published schedule', unit='s', minimum=0.001, maximum=10.0
    )
    published_cutoff: float = parameter(
        5.0, 'low-pass on accelerometer and magnetometer of the published schedule', unit='Hz', minimum=0.05
    )
    published_transition: str = parameter(
        'accumulated',
        'covariance over 0.2 s: carried over each gyro step, or with the attitude of one instant as printed',
        choices=('accumulated', 'instant'),
    )
    published_force_sigma: float = parameter(
        0.1, 'error of the gravity direction, published schedule', minimum=1e-4, maximum=2.0
    )
    published_field_sigma: float = parameter(
        0.05, 'error of the field direction, published schedule', minimum=1e-4, maximum=2.0
    )
    field_dip: float = parameter(
        55.0, 'dip of the field, published schedule', unit='°', minimum=-89.0, maximum=89.0
    )
    angle_rate: float = parameter(
        20.0, 'rate of roll, pitch and yaw on their own topic', unit='Hz', minimum=1.0, maximum=1000.0
    )
    settled_output: bool = parameter(False, 'publish the settled attitude, `window` later')
    frame_id: str = parameter('', "frame of the IMU's messages, others are rejected; empty: any")
    valid_sigma: float = parameter(
        0.5, 'largest 1σ of roll and pitch that is declared valid', unit='°', minimum=0.05, maximum=10.0
    )
    stale_time: float = parameter(
        0.5, 'IMU gap after which the estimate is restarted', unit='s', minimum=0.02
    )
    window: float = parameter(
        0.5, 'largest delay of arrival that is repaired', unit='s', minimum=0.0, maximum=5.0
    )

    def __post_init__(self) -> None:
        """Refuse a delay that the window cannot repair."""
        if self.gnss_delay > self.window:
            raise ParameterError("parameter 'gnss_delay' is larger than 'window'")
