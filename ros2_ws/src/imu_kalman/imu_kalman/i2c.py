# SPDX-License-Identifier: Apache-2.0
"""I2C as drivers need it: a bus protocol, the Linux back end, retries, and patience after faults.

Register access is always "write the register's address, then read or write": one combined transfer with a
repeated start, as every register-mapped chip wants it.
"""

from __future__ import annotations

import errno
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from kalman_core.rotation import matrix_from_quat, quat_from_euler

_SECOND = 1_000_000_000
_ONES = b'\xff'
# Sent again at once this often: a single disturbed transfer is common on long wires.
RETRIES = 2
# Linux documents these codes in Documentation/i2c/fault-codes.rst; adapters differ in which they use.
_EXPLANATIONS = {
    errno.ENXIO: 'no acknowledge: chip absent, unpowered or at another address',
    errno.EREMOTEIO: 'no acknowledge: chip absent, unpowered or at another address',
    errno.ETIMEDOUT: 'time-out: a line is held low',
    errno.EAGAIN: 'arbitration lost: noise or a second master',
    errno.EIO: 'transfer failed',
    errno.ENOENT: 'no such bus{bus}: is I2C switched on?',
    errno.EACCES: "no permission{bus}: is the user in group 'i2c'?",
}


class WrongChipError(Exception):
    """What answers at the address is another chip than the driver's."""


class I2cBus(Protocol):
    """What a driver sees of a bus. Failures are OSError with the kernel's errno."""

    def read(self, address: int, register: int, count: int) -> bytes:
        """Return `count` bytes from `register` on of the chip at 7-bit `address`."""

    def write(self, address: int, register: int, data: bytes) -> None:
        """Write `data` from `register` on."""

    def close(self) -> None:
        """Release the bus."""


def explain(error: OSError) -> str:
    """Return what an I2C error means to someone with a soldering iron."""
    text = _EXPLANATIONS.get(error.errno or 0)
    if text is not None:
        return text.format(bus=f' {error.filename}' if error.filename else '')
    return error.strerror or str(error) or type(error).__name__


def driven(data: bytes) -> bytes:
    """Return `data` unless all of it reads 0xff, which is what a bus reads that nothing drives."""
    if data == _ONES * len(data):
        raise OSError('reads only ones: nothing drives the bus')
    return data


class LinuxI2cBus:
    """A bus of the kernel, by smbus2."""

    def __init__(self, path: str) -> None:
        """`path`: /dev/i2c-N; raise OSError when it cannot be opened."""
        # Imported here: everything else of this module works without smbus2 and off Linux.
        from smbus2 import SMBus, i2c_msg

        self._message = i2c_msg
        self._bus = SMBus(path)

    def read(self, address: int, register: int, count: int) -> bytes:
        """See I2cBus."""
        answer = self._message.read(address, count)
        self._bus.i2c_rdwr(self._message.write(address, [register]), answer)
        return bytes(answer)

    def write(self, address: int, register: int, data: bytes) -> None:
        """See I2cBus."""
        self._bus.i2c_rdwr(self._message.write(address, [register, *data]))

    def close(self) -> None:
        """See I2cBus."""
        self._bus.close()


def is_bus_path(path: str) -> bool:
    """Tell whether `path` names an I2C bus of the kernel."""
    return re.fullmatch(r'/dev/i2c-\d+', path) is not None


class I2cDevice:
    """One chip on a bus: register access with retries and with the length of answers checked."""

    def __init__(self, bus: I2cBus, address: int, retries: int = RETRIES) -> None:
        self._bus = bus
        self._address = address
        self._retries = retries
        self.retried = 0

    def read(self, register: int, count: int = 1) -> bytes:
        """Return `count` bytes; a failed transfer is repeated, so the read must have no side effect."""
        for attempt in range(self._retries + 1):
            try:
                return self.read_once(register, count)
            except OSError:
                if attempt == self._retries:
                    raise
                self.retried += 1
        raise AssertionError('unreachable')

    def read_once(self, register: int, count: int = 1) -> bytes:
        """Return `count` bytes without repeating: for registers that reading changes."""
        data = self._bus.read(self._address, register, count)
        if len(data) != count:
            raise OSError(errno.EIO, f'short read: {len(data)} of {count} bytes')
        return data

    def write(self, register: int, *values: int) -> None:
        """Write `values`; a failed transfer is repeated."""
        for attempt in range(self._retries + 1):
            try:
                self._bus.write(self._address, register, bytes(values))
                return
            except OSError:
                if attempt == self._retries:
                    raise
                self.retried += 1


class Link:
    """Opens a bus and, after a fault, opens it again: first soon, then ever less often.

    `now` is a steady time (ns) throughout.
    """

    def __init__(
        self,
        open_bus: Callable[[], I2cBus],
        address: int,
        *,
        first_delay: float = 0.1,
        longest_delay: float = 5.0,
    ) -> None:
        self._open_bus = open_bus
        self._address = address
        self._first = int(first_delay * _SECOND)
        self._longest = int(longest_delay * _SECOND)
        self._delay = self._first
        self._not_before: int | None = None
        self._bus: I2cBus | None = None
        self._device: I2cDevice | None = None
        self._retried = 0
        self.faults: Counter[str] = Counter()
        self.last_fault = ''
        self.reconnects = 0

    def device(self, now: int) -> I2cDevice | None:
        """Return the chip, opening the bus if need be; None while waiting. Raise OSError as the bus does."""
        if self._device is None:
            if self._not_before is not None and now < self._not_before:
                return None
            self._bus = self._open_bus()
            self._device = I2cDevice(self._bus, self._address)
        return self._device

    def works(self) -> None:
        """Say that the chip delivers: the next fault is answered soon again."""
        if self._not_before is not None:
            self.reconnects += 1
            self._not_before = None
        self._delay = self._first

    def failed(self, now: int, reason: str) -> None:
        """Close the bus and wait before the next attempt, twice as long each time."""
        self.faults[reason] += 1
        self.last_fault = reason
        self._not_before = now + self._delay
        self._delay = min(2 * self._delay, self._longest)
        self.close()

    def close(self) -> None:
        """Release the bus; it may be opened again."""
        if self._device is not None:
            self._retried += self._device.retried
        self._device = None
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.close()
            except OSError as error:
                # The handle is gone either way; only the count tells.
                self.faults[f'close: {explain(error)}'] += 1

    @property
    def retried(self) -> int:
        """Transfers that were repeated since start."""
        return self._retried + (self._device.retried if self._device is not None else 0)


class ChipParams(Protocol):
    """What the parameters of every such driver hold."""

    @property
    def first_delay(self) -> float:
        """Pause (s) after the first fault."""

    @property
    def longest_delay(self) -> float:
        """Longest pause (s)."""

    @property
    def mounting(self) -> tuple[float, ...]:
        """Roll, pitch, yaw (rad) of the chip in the body frame."""


_Params = TypeVar('_Params', bound=ChipParams)


class ChipDriver(ABC, Generic[_Params]):
    """What the drivers of motion sensors share: clocks, the link to the bus, how the chip is mounted.

    `clock` dates the samples (ns), `steady` measures waiting (ns); both may be the same function.
    """

    def __init__(
        self,
        params: _Params,
        open_bus: Callable[[], I2cBus],
        clock: Callable[[], int],
        steady: Callable[[], int] | None = None,
    ) -> None:
        self._params = params
        self._clock = clock
        self._steady = steady or clock
        self.link = Link(
            open_bus,
            self._address(),
            first_delay=params.first_delay,
            longest_delay=params.longest_delay,
        )
        self._rotation = matrix_from_quat(quat_from_euler(*params.mounting))
        self._begin()

    @abstractmethod
    def _address(self) -> int:
        """Return the chip's 7-bit address."""

    @abstractmethod
    def _begin(self) -> None:
        """Set up what is the driver's own."""
