# SPDX-License-Identifier: Apache-2.0
"""Parameters that drivers share: how a recording is played, and where a stream of bytes comes from."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import parameter


@dataclass(frozen=True, slots=True)
class RecordingParams:
    """How a recording is played."""

    replay_rate: float = parameter(
        1.0, 'of a recording, times real time; 0: as fast as it goes', minimum=0.0, maximum=1000.0
    )
    # Discovery takes two seconds with the default transports, and starting a graph by hand some more.
    wait_for_subscribers: float = parameter(
        10.0,
        'longest wait for subscribers before a recording starts; 0: start at once',
        unit='s',
        minimum=0.0,
        maximum=3600.0,
    )


@dataclass(frozen=True, slots=True)
class StreamParams(RecordingParams):
    """A device, server or file that gives bytes."""

    source: str = parameter('', 'file, serial port (/dev/... or COMn), tcp://HOST:PORT')
    baud: int = parameter(115_200, 'of a serial port', unit='Bd', minimum=300, maximum=10_000_000)
    reconnect_time: float = parameter(
        1.0, 'wait before a lost port or server is opened again', unit='s', minimum=0.05, maximum=60.0
    )
