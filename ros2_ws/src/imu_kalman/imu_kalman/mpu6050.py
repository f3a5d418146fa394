# SPDX-License-Identifier: Apache-2.0
"""MPU6050 driver without ROS: brings the chip up, reads it, dates its samples, and gets over bus faults.

`Mpu6050Driver.poll` is called at a steady pace and never blocks: what has to wait (reset, start-up, the
pause after a fault) is waited for over several calls. No bus fault ends it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from imu_kalman import mpu6050_registers as reg
from imu_kalman.i2c import ChipDriver, I2cDevice, WrongChipError, driven, explain
from imu_kalman.mpu6050_calibration import Calibration, Refused, RestWindow
from imu_kalman.mpu6050_params import Mpu6050Params
from imu_kalman.stamp_filter import StampFilter

_SECOND = 1_000_000_000
_RESET_TIME = 0.1  # s, register map 4.28 and PS: 100 ms cover reset and power-up
_START_UP = 0.05  # s, the gyro needs 30 ms (PS 6.1)
# No sample for this many periods, and this long (s), means that the chip has stopped.
_SILENCE_PERIODS = 20
_SILENCE_TIME = 0.25
# Noise never repeats all six values: so many equal samples in a row mean a hung chip.
_FROZEN_SAMPLES = 100
_FULL_SCALE = 32767  # counts: what reads so is at least so
_MOTION_COLUMNS = (0, 1, 2, 4, 5, 6)  # of a frame: all but the temperature
_CHECK_PERIOD = 1.0  # s between two looks at the settings
# One burst on the wire; some adapters refuse long ones.
_BURST_FRAMES = 18
# A chip that is read 3 times as another one is another one; a bus fault would not repeat itself so.
_IDENTITY_READS = 3
_LOOK_ALIKES = {0x70: 'MPU6500', 0x71: 'MPU9250', 0x73: 'MPU9255'}
# What a bus reads as while nobody drives it, or while a line is held low.
_NO_ANSWER = (0x00, 0xFF)


class ImuReading(NamedTuple):
    """One sample in the body frame: stamp (ns), gyro (3,) rad/s less bias, accel (3,) m/s², °C."""

    stamp: int
    gyro: np.ndarray
    accel: np.ndarray
    temperature: float


class Variances(NamedTuple):
    """Variance per axis of a reading: (rad/s)² and (m/s²)²."""

    gyro: float
    accel: float


def expected_settings(params: Mpu6050Params) -> dict[int, int]:
    """Return the registers that the driver sets, in the order it sets them."""
    return {
        reg.SMPLRT_DIV: params.divider,
        reg.CONFIG: params.filter_setting,
        reg.GYRO_CONFIG: reg.GYRO_RANGES.index(params.gyro_range) << 3,
        reg.ACCEL_CONFIG: reg.ACCEL_RANGES.index(params.accel_range) << 3,
        reg.INT_ENABLE: reg.INT_DATA_READY | reg.INT_FIFO_OVERFLOW,
        reg.FIFO_EN: _fifo_sources(params),
    }


def _fifo_sources(params: Mpu6050Params) -> int:
    return reg.FIFO_TEMP | reg.FIFO_GYRO | reg.FIFO_ACCEL if params.pacing == 'fifo' else 0


class Mpu6050Driver(ChipDriver[Mpu6050Params]):
    """Reads an MPU6050 for as long as it lives."""

    def _address(self) -> int:
        return self._params.address

    def _begin(self) -> None:
        params = self._params
        self._gyro_scale = reg.DEGREE / reg.GYRO_COUNTS[reg.GYRO_RANGES.index(params.gyro_range)]
        self._accel_scale = (
            reg.STANDARD_GRAVITY / reg.ACCEL_COUNTS[reg.ACCEL_RANGES.index(params.accel_range)]
        )
        self._period = 1.0 / params.sample_rate
        self._stamps = StampFilter(self._period)
        self._delay = int(reg.GYRO_DELAYS[params.filter_setting] * _SECOND) if params.compensate_delay else 0
        self._rest = RestWindow(
            params.calibration_time,
            params.sample_rate,
            params.still_gyro,
            params.still_accel,
            params.largest_bias,
        )
        self._calibrating = params.calibrate_at_start
        self._bias = np.array(params.gyro_bias)
        # Until a rest was seen only the datasheet's bound is known: uniform within it.
        given = any(params.gyro_bias)
        self._unknown_bias = params.largest_bias**2 / 3.0
        self._bias_variance = 0.0 if given else self._unknown_bias
        self._next_variances: list[float] = []
        self.calibration_message = 'waiting for a rest' if self._calibrating else 'as by parameter'
        self.readings = 0
        self.saturated = 0
        self.overflows = 0
        self._identified = False
        self._step: Callable[[I2cDevice, int], list[ImuReading]] = self._identify
        self._wait_until: int | None = None
        self._last_data = 0
        self._next_check = 0
        self._previous_frame = b''
        self._equal_frames = 0
        self._looked: int | None = None
        self._last_middle: int | None = None

    @property
    def bias(self) -> np.ndarray:
        """Gyro bias (3,) that is subtracted, in the axes of the chip (rad/s)."""
        return self._bias.copy()

    @property
    def running(self) -> bool:
        """True while samples come."""
        return self._step == self._run

    @property
    def variances(self) -> Variances:
        """Noise, rounding and what is not known of the gyro's bias."""
        p = self._params
        setting = p.filter_setting
        gyro = p.gyro_noise**2 * reg.NOISE_BANDWIDTH * reg.BANDWIDTHS[setting]
        accel = p.accel_noise**2 * reg.NOISE_BANDWIDTH * reg.ACCEL_BANDWIDTHS[setting]
        return Variances(
            gyro + self._gyro_scale**2 / 12.0 + self._bias_variance, accel + self._accel_scale**2 / 12.0
        )

    def poll(self) -> list[ImuReading]:
        """Do what is due and return the new readings, oldest first.

        Raise WrongChipError when, at the first contact, another chip answers.
        """
        now = self._steady()
        if self._wait_until is not None and now < self._wait_until:
            return []
        self._wait_until = None
        try:
            device = self.link.device(now)
            return [] if device is None else self._step(device, now)
        except OSError as error:
            self._fault(explain(error))
            return []

    def close(self) -> None:
        """Release the bus."""
        self.link.close()

    def calibrate(self) -> Calibration | Refused:
        """Take the gyro bias from the last `calibration_time` seconds, unless they were no rest."""
        result = self._rest.calibrate() if self.running else Refused('no samples: see diagnostics')
        if isinstance(result, Refused):
            if self._calibrating:
                self.calibration_message = result.reason
            return result
        self._bias = result.bias
        # Who listens sees from the drop of the variance that what it learned of the bias is void.
        self._next_variances = [self._unknown_bias, result.variance]
        self._calibrating = False
        self.calibration_message = 'calibrated at rest'
        return result

    def diagnostics(self) -> dict[str, Any]:
        """Return what /diagnostics says; 'level' is 0 (ok), 1 (warning) or 2 (error)."""
        link = self.link
        if not self.running and not link.last_fault:
            level, message = 1, 'starting'
        elif not self.running:
            level, message = 2, f'no samples: {link.last_fault}'
        elif self._calibrating:
            level, message = 1, f'gyro bias unknown: {self.calibration_message}'
        else:
            level, message = 0, 'ok'
        values: dict[str, Any] = {
            'level': level,
            'message': message,
            'readings': self.readings,
            'sample_period_s': self._stamps.period,
            'stamp_sigma_s': self._stamps.sigma,
            'stamp_restarts': self._stamps.restarts,
            'saturated': self.saturated,
            'fifo_overflows': self.overflows,
            'repeated_transfers': link.retried,
            'reconnects': link.reconnects,
            'calibration': self.calibration_message,
            'gyro_bias_rad_s': ' '.join(f'{b:.5f}' for b in self._bias),
        }
        return values | {f'fault: {reason}': count for reason, count in sorted(link.faults.items())}

    def _fault(self, reason: str) -> None:
        self.link.failed(self._steady(), reason)
        self._step = self._identify
        self._wait_until = None

    def _then(self, step: Callable[[I2cDevice, int], list[ImuReading]], wait: float) -> None:
        self._step = step
        self._wait_until = self._steady() + int(wait * _SECOND)

    def _identify(self, device: I2cDevice, now: int) -> list[ImuReading]:
        identity = device.read(reg.WHO_AM_I)[0]
        if identity != reg.IDENTITY:
            repeated = all(device.read(reg.WHO_AM_I)[0] == identity for _ in range(_IDENTITY_READS - 1))
            name = _LOOK_ALIKES.get(identity, 'unknown chip')
            text = f'WHO_AM_I is 0x{identity:02x} ({name}), expected 0x{reg.IDENTITY:02x} (MPU6050)'
            if repeated and not self._identified and identity not in _NO_ANSWER:
                raise WrongChipError(f'at address 0x{self._params.address:02x} {text}')
            raise OSError(text)
        device.write(reg.PWR_MGMT_1, reg.PWR_DEVICE_RESET)
        self._then(self._wake, _RESET_TIME)
        return []

    def _wake(self, device: I2cDevice, now: int) -> list[ImuReading]:
        device.write(reg.PWR_MGMT_1, reg.PWR_CLOCK_GYRO_X)
        self._then(self._set_up, _START_UP)
        return []

    def _set_up(self, device: I2cDevice, now: int) -> list[ImuReading]:
        for register, value in expected_settings(self._params).items():
            device.write(register, value)
        self._check_settings(device)
        self._restart_fifo(device)
        self._rest.clear()
        self._identified = True
        self._last_data = now
        self._next_check = now + int(_CHECK_PERIOD * _SECOND)
        self._equal_frames = 0
        self._step = self._run
        return []

    def _check_settings(self, device: I2cDevice) -> None:
        expected = expected_settings(self._params) | {reg.PWR_MGMT_1: reg.PWR_CLOCK_GYRO_X}
        for register, value in expected.items():
            found = device.read(register)[0]
            if found != value:
                raise OSError(f'register 0x{register:02x} lost its setting: power dip?')

    def _restart_fifo(self, device: I2cDevice) -> None:
        # The FIFO is emptied only while it is switched off.
        device.write(reg.USER_CTRL, reg.USER_FIFO_RESET)
        if self._params.pacing == 'fifo':
            device.write(reg.USER_CTRL, reg.USER_FIFO_EN)
        device.read(reg.INT_STATUS)
        self._stamps.reset()
        self._looked = None
        self._last_middle = None

    def _run(self, device: I2cDevice, now: int) -> list[ImuReading]:
        if now >= self._next_check:
            self._check_settings(device)
            self._next_check = now + int(_CHECK_PERIOD * _SECOND)
        frames, stamps = self._gather(device)
        if not frames:
            silence = (now - self._last_data) * 1e-9
            if silence > max(_SILENCE_TIME, _SILENCE_PERIODS * self._period):
                self._check_settings(device)
                raise OSError('the chip stopped sampling')
            return []
        self._last_data = now
        self._watch_frozen(frames)
        self.link.works()
        return self._convert(frames, stamps)

    def _gather(self, device: I2cDevice) -> tuple[list[bytes], list[int]]:
        fifo = self._params.pacing == 'fifo'
        try:
            return self._read_fifo(device) if fifo else self._read_sample(device)
        except OSError as error:
            self.link.faults[f'reading: {explain(error)}'] += 1
            if fifo:
                # How much of the FIFO the broken transfer took is unknown: only an empty one is aligned.
                self._restart_fifo(device)
            return [], []

    def _read_fifo(self, device: I2cDevice) -> tuple[list[bytes], list[int]]:
        status = driven(device.read_once(reg.INT_STATUS))[0]
        before = self._clock()
        high, low = device.read(reg.FIFO_COUNT_H, 2)
        after = self._clock()
        count = high << 8 | low
        if status & reg.INT_FIFO_OVERFLOW or count >= reg.FIFO_SIZE:
            self.overflows += 1
            self._last_data = self._steady()
            self._restart_fifo(device)
            return [], []
        total = count // reg.FRAME_SIZE
        frames: list[bytes] = []
        while len(frames) < total:
            burst = min(_BURST_FRAMES, total - len(frames))
            data = driven(device.read_once(reg.FIFO_R_W, burst * reg.FRAME_SIZE))
            frames += [data[i : i + reg.FRAME_SIZE] for i in range(0, len(data), reg.FRAME_SIZE)]
        if not frames:
            return [], []
        # The newest sample is younger than one period, else the next one would be there.
        earliest = before - int(self._stamps.period * _SECOND)
        return frames, self._stamps.update(total, earliest, after)

    def _read_sample(self, device: I2cDevice) -> tuple[list[bytes], list[int]]:
        before = self._clock()
        data = driven(device.read_once(reg.INT_STATUS, 1 + reg.FRAME_SIZE))
        after = self._clock()
        looked, self._looked = self._looked, before
        if not data[0] & reg.INT_DATA_READY:
            return [], []
        # It came since the last look, and within the last period, else it would be overwritten.
        earliest = before - int(self._stamps.period * _SECOND)
        if looked is not None:
            earliest = min(max(earliest, looked), before)
        middle = (earliest + after) // 2
        last, self._last_middle = self._last_middle, middle
        # Samples that came and went unseen have their place in time too.
        count = 1 if last is None else max(1, round((middle - last) * 1e-9 / self._stamps.period))
        return [data[1:]], self._stamps.update(count, earliest, after, wanted=1)

    def _watch_frozen(self, frames: list[bytes]) -> None:
        for frame in frames:
            self._equal_frames = self._equal_frames + 1 if frame == self._previous_frame else 0
            self._previous_frame = frame
        if self._equal_frames >= _FROZEN_SAMPLES:
            self._equal_frames = 0
            raise OSError('frozen: the same values again and again')

    def _convert(self, frames: list[bytes], stamps: list[int]) -> list[ImuReading]:
        counts = np.frombuffer(b''.join(frames), dtype='>i2').reshape(-1, 7).astype(float)
        accel = counts[:, :3] * self._accel_scale
        gyro = counts[:, 4:] * self._gyro_scale
        temperature = counts[:, 3] / reg.TEMPERATURE_COUNTS + reg.TEMPERATURE_OFFSET
        for row in range(len(counts)):
            self._rest.add(gyro[row], accel[row])
            if self._calibrating and self._rest.fresh:
                self.calibrate()
        if self._next_variances:
            self._bias_variance = self._next_variances.pop(0)
        self.readings += len(counts)
        self.saturated += int((np.abs(counts[:, _MOTION_COLUMNS]) >= _FULL_SCALE).any(axis=1).sum())
        gyro = (gyro - self._bias) @ self._rotation.T
        accel = accel @ self._rotation.T
        return [
            ImuReading(stamp - self._delay, gyro[i], accel[i], float(temperature[i]))
            for i, stamp in enumerate(stamps)
        ]
