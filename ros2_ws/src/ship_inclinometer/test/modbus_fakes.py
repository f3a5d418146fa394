# SPDX-License-Identifier: Apache-2.0
"""A ship's side for Modbus tests, a clock that is set by hand, and a bare RTU CRC."""

from ship_inclinometer.modbus_device import ModbusDevice

KEY = 0x1234
UNIT = 7


class Ship:
    def __init__(self):
        self.events, self.commands, self.settings, self.saved = [], [], None, None
        self.broken = False

    def record(self, kind, who, text):
        if self.broken:
            raise OSError('medium full')
        self.events.append((kind, who, text))

    def command(self, name, who):
        self.commands.append(name)

    def changed(self, settings):
        self.settings = settings

    def save(self, settings, crc):
        self.saved = (settings, crc)


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


def make():
    ship, clock = Ship(), Clock()
    return ModbusDevice(UNIT, ship, KEY, 60.0, clock=clock), ship, clock


def crc(data):
    """CRC-16/MODBUS by its definition: reflected 0x8005, start 0xFFFF; low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, 'little')


def rtu(unit, *pdu):
    frame = bytes([unit, *pdu])
    return frame + crc(frame)
