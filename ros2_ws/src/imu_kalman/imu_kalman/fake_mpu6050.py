# SPDX-License-Identifier: Apache-2.0
"""An MPU-6050 by its register map: sampling, ranges, low-pass, FIFO, interrupts, sleep, reset, temperature.

It samples a motion that is given as a function of time, with its own clock, noise and bias. Not modelled:
the auxiliary I2C master, cycle mode, motion detection, self-test currents and the DMP.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from imu_kalman import mpu6050_registers as reg
from imu_kalman.fake_bus import FakeBus
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation_motion import TruthModel

_SECOND = 1_000_000_000
# The chip does not answer while it resets (PS: up to 100 ms from power-up; 5 ms is an estimate for a reset).
_RESET_TIME = 5_000_000
# Never more samples than the FIFO can hold are worth making after a pause: two bytes a sample at least.
_BACKLOG = reg.FIFO_SIZE // 2
_READ_ONLY = frozenset([*range(0x3A, 0x61), 0x72, 0x73, 0x75])


class Moving(Protocol):
    """What of a simulation_motion.Truth the chip feels: (n, 3) each, in its axes."""

    @property
    def rate(self) -> np.ndarray:
        """Angular velocity (rad/s)."""

    @property
    def force(self) -> np.ndarray:
        """Specific force (m/s²)."""


Motion = Callable[[np.ndarray], Moving]


class FakeMpu6050:
    """A chip on a FakeBus. Units are SI; vectors are in the chip's axes."""

    def __init__(
        self,
        motion: Motion,
        *,
        start: int = 0,
        seed: int = 0,
        identity: int = reg.IDENTITY,
        clock_error: float = 0.0,
        temperature: float = 27.0,
        gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        accel_bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gyro_noise: float = 0.005 * reg.DEGREE,
        accel_noise: float = 400e-6 * reg.STANDARD_GRAVITY,
    ) -> None:
        """`motion(times)`, s since `start` (ns); `clock_error`: by how much the chip's clock is fast."""
        self._motion = motion
        self._start = start
        self._rng = np.random.default_rng(seed)
        self._identity = identity
        self._clock_error = clock_error
        self.temperature = temperature
        self.gyro_bias = np.asarray(gyro_bias)
        self.accel_bias = np.asarray(accel_bias)
        self._gyro_noise = gyro_noise
        self._accel_noise = accel_noise
        self.frozen = False
        self.samples = 0
        self.sample_times: list[int] = []
        self._power_up(start)

    def _power_up(self, now: int) -> None:
        self.registers = bytearray(128)
        self.registers[reg.PWR_MGMT_1] = reg.PWR_SLEEP
        self.registers[reg.WHO_AM_I] = self._identity
        self._fifo = bytearray()
        self._last_fifo_byte = 0
        self._count_shadow = (0, 0)
        self._awake_since = now
        self._next_sample = float(now)
        self._busy_until = now

    def brown_out(self, now: int) -> None:
        """Lose power for a moment: everything is as after power-up."""
        self._power_up(now)

    @property
    def period(self) -> float:
        """Time between two samples (ns) as the chip's own clock makes it."""
        internal = reg.INTERNAL_RATES[self._filter]
        return _SECOND * (1 + self.registers[reg.SMPLRT_DIV]) / internal / (1.0 + self._clock_error)

    @property
    def _filter(self) -> int:
        setting = self.registers[reg.CONFIG] & 0x07
        return 0 if setting == 7 else setting  # 7 is reserved and behaves as 0

    def read(self, register: int, count: int, now: int) -> bytes:
        """See FakeDevice."""
        self._answer(now)
        out = bytearray()
        for _ in range(count):
            out.append(self._read_byte(register))
            if register != reg.FIFO_R_W:
                register = (register + 1) & 0x7F
        return bytes(out)

    def write(self, register: int, data: bytes, now: int) -> None:
        """See FakeDevice."""
        self._answer(now)
        for value in data:
            self._write_byte(register, value, now)
            if register != reg.FIFO_R_W:
                register = (register + 1) & 0x7F

    def _answer(self, now: int) -> None:
        if now < self._busy_until:
            raise OSError(errno.ENXIO, 'resetting')
        self._advance(now)

    def _read_byte(self, register: int) -> int:
        if register == reg.INT_STATUS:
            value = self.registers[register]
            self.registers[register] = 0
            return value
        if register == reg.FIFO_COUNT_H:
            # Reading the high byte loads both: the low byte alone would be old.
            self._count_shadow = divmod(len(self._fifo), 256)
            return self._count_shadow[0]
        if register == reg.FIFO_COUNT_H + 1:
            return self._count_shadow[1]
        if register == reg.FIFO_R_W:
            if self._fifo:
                self._last_fifo_byte = self._fifo.pop(0)
            return self._last_fifo_byte
        return self.registers[register]

    def _write_byte(self, register: int, value: int, now: int) -> None:
        if register in _READ_ONLY:
            return
        if register == reg.PWR_MGMT_1:
            self._write_power(value, now)
        elif register == reg.USER_CTRL:
            # FIFO_RESET works only while FIFO_EN is 0.
            if value & reg.USER_FIFO_RESET and not value & reg.USER_FIFO_EN:
                self._fifo.clear()
            if value & reg.USER_SIG_COND_RESET:
                self._clear_outputs()
            self.registers[register] = value & 0xF0  # the reset bits clear themselves
        elif register == reg.SIGNAL_PATH_RESET:
            self._clear_outputs()
        elif register == reg.FIFO_R_W:
            self._push(bytes([value]))
        else:
            self.registers[register] = value
            if register in (reg.SMPLRT_DIV, reg.CONFIG):
                self._next_sample = now + self.period

    def _write_power(self, value: int, now: int) -> None:
        if value & reg.PWR_DEVICE_RESET:
            self._power_up(now)
            self._busy_until = now + _RESET_TIME
            return
        was_asleep = self.registers[reg.PWR_MGMT_1] & reg.PWR_SLEEP
        self.registers[reg.PWR_MGMT_1] = value
        if was_asleep and not value & reg.PWR_SLEEP:
            self._awake_since = now
            self._next_sample = now + self.period

    def _clear_outputs(self) -> None:
        self.registers[reg.ACCEL_XOUT_H : reg.GYRO_XOUT_H + 6] = bytes(14)

    def _advance(self, now: int) -> None:
        if self.registers[reg.PWR_MGMT_1] & reg.PWR_SLEEP or now < self._next_sample:
            return
        due = int((now - self._next_sample) // self.period) + 1
        made = min(due, _BACKLOG)
        times = self._next_sample + self.period * np.arange(due - made, due)
        self._next_sample += due * self.period
        self.samples += due
        self.sample_times = [*self.sample_times, *times.astype(np.int64).tolist()][-_BACKLOG:]
        if self.frozen:
            rows = [bytes(self.registers[reg.ACCEL_XOUT_H : reg.GYRO_XOUT_H + 6])] * made
        else:
            rows = [row.tobytes() for row in self._measure(times)]
        enabled = self.registers[reg.INT_ENABLE]
        self.registers[reg.INT_STATUS] |= enabled & reg.INT_DATA_READY
        if due > made:
            self._overflow()
        for row in rows:
            self._push(self._frame(row))
        self.registers[reg.ACCEL_XOUT_H : reg.GYRO_XOUT_H + 6] = rows[-1]

    def _measure(self, times: np.ndarray) -> np.ndarray:
        """Return (n, 7) big-endian counts of the samples at `times` (ns)."""
        setting = self._filter
        # The low-pass shows what was `delay` ago.
        seconds = np.maximum((times - self._start) / _SECOND - reg.GYRO_DELAYS[setting], 0.0)
        truth = self._motion(seconds)
        n = len(times)
        gyro_sigma = self._gyro_noise * math.sqrt(reg.NOISE_BANDWIDTH * reg.BANDWIDTHS[setting])
        accel_sigma = self._accel_noise * math.sqrt(reg.NOISE_BANDWIDTH * reg.ACCEL_BANDWIDTHS[setting])
        gyro = truth.rate + self.gyro_bias + gyro_sigma * self._rng.standard_normal((n, 3))
        accel = truth.force + self.accel_bias + accel_sigma * self._rng.standard_normal((n, 3))
        gyro[times < self._awake_since + reg.GYRO_START_UP * _SECOND] = 0.0
        gyro_scale = reg.GYRO_COUNTS[self.registers[reg.GYRO_CONFIG] >> 3 & 3] / reg.DEGREE
        accel_scale = reg.ACCEL_COUNTS[self.registers[reg.ACCEL_CONFIG] >> 3 & 3] / reg.STANDARD_GRAVITY
        celsius = np.full((n, 1), (self.temperature - reg.TEMPERATURE_OFFSET) * reg.TEMPERATURE_COUNTS)
        counts = np.rint(np.hstack([accel * accel_scale, celsius, gyro * gyro_scale]))
        standby = self.registers[reg.PWR_MGMT_2]
        for bit, column in zip((5, 4, 3, 2, 1, 0), (0, 1, 2, 4, 5, 6)):
            if standby >> bit & 1:
                counts[:, column] = 0.0
        return np.clip(counts, -32768, 32767).astype('>i2')

    def _frame(self, row: bytes) -> bytes:
        """Return what FIFO_EN selects of one sample, in the order of the register numbers."""
        selected = self.registers[reg.FIFO_EN]
        parts = []
        if selected & reg.FIFO_ACCEL:
            parts.append(row[0:6])
        if selected & reg.FIFO_TEMP:
            parts.append(row[6:8])
        parts += [row[8 + 2 * axis : 10 + 2 * axis] for axis in range(3) if selected >> (6 - axis) & 1]
        return b''.join(parts)

    def _push(self, data: bytes) -> None:
        if not self.registers[reg.USER_CTRL] & reg.USER_FIFO_EN or not data:
            return
        self._fifo += data
        if len(self._fifo) > reg.FIFO_SIZE:
            # The oldest bytes are lost, not the oldest frames: what is left starts anywhere in a frame.
            del self._fifo[: len(self._fifo) - reg.FIFO_SIZE]
            self._overflow()

    def _overflow(self) -> None:
        if self.registers[reg.USER_CTRL] & reg.USER_FIFO_EN:
            self.registers[reg.INT_STATUS] |= self.registers[reg.INT_ENABLE] & reg.INT_FIFO_OVERFLOW


def moving_chip_bus(address: int, motion: str, seed: int, clock: Callable[[], int]) -> FakeBus:
    """Return a bus with one chip that is moved as the simulator moves its sensor, after 5 s of rest.

    Its gyro has a bias of 1 °/s 1 sigma and its clock is off by 1 % 1 sigma, both by `seed`.
    """
    params = SimulatorParams(motion=motion, initial_rest=5.0)
    rng = np.random.default_rng(seed)
    bias = reg.DEGREE * rng.standard_normal(3)
    chip = FakeMpu6050(
        TruthModel(params, rng),
        start=clock(),
        seed=seed,
        clock_error=0.01 * float(rng.standard_normal()),
        gyro_bias=(float(bias[0]), float(bias[1]), float(bias[2])),
    )
    return FakeBus({address: chip}, clock)
