# SPDX-License-Identifier: Apache-2.0
"""An I2C bus that exists only here, with chips that behave by their register maps, and with faults at will.

A chip is anything with `read` and `write` as in FakeDevice: other packages add theirs to the same bus. Time
is given from outside, so that tests need no sleep and a node may run in real time.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Protocol

import numpy as np

_BIT_TIME = 2500  # ns, fast mode: 400 kbit/s


class FakeDevice(Protocol):
    """A chip on the fake bus. `now` is the time (ns) of the transfer; OSError(ENXIO) is "no acknowledge"."""

    def read(self, register: int, count: int, now: int) -> bytes:
        """Return `count` bytes from `register` on, with the side effects that reading has."""

    def write(self, register: int, data: bytes, now: int) -> None:
        """Take `data` from `register` on."""


class ManualClock:
    """Time (ns) that passes only when told."""

    def __init__(self, now: int = 1_700_000_000_000_000_000) -> None:
        self.now = now

    def __call__(self) -> int:
        """Return the time (ns)."""
        return self.now

    def advance(self, nanoseconds: float) -> None:
        """Let time pass."""
        self.now += int(nanoseconds)


class FakeBus:
    """A bus with chips by 7-bit address, and its faults.

    `stuck`: a line is held low, every transfer times out. `absent`: addresses that do not answer.
    `floating`: reads return only ones (nothing drives the data line). `error_rate`: share of transfers that
    are not acknowledged, by `seed`.
    """

    def __init__(
        self,
        devices: dict[int, FakeDevice],
        clock: Callable[[], int],
        *,
        spend: Callable[[int], None] | None = None,
        seed: int = 0,
    ) -> None:
        """`spend` is told the nanoseconds that each transfer takes at 400 kbit/s."""
        self.devices = devices
        self._clock = clock
        self._spend = spend
        self._rng = np.random.default_rng(seed)
        self._open = True
        self.transfers = 0
        self.clear_faults()

    def open(self) -> FakeBus:
        """Open the bus (again), as a driver does; a stuck bus opens all the same, as on Linux."""
        self._open = True
        return self

    def close(self) -> None:
        """Close the bus: transfers then fail with EBADF."""
        self._open = False

    def clear_faults(self) -> None:
        """Let everything work again."""
        self._failures: list[tuple[int, int | None]] = []
        self._short = 0
        self.stuck = False
        self.floating = False
        self.absent: set[int] = set()
        self.error_rate = 0.0

    def fail_next(self, count: int, code: int = errno.EREMOTEIO, after_bytes: int | None = None) -> None:
        """Let the next `count` transfers fail; with `after_bytes` a read has its effect up to there."""
        self._failures += [(code, after_bytes)] * count

    def shorten_next(self, count: int) -> None:
        """Let the next `count` reads return a byte less than asked for."""
        self._short += count

    def read(self, address: int, register: int, count: int) -> bytes:
        """See i2c.I2cBus."""
        device = self._begin(address, 4 + count)
        if self._failures:
            code, after_bytes = self._failures.pop(0)
            if after_bytes:
                device.read(register, min(after_bytes, count), self._clock())
            raise OSError(code, 'injected')
        data = device.read(register, count, self._clock())
        if self.floating:
            return b'\xff' * count
        if self._short:
            self._short -= 1
            return data[:-1]
        return data

    def write(self, address: int, register: int, data: bytes) -> None:
        """See i2c.I2cBus."""
        device = self._begin(address, 2 + len(data))
        if self._failures:
            raise OSError(self._failures.pop(0)[0], 'injected')
        device.write(register, data, self._clock())

    def _begin(self, address: int, length: int) -> FakeDevice:
        self.transfers += 1
        if not self._open:
            raise OSError(errno.EBADF, 'bus is closed')
        if self._spend is not None:
            self._spend(9 * length * _BIT_TIME)
        if self.stuck:
            raise OSError(errno.ETIMEDOUT, 'line held low')
        if address not in self.devices or address in self.absent:
            raise OSError(errno.EREMOTEIO, 'no acknowledge')
        if self.error_rate > 0.0 and self._rng.random() < self.error_rate:
            raise OSError(errno.EREMOTEIO, 'disturbed')
        return self.devices[address]
