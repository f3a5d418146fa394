# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulator and driver nodes."""

from __future__ import annotations

from dataclasses import dataclass

from ev_velocity.scenarios import SCENARIOS
from ev_velocity.simulation import COURSES
from kalman_core.parameters import parameter
from node_core.byte_params import RecordingParams, StreamParams


@dataclass(frozen=True, slots=True)
class SimulatorParams:
    """The simulated car and its sensors."""

    scenario: str = parameter('plant_good_road', 'drive to simulate', choices=(*COURSES, *SCENARIOS))
    seed: int = parameter(0, 'seed of sensors and road', minimum=0)
    duration: float = parameter(60.0, 'length of one drive', unit='s', minimum=1.0, maximum=3600.0)
    loop: bool = parameter(True, 'start the drive again when it is over')
    can_interface: str = parameter(
        '', 'python-can interface on which the car speaks too (virtual, udp_multicast, socketcan, …)'
    )
    can_channel: str = parameter('vcan0', 'channel of that interface')


@dataclass(frozen=True, slots=True)
class CanParams(RecordingParams):
    """The CAN driver."""

    interface: str = parameter(
        'socketcan', 'python-can interface, or `log` to replay the file `channel` (candump .log, .asc, .blf)'
    )
    channel: str = parameter('can0', 'channel of the interface, or path of the log')
    bitrate: int = parameter(500_000, 'bit rate where the interface sets it', unit='bit/s', minimum=10_000)
    dbc: str = parameter('', "DBC file; empty is the package's own of the i-MiEV")
    profile: str = parameter('imiev', 'which signals are which', choices=('imiev', 'toyota86'))
    wheel_radius: float = parameter(0.285, 'rolling radius', unit='m', minimum=0.05, maximum=2.0)
    brake_full: float = parameter(
        400.0, 'raw brake value that counts as full pedal (its scale is disputed)', minimum=1.0
    )
    reconnect_time: float = parameter(
        1.0, 'wait before a lost interface is opened again', unit='s', minimum=0.05, maximum=60.0
    )
    stale_time: float = parameter(0.5, 'a frame not seen for longer is named', unit='s', minimum=0.05)


@dataclass(frozen=True, slots=True)
class GpsParams(StreamParams):
    """The GPS driver."""

    source: str = parameter(
        '/dev/ttyACM0', 'serial port (/dev/... or COMn), tcp://HOST:PORT, or a file with recorded NMEA or UBX'
    )
    stamp_source: str = parameter(
        'arrival',
        "arrival: the host's clock at the message's first byte; message: the receiver's own UTC",
        choices=('arrival', 'message'),
    )
    nmea_sigma: float = parameter(
        0.1, 'noise of a speed from NMEA, which tells none', unit='m/s', minimum=0.01
    )
    frame_id: str = parameter('gps', 'frame of the antenna')
