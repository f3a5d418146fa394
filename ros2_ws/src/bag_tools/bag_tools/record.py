# SPDX-License-Identifier: Apache-2.0
"""What the recorder does, without ROS: options, bag time, when to stop."""

from __future__ import annotations

import argparse
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from bag_tools.bag import BagError
from bag_tools.play import NANOSECONDS

STAMPS = ('receive', 'header')


@dataclass(slots=True)
class RecordOptions:
    """What to record and when to stop. Times in s; `count` is over all topics."""

    bag: Path
    topics: list[str] = field(default_factory=list)
    storage: str | None = None
    compression: str = 'none'
    overwrite: bool = False
    stamp: str = 'receive'
    lockstep: bool = False
    count: int | None = None
    idle: float = math.inf
    duration: float = math.inf
    wait_timeout: float = 30.0


def parser() -> argparse.ArgumentParser:
    """Return the command line of the recorder."""
    p = argparse.ArgumentParser(
        prog='record',
        description='Record topics into a bag until Ctrl-C; node name recorder.',
        epilog='ROS arguments follow --ros-args; with -p use_sim_time:=true bag times are those of /clock.',
    )
    p.add_argument('bag', type=Path, help='bag to write: a folder name, or a .mcap or .db3 file')
    p.add_argument('topics', nargs='*', help='topics to record, waited for')
    p.add_argument('-a', '--all', action='store_true', help='all topics, those that appear later too')
    p.add_argument('--storage', choices=('mcap', 'sqlite3'), help='default: by suffix, else mcap')
    p.add_argument('--compression', choices=('none', 'zstd'), default='none')
    p.add_argument('--overwrite', action='store_true', help='replace an existing bag')
    p.add_argument(
        '--stamp',
        choices=STAMPS,
        default='receive',
        help='bag time: of receipt (default), or header.stamp where there is one',
    )
    p.add_argument('--lockstep', action='store_true', help='acknowledge every message to a lock-step player')
    p.add_argument('--count', type=int, help='stop after so many messages')
    p.add_argument('--idle', type=float, default=math.inf, help='stop after so many s without a message')
    p.add_argument('--duration', type=float, default=math.inf, help='stop after so many s')
    p.add_argument('--wait-timeout', type=float, default=30.0, help='s to wait for the named topics (30)')
    return p


def options_from(argv: list[str]) -> RecordOptions:
    """Return the options of a command line without ROS arguments; raise BagError for bad ones."""
    a = parser().parse_intermixed_args(argv)
    if a.all == bool(a.topics):
        raise BagError('name the topics to record, or give --all (not both)')
    if a.lockstep and a.all:
        raise BagError('--lockstep needs the topics by name: only then is it known when all are matched')
    for name in ('idle', 'duration', 'wait_timeout'):
        if not getattr(a, name) > 0.0:
            raise BagError(f'--{name.replace("_", "-")} is {getattr(a, name):g}, allowed: > 0')
    if a.count is not None and a.count < 1:
        raise BagError(f'--count is {a.count}, allowed: >= 1')
    return RecordOptions(
        bag=a.bag,
        topics=a.topics,
        storage=a.storage,
        compression=a.compression,
        overwrite=a.overwrite,
        stamp=a.stamp,
        lockstep=a.lockstep,
        count=a.count,
        idle=a.idle,
        duration=a.duration,
        wait_timeout=a.wait_timeout,
    )


def header_stamp(data: bytes, received: int) -> int:
    """Return the header stamp (ns) of a CDR message whose first field is a std_msgs/Header.

    A negative one, which no bag can hold, gives way to `received`.
    """
    order = '<' if data[1] & 1 else '>'  # second byte of the encapsulation: 1 is little endian
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
    return seconds * NANOSECONDS + nanoseconds if seconds >= 0 else received


def has_header(type_name: str, store: Typestore) -> bool:
    """Whether the first field of a message type is a std_msgs/Header."""
    fields = store.fielddefs[type_name][1]
    return bool(fields) and fields[0][1] == (Nodetype.NAME, 'std_msgs/msg/Header')


class StopRule:
    """Says when a recording is complete. Times are steady-clock seconds."""

    def __init__(self, options: RecordOptions, now: float) -> None:
        self._options = options
        self._begin = now
        self._last: float | None = None
        self.messages = 0

    def begin(self, now: float) -> None:
        """Count the duration from `now`: the wait for topics is none of it."""
        self._begin = now

    def received(self, now: float) -> None:
        """Count one message."""
        self.messages += 1
        self._last = now

    def done(self, now: float) -> bool:
        """Whether to stop; idleness counts from the first message."""
        if self._options.count is not None and self.messages >= self._options.count:
            return True
        if self._last is not None and now - self._last >= self._options.idle:
            return True
        return now - self._begin >= self._options.duration
