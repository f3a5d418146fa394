# SPDX-License-Identifier: Apache-2.0
"""HMC5883L driver without ROS: triggered measurements, self-test, growing range, patience after bus faults.

The chip measures only when asked (single-measurement mode). In continuous mode its ready bit stays set, so
that a new measurement cannot be told from an old one without the interrupt line; asked for, each measurement
is new and its time is known.

Source: Honeywell, "HMC5883L 3-Axis Digital Compass IC", revision E (2013).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from imu_kalman.i2c import ChipDriver, I2cDevice, WrongChipError, driven, explain
from ship_inclinometer.hmc5883l_params import AVERAGES, GAINS, RANGES, Hmc5883lParams

ADDRESS = 0x1E
CONFIG_A = 0x00
CONFIG_B = 0x01
MODE = 0x02
DATA = 0x03
STATUS = 0x09
IDENTIFICATION = 0x0A
IDENTITY = b'H43'
MODE_SINGLE = 0x01
STATUS_READY = 0x01
STATUS_LOCK = 0x02
POSITIVE_BIAS = 0x01
OVERFLOW = -4096
MEASUREMENT_TIME = 6e-3  # s
TESLA_PER_GAUSS = 1e-4

_SECOND = 1_000_000_000
# 160 measurements a second are promised: after this time (s) one is done.
_WAIT = 6.5e-3
_SELF_TEST_GAIN = 5
# Limits of the self-test at that gain (counts); the coil makes about 1.16, 1.16 and 1.08 gauss.
_SELF_TEST_LIMITS = (243, 575)
_SELF_TEST_AVERAGES = 3  # bits of CONFIG_A for eight
_CHECK_PERIOD = 1.0  # s
_SILENCE = 0.5  # s
# Noise of two counts makes equal triples rare: so many in a row mean a hung chip.
_FROZEN_SAMPLES = 50
_MAX_RANGE = len(RANGES) - 1
# Counts of the converter; what is outside and no overflow was never measured.
_LOWEST_COUNT, _HIGHEST_COUNT = -2048, 2047
# Polls of one measurement, and limits of the pause between them (s): a reading is a few milliseconds old when
# it is told, and at a low rate the processor is left alone.
_POLLS, _SHORTEST_POLL, _LONGEST_POLL = 4.0, 2e-3, 5e-3
_IDENTITY_READS = 3


class SelfTestError(Exception):
    """The built-in coil is not measured as it should be: the chip is broken."""


class MagReading(NamedTuple):
    """One measurement: stamp (ns) of its middle and field (3,) in the body frame (T)."""

    stamp: int
    field: np.ndarray


class Hmc5883lDriver(ChipDriver[Hmc5883lParams]):
    """Reads an HMC5883L for as long as it lives; `poll` is called every `poll_period` and never blocks."""

    def _address(self) -> int:
        return ADDRESS

    def _begin(self) -> None:
        params = self._params
        self._gain = RANGES.index(params.range)
        self._identified = False
        self._tested = not params.self_test
        self.self_test_counts: tuple[int, int, int] | None = None
        self._step: Callable[[I2cDevice, int], list[MagReading]] = self._identify
        self._not_before: int | None = None
        self._triggered = 0
        # By the steady clock (ns): when the measurement under way was asked for, None when there is none, and
        # when the present and the last one were due.
        self._asked: int | None = None
        self._due = 0
        # The measurement after a change of gain is still made with the gain before.
        self._old_gain = True
        self._last_reading = 0
        self._next_check = 0
        self._previous = b''
        self._equal = 0
        self.readings = 0
        self.overflows = 0
        self._overflowing = False
        self._reported_overflows = 0

    @property
    def poll_period(self) -> float:
        """Time between two polls (s)."""
        return min(max(1.0 / (_POLLS * self._params.rate), _SHORTEST_POLL), _LONGEST_POLL)

    @property
    def running(self) -> bool:
        """True while measurements come."""
        return self._step == self._run

    @property
    def variance(self) -> float:
        """Variance per axis of a reading (T²): noise of the averaged readings, and rounding."""
        step = TESLA_PER_GAUSS / GAINS[self._gain]
        return self._params.noise**2 / self._params.averages + step**2 / 12.0

    def poll(self) -> list[MagReading]:
        """Do what is due; return the new reading, if there is one.

        Raise WrongChipError or SelfTestError when, at the first contact, the chip is not what it should be.
        """
        now = self._steady()
        if self._not_before is not None and now < self._not_before:
            return []
        self._not_before = None
        try:
            device = self.link.device(now)
            return [] if device is None else self._step(device, now)
        except OSError as error:
            self.link.failed(self._steady(), explain(error))
            self._step = self._identify
            return []

    def close(self) -> None:
        """Release the bus."""
        self.link.close()

    def diagnostics(self) -> dict[str, Any]:
        """Return what /diagnostics says; 'level' is 0 (ok), 1 (warning) or 2 (error)."""
        link = self.link
        fresh = self.overflows - self._reported_overflows
        self._reported_overflows = self.overflows
        silent = (self._steady() - self._last_reading) * 1e-9
        if self.running and self._overflowing and self._gain == _MAX_RANGE:
            level, message = 2, f'out of range: field over {RANGES[_MAX_RANGE]} gauss, nothing is published'
        elif self.running and silent > max(_SILENCE, 3.0 / self._params.rate):
            level, message = 1, f'no reading for {silent:.1f} s'
        elif self.running and fresh:
            level, message = 1, f'overflow: the range is {RANGES[self._gain]} gauss now'
        elif self.running:
            level, message = 0, 'ok'
        elif link.last_fault:
            level, message = 2, f'no samples: {link.last_fault}'
        else:
            level, message = 1, 'starting'
        values: dict[str, Any] = {
            'level': level,
            'message': message,
            'readings': self.readings,
            'range_gauss': RANGES[self._gain],
            'overflows': self.overflows,
            'self_test_counts': self.self_test_counts or 'not done',
            'repeated_transfers': link.retried,
            'reconnects': link.reconnects,
        }
        return values | {f'fault: {reason}': count for reason, count in sorted(link.faults.items())}

    def _identify(self, device: I2cDevice, now: int) -> list[MagReading]:
        identity = device.read(IDENTIFICATION, 3)
        if identity != IDENTITY:
            repeated = all(device.read(IDENTIFICATION, 3) == identity for _ in range(_IDENTITY_READS - 1))
            text = f'identification is {identity.hex(" ")}, expected {IDENTITY.hex(" ")} (HMC5883L)'
            answered = identity not in (b'\x00\x00\x00', b'\xff\xff\xff')
            if repeated and answered and not self._identified:
                raise WrongChipError(f'at address 0x{ADDRESS:02x} {text}')
            raise OSError(text)
        self._identified = True
        if self._tested:
            self._set_up(device, now)
        else:
            device.write(CONFIG_A, _SELF_TEST_AVERAGES << 5 | POSITIVE_BIAS, _SELF_TEST_GAIN << 5)
            self._trigger(device)
            self._old_gain = True
            self._step = self._finish_self_test
        return []

    def _set_up(self, device: I2cDevice, now: int) -> None:
        device.write(CONFIG_A, *self._settings())
        self._check_settings(device)
        self._trigger(device)
        self._old_gain = True
        self._due = now
        # Setting up anew after a fault is no reading.
        self._last_reading = self._last_reading or now
        self._next_check = now + int(_CHECK_PERIOD * _SECOND)
        self._equal = 0
        self._overflowing = False
        self._step = self._run

    def _settings(self) -> tuple[int, int]:
        return AVERAGES.index(self._params.averages) << 5, self._gain << 5

    def _check_settings(self, device: I2cDevice) -> None:
        # The mode register is not read: that would lock the data registers.
        if tuple(device.read(CONFIG_A, 2)) != self._settings():
            raise OSError('the chip lost its settings: power dip?')

    def _trigger(self, device: I2cDevice) -> None:
        device.write(MODE, MODE_SINGLE)
        self._triggered = self._clock()
        self._asked = self._steady()
        self._not_before = self._asked + int(_WAIT * _SECOND)

    def _trigger_in_time(self, device: I2cDevice, now: int) -> None:
        """Ask for the next measurement when it is due; what is late does not put off those after it."""
        period = round(_SECOND / self._params.rate)
        self._due = max(self._due + period, now - period)
        if self._due <= now:
            self._trigger(device)
        else:
            self._asked, self._not_before = None, self._due

    def _fetch(self, device: I2cDevice) -> bytes | None:
        """Return the six data bytes of the measurement asked for, None while it is not ready."""
        if not driven(device.read(STATUS))[0] & STATUS_READY:
            return None
        # All six in one go: a part of them would lock the registers.
        return driven(device.read(DATA, 6))

    def _finish_self_test(self, device: I2cDevice, now: int) -> list[MagReading]:
        data = self._fetch(device)
        if data is None:
            raise OSError('no measurement in the self-test')
        old_gain, self._old_gain = self._old_gain, False
        if old_gain:
            self._trigger(device)
            return []
        x, z, y = np.frombuffer(data, '>i2').tolist()
        self.self_test_counts = (x, y, z)
        low, high = _SELF_TEST_LIMITS
        if not all(low <= value <= high for value in (x, y, z)):
            raise SelfTestError(
                f'self-test reads {x}, {y}, {z} counts, expected {low} to {high} on each axis'
            )
        self._tested = True
        self._set_up(device, now)
        return []

    def _run(self, device: I2cDevice, now: int) -> list[MagReading]:
        if self._asked is None:
            self._trigger(device)
            return []
        data = self._fetch(device)
        if data is None:
            if (now - self._asked) * 1e-9 > _SILENCE:
                self._check_settings(device)
                raise OSError('no measurement becomes ready')
            return []
        if now >= self._next_check:
            self._check_settings(device)
            self._next_check = now + int(_CHECK_PERIOD * _SECOND)
        measured_at = self._triggered + int(0.5 * MEASUREMENT_TIME * _SECOND)
        gain = GAINS[self._gain]
        x, z, y = np.frombuffer(data, '>i2').tolist()
        overflow = OVERFLOW in (x, y, z)
        if not overflow and not all(_LOWEST_COUNT <= value <= _HIGHEST_COUNT for value in (x, y, z)):
            raise OSError(f'{x}, {y}, {z} counts are more than the converter has')
        old_gain, self._old_gain = self._old_gain, False
        if overflow and not old_gain:
            self._overflowing = True
            self._enlarge_range(device)
        if old_gain or self._old_gain:
            # Nothing to tell: the next one is not waited for.
            self._trigger(device)
            return []
        self._trigger_in_time(device, now)
        if overflow:
            return []
        self._overflowing = False
        self._watch_frozen(data)
        self.link.works()
        self._last_reading = now
        self.readings += 1
        return [MagReading(measured_at, self._rotation @ (np.array([x, y, z]) * (TESLA_PER_GAUSS / gain)))]

    def _enlarge_range(self, device: I2cDevice) -> None:
        self.overflows += 1
        if self._gain < _MAX_RANGE:
            self._gain += 1
            device.write(CONFIG_B, self._gain << 5)
            self._old_gain = True

    def _watch_frozen(self, data: bytes) -> None:
        self._equal = self._equal + 1 if data == self._previous else 0
        self._previous = data
        if self._equal >= _FROZEN_SAMPLES:
            self._equal = 0
            raise OSError('frozen: the same values again and again')
