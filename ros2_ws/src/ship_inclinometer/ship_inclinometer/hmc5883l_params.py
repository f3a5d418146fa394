# SPDX-License-Identifier: Apache-2.0
"""Parameters of the HMC5883L driver."""

from __future__ import annotations

from dataclasses import dataclass

from imu_kalman.i2c import is_bus_path
from kalman_core.parameters import ParameterError, parameter

AVERAGES = (1, 2, 4, 8)
# Counts per gauss by the gain bits, and the field (gauss) that they are meant for (datasheet, table 9).
GAINS = (1370.0, 1090.0, 820.0, 660.0, 440.0, 390.0, 330.0, 230.0)
RANGES = (0.88, 1.3, 1.9, 2.5, 4.0, 4.7, 5.6, 8.1)


@dataclass(frozen=True, slots=True)
class Hmc5883lParams:
    """How the chip is reached, set up, mounted and checked."""

    bus: str = parameter('/dev/i2c-1', "bus of the kernel, or 'fake' for a simulated chip")
    frame_id: str = parameter('imu_link', 'frame of the messages')
    rate: float = parameter(75.0, 'measurements per second', unit='Hz', minimum=1.0, maximum=100.0)
    averages: int = parameter(1, 'readings the chip averages for one measurement: 1, 2, 4 or 8')
    range: float = parameter(
        1.3, 'largest field: 0.88, 1.3, 1.9, 2.5, 4.0, 4.7, 5.6 or 8.1; grows by itself', unit='gauss'
    )
    mounting: tuple = parameter((0.0, 0.0, 0.0), 'roll, pitch, yaw of the chip in the body frame', unit='rad')
    self_test: bool = parameter(True, 'measure the built-in coil at start; refuse a chip that fails')
    noise: float = parameter(
        0.2e-6, 'white noise of one reading, 1 sigma (datasheet: 2 mG)', unit='T', minimum=0.0
    )
    first_delay: float = parameter(
        0.1, 'pause after a bus fault; doubles with each failure', unit='s', minimum=0.01, maximum=10.0
    )
    longest_delay: float = parameter(5.0, 'longest such pause', unit='s', minimum=0.01, maximum=60.0)

    def __post_init__(self) -> None:
        for name, choices in (('averages', AVERAGES), ('range', RANGES)):
            value = getattr(self, name)
            if value not in choices:
                listed = ', '.join(f'{choice:g}' for choice in choices)
                raise ParameterError(f"parameter '{name}' is {value:g}, allowed: {listed}")
        if self.bus != 'fake' and not is_bus_path(self.bus):
            raise ParameterError(f"parameter 'bus' is {self.bus!r}, allowed: /dev/i2c-N or fake")
        if self.longest_delay < self.first_delay:
            raise ParameterError(
                f"parameter 'longest_delay' is {self.longest_delay:g}, "
                f'allowed: >= first_delay ({self.first_delay:g} s)'
            )
