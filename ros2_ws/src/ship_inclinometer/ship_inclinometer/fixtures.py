# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bag_tools.bag import BagWriter, zeroed
from ship_inclinometer import topics
from ship_inclinometer.recording import TYPES, events, fill
from ship_inclinometer.simulation import SimulatorParams, scenario, simulate

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
# 50 Hz and one truth in five keep a bag under 1.5 MB; engine lines above 25 Hz would only alias.
_RATE, _TRUTH_EVERY = 50.0, 5


def write_bag(path: Path, params: SimulatorParams, seed: int, with_log: bool = False) -> None:
    """Write a simulated recording into a bag (mcap, zstd)."""
    recording = simulate(params, seed)
    messages = {topic: zeroed(kind) for topic, kind in TYPES.items()}
    unwanted = set() if with_log else {topics.LOG}
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        for topic, kind in TYPES.items():
            if topic not in unwanted and (topic != topics.GNSS or params.gnss_rate > 0.0):
                bag.add(f'/{topic}', kind)
        for stamp, topic, index in events(recording, START, _TRUTH_EVERY):
            if topic not in unwanted:
                fill(recording, topic, index, stamp, messages[topic])
                bag.write(f'/{topic}', stamp, messages[topic])


def _small(name: str, **changes) -> SimulatorParams:
    quiet = {'rate': _RATE, 'magnetometer_rate': 10.0, 'engine_frequencies': (12.5, 0.0)}
    return scenario(name, **(quiet | changes))


def _beam_sea(path: Path) -> None:
    """180 s of an irregular beam sea, no GNSS, started in motion."""
    write_bag(path, _small('beam', duration=180.0), 7)


def _turn_gnss(path: Path) -> None:
    """160 s with a turn of 180° at 2 °/s and GNSS velocity stamped 0.2 s late."""
    params = _small('turns_gnss', duration=160.0, turn_starts=(50.0, -1.0), gnss_delay=0.2)
    write_bag(path, params, 8, with_log=True)


def _magnetic_disturbance(path: Path) -> None:
    """150 s with a crane's field of 15 µT over the compass from 80 s to 110 s."""
    params = _small('disturbed', duration=150.0, disturbance_start=80.0, disturbance_time=30.0)
    write_bag(path, params, 9)


FIXTURES: dict[str, Callable[[Path], None]] = {
    'ship_beam_sea': _beam_sea,
    'ship_turn_gnss': _turn_gnss,
    'ship_magnetic_disturbance': _magnetic_disturbance,
}
