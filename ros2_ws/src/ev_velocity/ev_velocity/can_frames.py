# SPDX-License-Identifier: Apache-2.0
"""CAN frames to readings: what is wrong with a frame is counted and named, never guessed around."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import can
import cantools

from ev_velocity.can_profiles import Profile, Signal

OWN_DBC = Path(__file__).parent / 'data' / 'imiev.dbc'
NANOSECONDS = 1_000_000_000
# A wheel of another frame counts together with this one while it is not older than this (s).
TOGETHER = 0.1
# A frame is missing when it is later than so many of its periods.
LATE = 3.0
# So many frames in a row with stamps that go back: the clock was set back, they are not out of order.
SET_BACK = 10


class CanError(Exception):
    """A DBC, log or interface cannot be used; the text says which, what was wrong and what was expected."""


class Wheels(NamedTuple):
    """Circumference speeds, m/s, by name; NaN for one that is not known."""

    stamp: int
    names: tuple[str, ...]
    speeds: tuple[float, ...]


class Pedals(NamedTuple):
    """Accelerator and brake, 0…1."""

    stamp: int
    accelerator: float
    brake: float


class Speed(NamedTuple):
    """Speed that the car shows, m/s."""

    stamp: int
    speed: float


class Gear(NamedTuple):
    """1 forward, −1 reverse, 0 neutral or unknown."""

    stamp: int
    direction: int


class Acceleration(NamedTuple):
    """Acceleration along the car as its own sensor says it, m/s²."""

    stamp: int
    acceleration: float


Reading = Wheels | Pedals | Speed | Gear | Acceleration


@dataclass(slots=True)
class FrameHealth:
    """Counts of one frame."""

    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    last: int | None = None
    missing: int = 0
    counter: int | None = None


@cache
def load_dbc(path: str) -> Any:
    """Return the database of a DBC file; raises CanError naming it."""
    file = Path(path) if path else OWN_DBC
    try:
        return cantools.database.load_file(file, strict=False)
    except FileNotFoundError:
        raise CanError(f'{file}: no such DBC file') from None
    except Exception as error:  # cantools' parsers raise several unrelated classes
        raise CanError(f'{file}: not a DBC file ({error})') from None


class CanDecoder:
    """Turns frames into readings of a profile; `health` has one entry for every frame it needs."""

    def __init__(self, database: Any, profile: Profile, brake_full: float = 1.0) -> None:
        self._profile = profile
        self._brake_full = brake_full
        self._messages: dict[int, Any] = {}
        self._periods: dict[str, float] = {}
        for signal in profile.signals():
            message = self._find(database, signal)
            self._messages[message.frame_id] = message
            self._periods[message.name] = signal.period
        self._needed: dict[str, set[str]] = {name: set() for name in self._periods}
        for signal in profile.signals():
            self._needed[signal.frame].add(signal.name)
        self.health = {name: FrameHealth() for name in self._periods}
        self.bus_errors = 0
        self._back = 0
        self._limits = {
            (m.name, s.name): (s.minimum, s.maximum) for m in self._messages.values() for s in m.signals
        }
        self._values: dict[tuple[str, str], tuple[int, float]] = {}

    @staticmethod
    def _find(database: Any, signal: Signal) -> Any:
        try:
            message = database.get_message_by_name(signal.frame)
            message.get_signal_by_name(signal.name)
        except KeyError:
            raise CanError(
                f"the DBC has no signal '{signal.frame}.{signal.name}', which the profile needs"
            ) from None
        return message

    def on_frame(self, stamp: int, frame_id: int, data: bytes, error: bool = False) -> list[Reading]:
        """Take one frame (stamp ns); return what it says, nothing for one that is of no concern or wrong."""
        if error:
            self.bus_errors += 1
            return []
        message = self._messages.get(frame_id)
        if message is None:
            return []
        health = self.health[message.name]
        reason, values = self._decode(message, health, stamp, data)
        if reason:
            health.rejected[reason] += 1
            return []
        self._count_missing(message, health, stamp)
        health.accepted += 1
        health.last = stamp
        for name, value in values.items():
            self._values[message.name, name] = (stamp, value)
        return self._readings(message.name, stamp)

    def _decode(
        self, message: Any, health: FrameHealth, stamp: int, data: bytes
    ) -> tuple[str, dict[str, float]]:
        if len(data) != message.length:
            return f'DLC {len(data)}, expected {message.length}', {}
        if health.last is not None and stamp < health.last:
            self._back += 1
            if self._back < SET_BACK:
                return 'stamp goes back', {}
            for other in self.health.values():
                other.last = None
            self._values.clear()
        self._back = 0
        try:
            decoded = message.decode(data, decode_choices=False)
        except Exception as error:  # cantools and bitstruct raise several unrelated classes
            return f'not decodable ({type(error).__name__})', {}
        values = {name: float(value) for name, value in decoded.items()}
        for signal in self._needed[message.name]:
            low, high = self._limits[message.name, signal]
            if (low is not None and values[signal] < low) or (high is not None and values[signal] > high):
                return f'{signal} out of range', {}
        return self._check_counter(message.name, health, values), values

    def _check_counter(self, frame: str, health: FrameHealth, values: dict[str, float]) -> str:
        name = self._profile.counters.get(frame)
        if name is None:
            return ''
        now, before = int(values[name]), health.counter
        health.counter = now
        return 'counter stands still' if now == before else ''

    def _count_missing(self, message: Any, health: FrameHealth, stamp: int) -> None:
        if health.last is not None:
            gap = (stamp - health.last) / NANOSECONDS / self._periods[message.name]
            if gap > LATE:
                health.missing += round(gap) - 1

    def _value(self, signal: Signal | None) -> float | None:
        if signal is None:
            return None
        entry = self._values.get((signal.frame, signal.name))
        return None if entry is None else entry[1] * signal.factor

    def _readings(self, frame: str, stamp: int) -> list[Reading]:
        profile = self._profile
        out: list[Reading] = []
        wheel_frames = [s.frame for s in profile.wheels.values()]
        if frame == wheel_frames[0]:
            speeds = tuple(self._wheel(s, stamp) for s in profile.wheels.values())
            out.append(Wheels(stamp, tuple(profile.wheels), speeds))
        if frame == profile.accelerator.frame:
            out.append(Pedals(stamp, _share(self._value(profile.accelerator)), self._brake()))
        speed = profile.speed
        if speed is not None and frame == speed.frame:
            out.append(Speed(stamp, self._value(speed) or 0.0))
        if profile.gear is not None and frame == profile.gear.frame:
            raw = self._value(profile.gear)
            direction = profile.gears.get(int(raw) if raw is not None else -1, 0)
            out.append(Gear(stamp, -1 if self._value(profile.reverse) else direction))
        if profile.acceleration is not None and frame == profile.acceleration.frame:
            out.append(Acceleration(stamp, self._value(profile.acceleration) or 0.0))
        return out

    def _wheel(self, signal: Signal, stamp: int) -> float:
        entry = self._values.get((signal.frame, signal.name))
        if entry is None or stamp - entry[0] > TOGETHER * NANOSECONDS:
            return math.nan
        return entry[1] * signal.factor

    def _brake(self) -> float:
        if self._value(self._profile.brake_switch):
            return 1.0
        value = self._value(self._profile.brake)
        return _share(None if value is None else value / self._brake_full)

    def stale(self, now: int, limit: float) -> list[str]:
        """Return the frames that were not seen for `limit` (s), or for three periods of a slower one.

        One that was last seen after `now` is among them: the clock was set back and it has not come since.
        """
        return [
            name
            for name, health in self.health.items()
            if health.last is None
            or now < health.last
            or (now - health.last) / NANOSECONDS > max(limit, LATE * self._periods[name])
        ]


def _share(value: float | None) -> float:
    return 0.0 if value is None else min(max(value, 0.0), 1.0)


def replay(path: str) -> Any:
    """Yield (stamp ns, id, data, error) of a log (candump .log, .asc, .blf, …); raises CanError."""
    if not Path(path).is_file():
        raise CanError(f'{path}: no such log; expected a candump .log, .asc or .blf file')
    try:
        with can.LogReader(path) as reader:
            for message in reader:
                stamp = round(message.timestamp * 1e6) * 1000
                yield stamp, message.arbitration_id, bytes(message.data), message.is_error_frame
    except CanError:
        raise
    except Exception as error:  # every reader of python-can fails in its own way
        raise CanError(f'{path}: not a readable log ({type(error).__name__}: {error})') from None


class CarOnCan:
    """Sends what a simulated i-MiEV says on its bus."""

    def __init__(self, interface: str, channel: str) -> None:
        self._database = load_dbc('')
        self._bus = can.Bus(interface=interface, channel=channel)

    def frames(self, speed: float, accelerator: float, brake: float) -> list[can.Message]:
        """Return one round of frames: speed m/s, pedals 0…1."""
        kmh = speed * 3.6
        content = {
            'WHEELS_1_2': {'WHEEL_1': kmh, 'WHEEL_2': kmh},
            'BRAKE_WHEELS_3_4': {'BRAKE': round(400.0 * brake), 'WHEEL_3': kmh, 'WHEEL_4': kmh},
            'ACCELERATOR': {'ACCELERATOR': 100.0 * accelerator},
            'SPEED': {'SPEED': kmh},
            'GEAR': {'GEAR': 0x44},
        }
        out = []
        for name, values in content.items():
            message = self._database.get_message_by_name(name)
            data = message.encode(values, strict=False)
            out.append(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))
        return out

    def send(self, speed: float, accelerator: float, brake: float) -> None:
        """Send one round of frames."""
        for message in self.frames(speed, accelerator, brake):
            self._bus.send(message)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
