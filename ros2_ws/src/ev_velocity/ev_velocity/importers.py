# SPDX-License-Identifier: Apache-2.0
"""Recorded drives to bags: what `ros2 run bag_tools import ev_velocity:NAME SOURCE BAG` offers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagError, BagWriter, zeroed
from ev_velocity.can_frames import CanDecoder, CanError, load_dbc, replay
from ev_velocity.can_profiles import PROFILES
from ev_velocity.codec import BODY, IMU, TWIST
from ev_velocity.drive_messages import TWIST_STAMPED
from ev_velocity.driver_codec import TOPICS, encode_reading
from ev_velocity.recordings import RecordingError, read_kingston, read_obd
from node_core.messages import set_stamp

# The recordings count from −1 s or from the start of a GPS week; stamps must be positive.
OFFSET = 1000.0  # s
WHEEL_RADIUS = 0.285  # m, by which `wheel/states` are turned into rad/s, as the estimator turns them back


def _write(bag: BagWriter, streams: list[tuple[str, str, np.ndarray, np.ndarray, str]]) -> None:
    """Write (topic, type, times, values, path of the number in the message) in order of time."""
    rows = []
    messages = {}
    for order, (topic, kind, t, values, path) in enumerate(streams):
        bag.add(topic, kind)
        message = messages[topic] = zeroed(kind)
        message.header.frame_id = BODY
        if kind == IMU:
            message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
        for stamp, value in zip(np.rint((t + OFFSET) * 1e9).astype(np.int64).tolist(), values.tolist()):
            rows.append((stamp, order, topic, path, value))
    for stamp, _, topic, path, value in sorted(rows):
        message = messages[topic]
        set_stamp(message.header, stamp)
        *parents, leaf = path.split('.')
        holder: Any = message
        for parent in parents:
            holder = getattr(holder, parent)
        setattr(holder, leaf, value)
        bag.write(topic, stamp, message)


_SPEED = 'twist.twist.linear.x'


def kingston(source: Path, bag: BagWriter) -> None:
    """Import a folder like `kingston_1800s`: accelerometer, GPS, OBD, reference."""
    try:
        drive = read_kingston(source)
    except RecordingError as error:
        raise BagError(str(error)) from None
    _write(
        bag,
        [
            ('/imu/data_raw', IMU, *drive.force, 'linear_acceleration.x'),
            ('/gps/speed', TWIST, *drive.gps, _SPEED),
            ('/obd/speed', TWIST, *drive.obd, _SPEED),
            ('/truth/velocity', TWIST_STAMPED, *drive.truth, 'twist.linear.x'),
        ],
    )


def obd_kingston(source: Path, bag: BagWriter) -> None:
    """Import a file like `kingston_k19_1.csv`: OBD speed and reference."""
    try:
        t, reference, obd = read_obd(source)
    except RecordingError as error:
        raise BagError(str(error)) from None
    t = t - t[0]
    _write(
        bag,
        [
            ('/obd/speed', TWIST, t, obd, _SPEED),
            ('/truth/velocity', TWIST_STAMPED, t, reference, 'twist.linear.x'),
        ],
    )


def _can(profile: str, dbc: Callable[[Path], Path | None]) -> Callable[[Path, BagWriter], None]:
    def importer(source: Path, bag: BagWriter) -> None:
        """Import a CAN log (candump, ASC, BLF) with the profile's signals."""
        try:
            decoder = CanDecoder(
                load_dbc(str(dbc(source) or '')), PROFILES[profile], 400.0 if profile == 'imiev' else 1.0
            )
            messages = {}
            for frame in replay(str(source)):
                for reading in decoder.on_frame(*frame):
                    topic, kind = TOPICS[type(reading)]
                    if topic not in messages:
                        messages[topic] = zeroed(kind)
                        bag.add(f'/{topic}', kind)
                    encode_reading(reading, messages[topic], frame[0], WHEEL_RADIUS)
                    bag.write(f'/{topic}', frame[0], messages[topic])
        except CanError as error:
            raise BagError(str(error)) from None
        if not messages:
            raise BagError(f'{source}: no frame of the profile {profile} in this log')

    return importer


def _beside(source: Path) -> Path:
    """Return the only DBC file beside a log."""
    found = sorted(source.parent.glob('*.dbc'))
    if len(found) != 1:
        raise CanError(f'{source.parent}: {len(found)} DBC files beside the log, expected one')
    return found[0]


IMPORTERS: dict[str, Callable[[Path, BagWriter], None]] = {
    'kingston': kingston,
    'obd_kingston': obd_kingston,
    'can_toyota86': _can('toyota86', _beside),
    'can_imiev': _can('imiev', lambda _: None),
}
