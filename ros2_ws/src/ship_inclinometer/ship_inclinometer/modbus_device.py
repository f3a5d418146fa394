# SPDX-License-Identifier: Apache-2.0
"""The Modbus device behind the wire: PDU in, PDU out.

Order of checks as in the state diagrams of "MODBUS Application Protocol Specification V1.1b3", section 6:
function (01), structure and quantities (03), addresses (02), then the device's own rules. The registers
live in pymodbus's simulator core; the checks stand here because the stock server lets some pass.

Writing is locked. A key in the unlock register opens it for a time; a locked write is answered with 01
("wrong state", section 7). Values are checked before any is applied, and each write is in the event log
before it takes effect: a write that cannot be logged is answered with 04 and changes nothing.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from typing import Protocol

from pymodbus.framer.rtu import FramerRTU
from pymodbus.simulator.simcore import SimCore

from ship_inclinometer import modbus_map as m

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4
READ_BITS, READ_REGISTERS = (1, 2), (3, 4)
WRITES = (5, 6, 15, 16, 22, 23)
SUPPORTED = (*READ_BITS, *READ_REGISTERS, *WRITES)
# Wrong keys in a row, and how long (s) the key is not even looked at afterwards.
_WRONG_KEYS, _PENALTY = 3, 30.0
# Refused writes are logged at most this often (s): a client that retries must not fill the medium.
_REFUSALS_EVERY = 1.0


class Refusal(Exception):
    """A request is answered with an exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Owner(Protocol):
    """What the device asks of the ship's side. `record` returns once the event is on the medium."""

    def record(self, kind: str, who: str, text: str) -> None:
        """Log an event; raise on failure."""

    def command(self, name: str, who: str) -> None:
        """Carry out a coil's command."""

    def changed(self, settings: dict[str, float]) -> None:
        """Take new settings."""

    def save(self, settings: dict[str, float], crc: int) -> None:
        """Write settings to the medium; raise on failure."""


class ModbusDevice:
    """One unit: registers, lock and rules. Used from one event loop only."""

    def __init__(
        self,
        unit: int,
        owner: Owner,
        key: int,
        unlock_time: float = 60.0,
        settings: dict[str, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.unit = unit
        self._owner = owner
        self._key = key
        self._unlock_time = unlock_time
        self._clock = clock
        self._unlocked_until = -math.inf
        self._closed_until = -math.inf
        self._wrong = 0
        self._next_refusal = -math.inf
        self._core = SimCore(m.build_device(unit))
        self.settings = {s.name: s.default for s in m.SETTINGS} | (settings or {})
        self.saved_crc = 0
        self._sequence = 0
        self._discrete = dict.fromkeys(m.DISCRETE, False)
        self._holding = dict.fromkeys(m.HOLDING, 0)

    @property
    def unlocked(self) -> bool:
        """Whether writing is open now."""
        return self._clock() < self._unlocked_until

    async def update(self, values: dict[str, float], discrete: dict[str, bool]) -> None:
        """Replace the input block and the discrete inputs at once."""
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._discrete |= discrete
        self._discrete['unlocked'] = self.unlocked
        bits = [self._discrete[name] for name in m.DISCRETE]
        more, status = divmod(sum(1 << i for i, bit in enumerate(bits) if bit), 1 << 16)
        state = {'sequence': self._sequence, 'status': status, 'status_more': more}
        words = m.input_words({**values, **state})
        await self._core.async_setValues(self.unit, 2, 0, bits)
        await self._core.async_setValues(self.unit, 4, 0, words)

    async def respond(self, pdu: bytes, who: str) -> bytes:
        """Return the answer to a request PDU; never raises for anything that comes from the wire."""
        function = pdu[0]
        try:
            return bytes([function]) + await self._execute(function, pdu[1:], who)
        except Refusal as refusal:
            return bytes([function | 0x80, refusal.code])

    async def _execute(self, function: int, body: bytes, who: str) -> bytes:
        if function not in SUPPORTED:
            raise Refusal(ILLEGAL_FUNCTION)
        if function in READ_BITS:
            return await self._read_bits(function, body)
        if function in READ_REGISTERS:
            return await self._read_registers(function, *_words(body, 2))
        if function == 5:
            return await self._write_coil(body, who)
        if function == 6:
            address, value = _words(body, 2)
            self._write_registers(address, [value], who)
            return body
        if function == 15:
            return self._write_coils(body, who)
        if function == 16:
            return self._write_multiple(body, who)
        if function == 22:
            return self._mask_write(body, who)
        return await self._read_write(body, who)

    async def _read_bits(self, function: int, body: bytes) -> bytes:
        address, count = _words(body, 2)
        _check_count(count, 2000)
        size = len(m.COILS) if function == 1 else len(m.DISCRETE)
        _check_range(address, count, range(size))
        bits = await self._core.async_getValues(self.unit, function, address, count)
        if not isinstance(bits, list):
            raise Refusal(ILLEGAL_ADDRESS)
        packed = bytearray((count + 7) // 8)
        for i, bit in enumerate(bits):
            packed[i // 8] |= bool(bit) << (i % 8)
        return bytes([len(packed)]) + bytes(packed)

    async def _read_registers(self, function: int, address: int, count: int) -> bytes:
        _check_count(count, 125)
        _check_range(address, count, m.HOLDING if function == 3 else range(m.INPUT_COUNT))
        if function == 3:
            self._refresh_holding()
            for a in range(address, address + count):
                await self._core.async_setValues(self.unit, 16, a, [self._holding[a]])
        words = await self._core.async_getValues(self.unit, function, address, count)
        if not isinstance(words, list):
            raise Refusal(ILLEGAL_ADDRESS)
        return bytes([2 * count]) + struct.pack(f'>{count}H', *words)

    def _refresh_holding(self) -> None:
        remaining = max(self._unlocked_until - self._clock(), 0.0)
        self._holding[m.REMAINING] = min(math.ceil(remaining), 0xFFFF)
        self._holding[m.SETTINGS_CRC] = self.saved_crc
        for i, setting in enumerate(m.SETTINGS):
            self._holding[m.FIRST_SETTING + i] = m.setting_to_word(setting, self.settings[setting.name])

    async def _write_coil(self, body: bytes, who: str) -> bytes:
        address, value = _words(body, 2)
        if value not in (0x0000, 0xFF00):
            raise Refusal(ILLEGAL_VALUE)
        _check_range(address, 1, range(len(m.COILS)))
        self._command([m.COILS[address]] if value else [], who)
        return body

    def _write_coils(self, body: bytes, who: str) -> bytes:
        if len(body) < 6:
            raise Refusal(ILLEGAL_VALUE)
        address, count, size = struct.unpack('>HHB', body[:5])
        _check_count(count, 1968)
        if size != (count + 7) // 8 or len(body) != 5 + size:
            raise Refusal(ILLEGAL_VALUE)
        _check_range(address, count, range(len(m.COILS)))
        on = [m.COILS[address + i] for i in range(count) if body[5 + i // 8] >> (i % 8) & 1]
        self._command(on, who)
        return body[:4]

    def _command(self, names: list[str], who: str) -> None:
        """Carry out commands; all are in the log before the first one acts."""
        self._require_unlocked('coils', who)
        if 'stop_set' in names and 'stop_clear' in names:
            raise Refusal(ILLEGAL_VALUE)
        if names:
            self._record('command', who, ', '.join(names))
        for name in names:
            self._owner.command(name, who)

    def _write_multiple(self, body: bytes, who: str) -> bytes:
        if len(body) < 5:
            raise Refusal(ILLEGAL_VALUE)
        address, count, size = struct.unpack('>HHB', body[:5])
        _check_count(count, 123)
        if size != 2 * count or len(body) != 5 + size:
            raise Refusal(ILLEGAL_VALUE)
        self._write_registers(address, list(struct.unpack(f'>{count}H', body[5:])), who)
        return body[:4]

    def _mask_write(self, body: bytes, who: str) -> bytes:
        address, and_mask, or_mask = _words(body, 3)
        _check_range(address, 1, m.WRITABLE)
        self._refresh_holding()
        value = (self._holding[address] & and_mask) | (or_mask & ~and_mask & 0xFFFF)
        self._write_registers(address, [value], who)
        return body

    async def _read_write(self, body: bytes, who: str) -> bytes:
        if len(body) < 9:
            raise Refusal(ILLEGAL_VALUE)
        read, read_count, address, count, size = struct.unpack('>HHHHB', body[:9])
        _check_count(read_count, 125)
        _check_count(count, 121)
        if size != 2 * count or len(body) != 9 + size:
            raise Refusal(ILLEGAL_VALUE)
        # Both ranges are checked first: a write must not stand if the read is refused.
        _check_range(read, read_count, m.HOLDING)
        self._write_registers(address, list(struct.unpack(f'>{count}H', body[9:])), who)
        return await self._read_registers(3, read, read_count)

    def _write_registers(self, address: int, words: list[int], who: str) -> None:
        """Apply all of `words` or none."""
        _check_range(address, len(words), m.WRITABLE)
        addresses = range(address, address + len(words))
        if m.UNLOCK in addresses:
            if len(words) > 1:
                raise Refusal(ILLEGAL_VALUE)
            self._try_key(words[0], who)
            return
        self._require_unlocked(f'holding registers {addresses[0]}-{addresses[-1]}', who)
        changes: dict[str, float] = {}
        save = False
        for a, word in zip(addresses, words):
            if a == m.SAVE:
                if word != m.SAVE_COMMAND:
                    raise Refusal(ILLEGAL_VALUE)
                save = True
                continue
            setting = m.SETTINGS[a - m.FIRST_SETTING]
            try:
                changes[setting.name] = m.word_to_setting(setting, word)
            except ValueError:
                raise Refusal(ILLEGAL_VALUE) from None
        merged = self.settings | changes
        lowest = min(merged[name] for name in m.THRESHOLDS)
        if merged['heel_warning'] > merged['heel_alarm'] or merged['hysteresis'] >= lowest:
            raise Refusal(ILLEGAL_VALUE)
        self._take(merged, changes, save, who)

    def _take(self, merged: dict[str, float], changes: dict[str, float], save: bool, who: str) -> None:
        if changes:
            parts = [f'{name} {self.settings[name]:g} -> {value:g}' for name, value in changes.items()]
            self._record('setting', who, ', '.join(parts))
        if save:
            self._record('save', who, 'settings saved')
            crc = settings_crc(merged)
            try:
                self._owner.save(merged, crc)
            except OSError:
                raise Refusal(DEVICE_FAILURE) from None
            self.saved_crc = crc
        self.settings = merged
        if changes:
            self._owner.changed(dict(merged))

    def _try_key(self, word: int, who: str) -> None:
        now = self._clock()
        if now < self._closed_until:
            raise Refusal(ILLEGAL_VALUE)
        if word == 0 and self.unlocked:
            self._record('lock', who, 'writing locked')
            self._unlocked_until = -math.inf
            return
        if self._key == 0 or word != self._key:
            self._wrong += 1
            if self._wrong >= _WRONG_KEYS:
                self._wrong, self._closed_until = 0, now + _PENALTY
            self._record('refused', who, 'wrong unlock key')
            raise Refusal(ILLEGAL_VALUE)
        self._wrong = 0
        self._record('unlock', who, f'writing open for {self._unlock_time:g} s')
        self._unlocked_until = now + self._unlock_time

    def _require_unlocked(self, what: str, who: str) -> None:
        if not self.unlocked:
            now = self._clock()
            if now >= self._next_refusal:
                self._next_refusal = now + _REFUSALS_EVERY
                self._record('refused', who, f'locked: {what}')
            raise Refusal(ILLEGAL_FUNCTION)

    def _record(self, kind: str, who: str, text: str) -> None:
        try:
            self._owner.record(kind, who, text)
        except (OSError, RuntimeError):
            raise Refusal(DEVICE_FAILURE) from None


def settings_crc(settings: dict[str, float]) -> int:
    """Return the CRC-16 (Modbus) of the settings' registers, high byte first."""
    words = [m.setting_to_word(s, settings[s.name]) for s in m.SETTINGS]
    return FramerRTU.compute_CRC(struct.pack(f'>{len(words)}H', *words))


def _words(body: bytes, count: int) -> tuple[int, ...]:
    if len(body) != 2 * count:
        raise Refusal(ILLEGAL_VALUE)
    return struct.unpack(f'>{count}H', body)


def _check_count(count: int, largest: int) -> None:
    if not 1 <= count <= largest:
        raise Refusal(ILLEGAL_VALUE)


def _check_range(address: int, count: int, allowed: range | set[int]) -> None:
    if not all(a in allowed for a in range(address, address + count)):
        raise Refusal(ILLEGAL_ADDRESS)
