# SPDX-License-Identifier: Apache-2.0
"""A PCA9685 by its register map, for a fake_bus.FakeBus: sleep, restart, prescaler, sixteen channels.

Not modelled: sub-addresses, the all-call address, external clock and the OE pin.
"""

from __future__ import annotations

import errno

from quad_control import pca9685 as chip

_CHANNELS = 16
_LED_END = chip.LED0_ON_L + chip.REGISTERS_PER_CHANNEL * _CHANNELS
_ALL_LED = 0xFA
_OSCILLATOR_START = 500_000  # ns


class FakePca9685:
    """A chip on a FakeBus; `oscillator` (Hz) is what its clock really does."""

    def __init__(self, *, oscillator: float = chip.OSCILLATOR) -> None:
        self._oscillator = oscillator
        self._power_up()

    def _power_up(self) -> None:
        self.registers = bytearray(256)
        self.registers[chip.MODE1] = 0x11
        self.registers[chip.MODE2] = 0x04
        self.registers[2:6] = bytes([0xE2, 0xE4, 0xE8, 0xE0])
        self.registers[chip.PRE_SCALE] = 0x1E
        for channel in range(_CHANNELS):
            self.registers[chip.LED0_ON_L + 4 * channel + 3] = chip.FULL_OFF
        self._awake_since: int | None = None
        self._held = False

    def brown_out(self) -> None:
        """Lose power for a moment: everything is as after power-up."""
        self._power_up()

    def pulse(self, channel: int, now: int) -> float | None:
        """Return the pulse width (µs) on `channel` at `now` (ns), None when there is none."""
        running = self._awake_since is not None and now >= self._awake_since + _OSCILLATOR_START
        if not running or self._held:
            return None
        base = chip.LED0_ON_L + 4 * channel
        on_low, on_high, off_low, off_high = self.registers[base : base + 4]
        if off_high & 0x10:
            return None
        period = chip.COUNTS * (self.registers[chip.PRE_SCALE] + 1) / self._oscillator * 1e6
        if on_high & 0x10:
            return period
        on, off = on_low | (on_high & 15) << 8, off_low | (off_high & 15) << 8
        return (off - on) % chip.COUNTS * period / chip.COUNTS

    def read(self, register: int, count: int, now: int) -> bytes:
        """See fake_bus.FakeDevice."""
        out = bytearray()
        for _ in range(count):
            _acknowledge(register)
            # The all-LED registers read as zero.
            out.append(0 if _ALL_LED <= register < chip.PRE_SCALE else self.registers[register])
            register = self._next(register)
        return bytes(out)

    def write(self, register: int, data: bytes, now: int) -> None:
        """See fake_bus.FakeDevice."""
        for value in data:
            _acknowledge(register)
            self._write_byte(register, value, now)
            register = self._next(register)

    def _next(self, register: int) -> int:
        if not self.registers[chip.MODE1] & chip.MODE1_AUTO_INCREMENT:
            return register
        if register == _LED_END - 1:
            return chip.MODE1
        return _ALL_LED if register == chip.PRE_SCALE else register + 1

    def _write_byte(self, register: int, value: int, now: int) -> None:
        asleep = self.registers[chip.MODE1] & chip.MODE1_SLEEP
        if register == chip.MODE1:
            self._write_mode1(value, now)
        elif register == chip.PRE_SCALE:
            if asleep:
                self.registers[register] = max(value, 3)
        elif _ALL_LED <= register < chip.PRE_SCALE:
            self._held = False
            for channel in range(_CHANNELS):
                self.registers[chip.LED0_ON_L + 4 * channel + register - _ALL_LED] = value & 0x1F
        else:
            self.registers[register] = value
            if chip.LED0_ON_L <= register < _LED_END:
                # A write to a channel ends the hold of a restart.
                self._held = False
                self.registers[chip.MODE1] &= ~chip.MODE1_RESTART & 0xFF

    def _write_mode1(self, value: int, now: int) -> None:
        was_asleep = self.registers[chip.MODE1] & chip.MODE1_SLEEP
        restart = self.registers[chip.MODE1] & chip.MODE1_RESTART
        asleep = value & chip.MODE1_SLEEP
        if asleep and not was_asleep:
            active = any(not self.registers[chip.LED0_ON_L + 4 * c + 3] & 0x10 for c in range(_CHANNELS))
            # Sleeping with pulses running holds them until a restart is asked for.
            restart, self._held = (chip.MODE1_RESTART, True) if active else (0, False)
            self._awake_since = None
        if not asleep and was_asleep:
            self._awake_since = now
        if value & chip.MODE1_RESTART and not asleep and restart:
            restart, self._held = 0, False
        self.registers[chip.MODE1] = value & 0x7F | restart


def _acknowledge(register: int) -> None:
    if _LED_END <= register < _ALL_LED:
        raise OSError(errno.EREMOTEIO, 'reserved register')
