# SPDX-License-Identifier: Apache-2.0
"""Parameters of the MPU6050 driver."""

from __future__ import annotations

import math
from dataclasses import dataclass

from imu_kalman import mpu6050_registers as reg
from imu_kalman.i2c import is_bus_path
from imu_kalman.sim_params import MOTIONS
from kalman_core.parameters import ParameterError, parameter

_DEG = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class Mpu6050Params:
    """How the chip is reached, set up, read, mounted and calibrated."""

    bus: str = parameter('/dev/i2c-1', "bus of the kernel, or 'fake' for a simulated chip")
    address: int = parameter(0x68, 'address: 104 (AD0 low) or 105 (AD0 high)', minimum=0x68, maximum=0x69)
    frame_id: str = parameter('imu_link', 'frame of the messages')
    rate: float = parameter(
        200.0,
        'samples per second; taken is 1000/n (8000/n with bandwidth 256), n the nearest of 1 … 256',
        unit='Hz',
        minimum=4.0,
        maximum=1000.0,
    )
    bandwidth: int = parameter(98, 'low-pass: 5, 10, 20, 42, 98, 188 or 256 (off)', unit='Hz')
    gyro_range: int = parameter(500, 'full scale: 250, 500, 1000 or 2000', unit='deg/s')
    accel_range: int = parameter(4, 'full scale: 2, 4, 8 or 16', unit='g')
    pacing: str = parameter(
        'fifo',
        'fifo: read what has gathered, nothing is lost; data_ready: read each sample as it comes',
        choices=('fifo', 'data_ready'),
    )
    poll_rate: float = parameter(
        0.0,
        'looks per second; 0: half the sample rate (fifo) or twice (data_ready)',
        unit='Hz',
        minimum=0.0,
        maximum=1000.0,
    )
    compensate_delay: bool = parameter(True, "date stamps back by the low-pass filter's delay")
    mounting: tuple = parameter((0.0, 0.0, 0.0), 'roll, pitch, yaw of the chip in the body frame', unit='rad')
    temperature_rate: float = parameter(
        1.0, 'imu/temperature; 0: none', unit='Hz', minimum=0.0, maximum=100.0
    )

    calibrate_at_start: bool = parameter(True, 'take the gyro bias from the first rest after start')
    gyro_bias: tuple = parameter((0.0, 0.0, 0.0), 'gyro bias to start from, axes of the chip', unit='rad/s')
    calibration_time: float = parameter(
        2.0, 'rest that a calibration needs', unit='s', minimum=0.5, maximum=60.0
    )
    still_gyro: float = parameter(
        0.3 * _DEG, 'rest: largest change of the mean rate', unit='rad/s', minimum=1e-4
    )
    still_accel: float = parameter(
        0.1, 'rest: largest change of the mean specific force', unit='m/s^2', minimum=1e-3
    )
    largest_bias: float = parameter(
        20.0 * _DEG, 'no larger bias is believed (datasheet: 20 °/s)', unit='rad/s', minimum=1e-3
    )

    gyro_noise: float = parameter(0.005 * _DEG, 'white noise (datasheet)', unit='rad/s/sqrt(Hz)', minimum=0.0)
    accel_noise: float = parameter(
        400e-6 * reg.STANDARD_GRAVITY, 'white noise (datasheet)', unit='m/s^2/sqrt(Hz)', minimum=0.0
    )
    first_delay: float = parameter(
        0.1, 'pause after a bus fault; doubles with each failure', unit='s', minimum=0.01, maximum=10.0
    )
    longest_delay: float = parameter(5.0, 'longest such pause', unit='s', minimum=0.01, maximum=60.0)

    fake_motion: str = parameter('hand_held', 'bus fake: how the chip is moved', choices=MOTIONS)
    fake_seed: int = parameter(1, 'bus fake: seed', minimum=0, maximum=2**31 - 1)

    def __post_init__(self) -> None:
        for name, choices in (
            ('bandwidth', reg.BANDWIDTHS),
            ('gyro_range', reg.GYRO_RANGES),
            ('accel_range', reg.ACCEL_RANGES),
        ):
            value = getattr(self, name)
            if value not in choices:
                listed = ', '.join(str(choice) for choice in sorted(choices))
                raise ParameterError(f"parameter '{name}' is {value}, allowed: {listed}")
        if self.bus != 'fake' and not is_bus_path(self.bus):
            raise ParameterError(f"parameter 'bus' is {self.bus!r}, allowed: /dev/i2c-N or fake")
        if self.longest_delay < self.first_delay:
            raise ParameterError(
                f"parameter 'longest_delay' is {self.longest_delay:g}, "
                f'allowed: >= first_delay ({self.first_delay:g} s)'
            )

    @property
    def filter_setting(self) -> int:
        """DLPF_CFG."""
        return reg.BANDWIDTHS.index(self.bandwidth)

    @property
    def divider(self) -> int:
        """SMPLRT_DIV: the nearest divider of the chip's internal rate."""
        internal = reg.INTERNAL_RATES[self.filter_setting]
        return min(max(round(internal / self.rate) - 1, 0), 255)

    @property
    def sample_rate(self) -> float:
        """Samples per second that come of it (Hz)."""
        return reg.INTERNAL_RATES[self.filter_setting] / (1 + self.divider)

    @property
    def polls_per_second(self) -> float:
        """Looks per second, within what a timer can do."""
        if self.poll_rate > 0.0:
            return self.poll_rate
        factor = 0.5 if self.pacing == 'fifo' else 2.0
        return min(max(factor * self.sample_rate, 10.0), 1000.0)
