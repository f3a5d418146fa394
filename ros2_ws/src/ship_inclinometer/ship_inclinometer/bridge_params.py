# SPDX-License-Identifier: Apache-2.0
"""Parameters of the bridges to the rest of the ship."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from kalman_core.parameters import ParameterError, parameter

LOG_FILE = '~/.ros/ship_inclinometer/events.db'


@dataclass(frozen=True)
class ModbusParams:
    """Modbus RTU and TCP."""

    unit: int = parameter(1, 'unit identifier', minimum=1, maximum=247)
    tcp: bool = parameter(True, 'serve Modbus TCP')
    tcp_host: str = parameter('127.0.0.1', 'address to listen on')
    tcp_port: int = parameter(1502, 'port to listen on (502 needs privileges)', minimum=0, maximum=65535)
    tcp_allowed: str = parameter('127.0.0.0/8 ::1/128', 'who may connect: addresses or networks, by spaces')
    serial: str = parameter('', 'serial device of Modbus RTU; empty: none')
    baudrate: int = parameter(19200, 'baud rate', unit='Bd', minimum=1200, maximum=115200)
    parity: str = parameter('E', 'parity; N has two stop bits', choices=('E', 'O', 'N'))
    local_echo: bool = parameter(False, 'the adapter echoes what is sent')
    unlock_key: int = parameter(0, 'key that opens writing, 0: never', minimum=0, maximum=65535)
    unlock_time: float = parameter(
        60.0, 'how long a key opens writing', unit='s', minimum=1.0, maximum=3600.0
    )
    update_rate: float = parameter(20.0, 'rate of the input registers', unit='Hz', minimum=1.0, maximum=100.0)
    settings_file: str = parameter('~/.ros/ship_inclinometer/settings.json', 'where settings are saved')
    event_log: str = parameter(LOG_FILE, 'event log')

    def __post_init__(self) -> None:
        for network in self.tcp_allowed.split():
            try:
                ipaddress.ip_network(network, strict=False)
            except ValueError:
                raise ParameterError(
                    f"parameter 'tcp_allowed' has {network!r}, allowed: addresses or networks like 10.0.0.0/8"
                ) from None


@dataclass(frozen=True)
class NmeaParams:
    """NMEA 0183 over UDP and a serial line."""

    talker: str = parameter('II', 'talker identifier')
    rate: float = parameter(10.0, 'rate of the sentences', unit='Hz', minimum=5.0, maximum=50.0)
    udp_host: str = parameter('127.0.0.1', 'receiver, unicast or broadcast; empty: none')
    udp_port: int = parameter(10110, 'port of the receiver', minimum=1, maximum=65535)
    serial: str = parameter('', 'serial device; empty: none')
    baudrate: int = parameter(38400, 'baud rate', unit='Bd', minimum=1200, maximum=115200)
    true_heading: bool = parameter(True, 'the heading is true (declination is set): HDT and THS are sent')

    manufacturer: str = parameter(
        '', 'mnemonic code registered with NMEA: alerts are sent as ALF and ALC; empty: none'
    )
    command_host: str = parameter('127.0.0.1', 'address to take alert commands (ACN) on')
    command_port: int = parameter(0, 'UDP port to take them on, 0: none', minimum=0, maximum=65535)

    def __post_init__(self) -> None:
        if not re.fullmatch('([A-Z]{3})?', self.manufacturer):
            raise ParameterError(
                f"parameter 'manufacturer' is {self.manufacturer!r}, allowed: three capitals or none"
            )
        if self.command_port and not self.manufacturer:
            raise ParameterError(
                "parameter 'command_port' needs 'manufacturer': without it no alerts are sent"
            )
        if not re.fullmatch('[A-Z][A-Z]|U[0-9]', self.talker):
            raise ParameterError(
                f"parameter 'talker' is {self.talker!r}, allowed: two capitals like II, or U0 … U9"
            )


@dataclass(frozen=True)
class AlarmParams:
    """Thresholds at start; Modbus may change them while running."""

    heel_warning: float = parameter(10.0, 'heel that warns', unit='°', minimum=1.0, maximum=60.0, live=True)
    heel_alarm: float = parameter(20.0, 'heel that alarms', unit='°', minimum=1.0, maximum=80.0, live=True)
    roll_alarm: float = parameter(
        15.0, 'roll amplitude that alarms', unit='°', minimum=1.0, maximum=60.0, live=True
    )
    pitch_alarm: float = parameter(8.0, 'trim that alarms', unit='°', minimum=1.0, maximum=45.0, live=True)
    hysteresis: float = parameter(
        1.0, 'return below a threshold that ends an alarm', unit='°', minimum=0.1, maximum=10.0, live=True
    )
    alarm_delay: float = parameter(
        2.0, 'time above a threshold before an alarm', unit='s', minimum=0.0, maximum=600.0, live=True
    )
    silence_time: float = parameter(30.0, 'time for which silence lasts', unit='s', minimum=0.0, live=True)
    latching: bool = parameter(True, 'an alarm that is over stays until it is acknowledged', live=True)
    event_log: str = parameter(LOG_FILE, 'event log')

    def __post_init__(self) -> None:
        lowest = min(self.heel_warning, self.heel_alarm, self.roll_alarm, self.pitch_alarm)
        if self.hysteresis >= lowest:
            raise ParameterError(
                f"parameter 'hysteresis' is {self.hysteresis:g} °, allowed: under every threshold "
                f'(the lowest is {lowest:g} °), or its alarm would never end'
            )


@dataclass(frozen=True)
class DisplayParams:
    """The web page."""

    host: str = parameter('127.0.0.1', 'address to listen on')
    port: int = parameter(8080, 'port to listen on', minimum=0, maximum=65535)
    token: str = parameter('', 'who knows it may acknowledge; empty: the page is read-only')
    event_log: str = parameter(LOG_FILE, 'event log')
