# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bag_tools.bag import BagWriter, zeroed
from ev_velocity.drive_messages import DriveMessages
from ev_velocity.scenarios import SCENARIOS, Drive, simulate

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
TRUTH_EVERY = 10  # 50 Hz


def write_drive(path: Path, drive: Drive) -> None:
    """Write a drive into a bag (mcap, zstd) at `path`."""
    messages = DriveMessages(drive, zeroed, START, TRUTH_EVERY)
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        for topic, kind in messages.topics:
            bag.add(topic, kind)
        for stamp, topic, message in messages:
            bag.write(topic, stamp, message)


# Long enough for the patch near 20 s and short enough for a repository.
LENGTH = 26.0  # s


def _good_road(path: Path) -> None:
    """26 s on a good road: speed up, hold, brake; GPS 10 Hz with a delay of 0.15 s that it does not tell."""
    write_drive(path, simulate(SCENARIOS['good_road_10hz'], 21, LENGTH))


def _oil_patch(path: Path) -> None:
    """26 s, the wheel leaves the speed by 6 m/s for 0.4 s near 20 s; GPS 10 Hz."""
    write_drive(path, simulate(SCENARIOS['oil_patch_10hz'], 22, LENGTH))


def _gps_trouble(path: Path) -> None:
    """26 s with a GPS of 1 Hz that is 5.8 m/s off for 5 s and silent for 10 s."""
    settings = replace(SCENARIOS['multipath'], gps_rate=1.0, multipath=(9.0, 14.0, 5.8), outage=(15.0, 25.0))
    write_drive(path, simulate(settings, 23, LENGTH))


FIXTURES: dict[str, Callable[[Path], None]] = {
    'ev_good_road': _good_road,
    'ev_oil_patch': _oil_patch,
    'ev_gps_trouble': _gps_trouble,
}
