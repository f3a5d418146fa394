# SPDX-License-Identifier: Apache-2.0
"""What the player does, without ROS: options, selection, order and pace of messages."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from bag_tools.bag import BagError, BagReader
from bag_tools.rosargs import assignment, remapped

# The clock ticks of `ros2 bag play --clock`.
DEFAULT_CLOCK_RATE = 40.0  # Hz
NANOSECONDS = 1_000_000_000


@dataclass(slots=True)
class PlayOptions:
    """How to play. `rate` is inf for as fast as possible; `duration` and `start` in s of bag time.

    `clock` is None for no /clock, 0 for one tick before every message, else Hz of bag time. `wait_for` are
    topics and nodes (with a slash) that have to be there before the first message.
    """

    bag: Path
    rate: float = 1.0
    lockstep: bool = False
    start: float = 0.0
    duration: float = math.inf
    loop: bool = False
    clock: float | None = None
    topics: list[str] = field(default_factory=list)
    exclude: list[str] = field(default_factory=list)
    remaps: dict[str, str] = field(default_factory=dict)
    paused: bool = False
    wait: bool = True
    wait_for: list[str] = field(default_factory=list)
    wait_timeout: float = 30.0
    step_timeout: float = 10.0
    depth: int = 1000
    progress: bool = True


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise ValueError(text)
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < math.inf:
        raise ValueError(text)
    return value


_positive.__name__ = 'number > 0'
_not_negative.__name__ = 'number >= 0'


def parser() -> argparse.ArgumentParser:
    """Return the command line of the player."""
    p = argparse.ArgumentParser(
        prog='play',
        description='Publish a bag. Services (std_srvs/Trigger): /player/pause, resume and step.',
        epilog='ROS arguments follow --ros-args.',
    )
    p.add_argument('bag', type=Path, help='rosbag2 folder, .mcap or .db3 file')
    p.add_argument('-r', '--rate', type=_positive, default=1.0, help='speed against real time (default 1)')
    p.add_argument(
        '--fast',
        action='store_true',
        help='as fast as possible (slow subscribers lose messages unless --lockstep)',
    )
    p.add_argument(
        '--lockstep',
        action='store_true',
        help='one message in flight: wait until every node run with -p lockstep:=true has processed it',
    )
    p.add_argument('--start', '--start-offset', type=_not_negative, default=0.0, help='s of bag time to skip')
    p.add_argument('--duration', type=_positive, default=math.inf, help='s of bag time to play')
    p.add_argument('-l', '--loop', action='store_true', help='start again at the end')
    p.add_argument(
        '--clock',
        type=_not_negative,
        nargs='?',
        const=DEFAULT_CLOCK_RATE,
        metavar='HZ',
        help='publish /clock (default 40 Hz of bag time; 0: before every message)',
    )
    p.add_argument('--topics', nargs='+', default=[], help='play only these')
    p.add_argument('--exclude', nargs='+', default=[], help='play all but these')
    p.add_argument('-m', '--remap', nargs='+', default=[], metavar='FROM:=TO', help='rename topics')
    p.add_argument('-p', '--start-paused', action='store_true', help='wait for ~/resume or ~/step')
    p.add_argument(
        '--wait-for',
        nargs='+',
        default=[],
        metavar='NAME',
        help='topics or /nodes to be matched before the start',
    )
    p.add_argument('--wait-timeout', type=_not_negative, default=30.0, help='s to wait for subscribers (30)')
    p.add_argument('--no-wait', action='store_true', help='start at once, subscribers or not')
    p.add_argument(
        '--step-timeout', type=_positive, default=10.0, help='s to wait for a node in lock-step (10)'
    )
    p.add_argument('--depth', type=int, default=1000, help='least queue depth of publishers (1000)')
    p.add_argument('-q', '--quiet', action='store_true', help='no progress bar')
    return p


def options_from(argv: list[str]) -> PlayOptions:
    """Return the options of a command line without ROS arguments; raise BagError for bad ones."""
    a = parser().parse_intermixed_args(argv)
    if a.topics and a.exclude:
        raise BagError('--topics and --exclude exclude each other')
    if a.depth < 1:
        raise BagError(f'--depth is {a.depth}, allowed: >= 1')
    return PlayOptions(
        bag=a.bag,
        rate=math.inf if a.fast else a.rate,
        lockstep=a.lockstep,
        start=a.start,
        duration=a.duration,
        loop=a.loop,
        clock=a.clock,
        topics=a.topics,
        exclude=a.exclude,
        remaps=dict(assignment(text, '--remap') for text in a.remap),
        paused=a.start_paused,
        wait=not a.no_wait,
        wait_for=a.wait_for,
        wait_timeout=a.wait_timeout,
        step_timeout=a.step_timeout,
        depth=a.depth,
        progress=not a.quiet,
    )


class Playlist:
    """The selected messages of an open bag, in order, under their new names.

    `topics` maps names in the bag to published names; `begin` and `end` are bag times (ns, end exclusive).
    Raises BagError when nothing is selected.
    """

    def __init__(self, reader: BagReader, options: PlayOptions) -> None:
        names = [reader.topic(t).name for t in options.topics] or sorted(reader.topics)
        left_out = {reader.topic(t).name for t in options.exclude}
        self.topics = {n: remapped(n, options.remaps) for n in names if n not in left_out}
        self.begin = reader.start + round(options.start * NANOSECONDS)
        self.end = reader.stop
        if math.isfinite(options.duration):
            self.end = min(self.end, self.begin + round(options.duration * NANOSECONDS))
        self._reader = reader
        if not self.topics or self.begin >= self.end:
            length = max(reader.stop - reader.start - 1, 0) * 1e-9
            raise BagError(
                f'{reader.path}: nothing to play; the bag has {reader.count} messages in {length:.3f} s'
            )

    def latched(self) -> list[tuple[str, int, bytes]]:
        """Return the last message before `begin` of each latched topic: a late joiner would have it."""
        names = {n for n in self.topics if self._reader.topics[n].latched}
        last: dict[str, tuple[str, int, bytes]] = {}
        if names and self.begin > self._reader.start:
            for message in self._reader.messages(names, None, self.begin):
                last[message[0]] = message
        return sorted(last.values(), key=lambda m: m[1])

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        return self._reader.messages(self.topics, self.begin, self.end)


class Pace:
    """When a bag time is due on the wall clock. Times are steady-clock seconds, bag times ns."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._origin: float | None = None
        self._bag_origin = 0

    def restart(self, now: float, bag_time: int) -> None:
        """Make `bag_time` due now: at the start, after a pause and at a loop."""
        self._origin, self._bag_origin = now, bag_time

    def due(self, bag_time: int) -> float:
        """Return the wall time at which `bag_time` is due; -inf when played as fast as possible."""
        if self._origin is None or not math.isfinite(self._rate):
            return -math.inf
        return self._origin + (bag_time - self._bag_origin) * 1e-9 / self._rate


def clock_ticks(last: int | None, stamp: int, rate: float) -> list[int]:
    """Return the clock ticks (ns) after `last` up to `stamp`; the first one ever is `stamp` itself.

    `rate` in Hz of bag time; 0 ticks once at `stamp`, before each message.
    """
    if rate == 0.0 or last is None:
        return [] if last == stamp else [stamp]
    period = max(round(NANOSECONDS / rate), 1)
    return list(range(last + period, stamp + 1, period))
