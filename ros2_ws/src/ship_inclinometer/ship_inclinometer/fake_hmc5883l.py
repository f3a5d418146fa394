# SPDX-License-Identifier: Apache-2.0
"""An HMC5883L by its register map, for a FakeBus: modes, gain, averaging, self-test, lock, overflow."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ship_inclinometer import hmc5883l as chip
from ship_inclinometer.hmc5883l_params import GAINS

_SECOND = 1_000_000_000
_RATES = (0.75, 1.5, 3.0, 7.5, 15.0, 30.0, 75.0, 75.0)  # Hz by DO bits; 7 is reserved
_COIL = np.array([1.16, 1.16, 1.08])  # gauss that the self-test coil adds
_RESET = {chip.CONFIG_A: 0x10, chip.CONFIG_B: 0x20, chip.MODE: 0x01}
_RANGE = 2047  # counts of the converter


class FakeHmc5883l:
    """A chip on a FakeBus; `field(seconds)` gives the field (3,) in chip axes (T), s since `start` (ns)."""

    def __init__(
        self,
        field: Callable[[float], np.ndarray],
        *,
        start: int = 0,
        seed: int = 0,
        identity: bytes = chip.IDENTITY,
        noise: float = 0.2e-6,
        coil: float = 1.0,
    ) -> None:
        """`noise`: 1 sigma of one reading (T); `coil`: self-test field as a share of what it should be."""
        self._field = field
        self._start = start
        self._rng = np.random.default_rng(seed)
        self._identity = identity
        self._noise = noise
        self._coil = coil
        self.frozen = False
        self.measured_at: list[int] = []
        self._power_up()

    def _power_up(self) -> None:
        self.registers = bytearray(13)
        for register, value in _RESET.items():
            self.registers[register] = value
        self.registers[chip.IDENTIFICATION :] = self._identity
        self._gain = 1
        self._due: int | None = None
        self._unread: set[int] = set()
        self._locked = False

    def brown_out(self) -> None:
        """Lose power for a moment: everything is as after power-up."""
        self._power_up()

    def read(self, register: int, count: int, now: int) -> bytes:
        """See fake_bus.FakeDevice."""
        self._advance(now)
        out = bytearray()
        for _ in range(count):
            out.append(self._read_byte(register))
            register = _next(register)
        return bytes(out)

    def write(self, register: int, data: bytes, now: int) -> None:
        """See fake_bus.FakeDevice."""
        self._advance(now)
        for value in data:
            if register <= chip.MODE:
                self.registers[register] = value
                if register in (chip.CONFIG_A, chip.MODE):
                    self._locked = False
                if register == chip.MODE:
                    self._start_mode(now)
            register = _next(register)

    def _read_byte(self, register: int) -> int:
        if chip.DATA <= register < chip.STATUS:
            self._unread.discard(register)
            # Some but not all read: the registers are held until the rest is read.
            self._locked = bool(self._unread) and len(self._unread) < 6
        elif register == chip.MODE:
            self._locked = True
        elif register == chip.STATUS:
            return self.registers[chip.STATUS] & ~chip.STATUS_LOCK | (chip.STATUS_LOCK * self._locked)
        return self.registers[register] if register < len(self.registers) else 0

    def _start_mode(self, now: int) -> None:
        mode = self.registers[chip.MODE] & 3
        self._due = now + int(chip.MEASUREMENT_TIME * _SECOND) if mode <= chip.MODE_SINGLE else None

    def _advance(self, now: int) -> None:
        while self._due is not None and now >= self._due:
            if not self._locked:
                self._measure(self._due)
            if self.registers[chip.MODE] & 3 == chip.MODE_SINGLE:
                self.registers[chip.MODE] |= 2  # idle
                self._due = None
            else:
                self._due += int(_SECOND / _RATES[self.registers[chip.CONFIG_A] >> 2 & 7])

    def _measure(self, done: int) -> None:
        config = self.registers[chip.CONFIG_A]
        middle = done - int(0.5 * chip.MEASUREMENT_TIME * _SECOND)
        self.measured_at = [*self.measured_at, middle][-1000:]
        if self.frozen:
            return
        sigma = self._noise / math.sqrt(1 << (config >> 5 & 3)) / chip.TESLA_PER_GAUSS
        sign = {0: 0.0, 1: 1.0, 2: -1.0, 3: 0.0}[config & 3]
        if sign:
            # The external field is measured before and taken off.
            gauss = sign * self._coil * _COIL
        else:
            gauss = np.asarray(self._field((middle - self._start) / _SECOND)) / chip.TESLA_PER_GAUSS
        counts = np.rint((gauss + sigma * self._rng.standard_normal(3)) * GAINS[self._gain])
        counts[np.abs(counts) > _RANGE] = chip.OVERFLOW
        # A new gain holds from the measurement after the next.
        self._gain = self.registers[chip.CONFIG_B] >> 5
        self.registers[chip.DATA : chip.STATUS] = counts[[0, 2, 1]].astype('>i2').tobytes()
        self.registers[chip.STATUS] |= chip.STATUS_READY
        self._unread = set(range(chip.DATA, chip.STATUS))


def _next(register: int) -> int:
    """Return where the address pointer goes: data registers are read round and round."""
    if register == chip.STATUS - 1:
        return chip.DATA
    return 0 if register >= chip.IDENTIFICATION + 2 else register + 1
