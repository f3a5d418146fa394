# SPDX-License-Identifier: Apache-2.0
"""Recordings to bags: what `ros2 run bag_tools import ins_gps:NAME SOURCE BAG` offers."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagError, BagWriter, zeroed
from ins_gps import codec
from ins_gps.dgps import DgpsBase
from ins_gps.params import BaseParams
from ins_gps.recordings import gnss_epochs, read_track, read_walk_imu
from ins_gps.samples import FixEstimate, ImuSample
from kalman_core.earth import ecef_from_geodetic, enu_from_ecef
from node_core.messages import set3, set_stamp

_STAND = 10.0  # s, in which the recorded walk has not begun
_SURVEYED = 0.05  # m, standard deviation of the RTK position of the stand
# The track's own base is off by tens of metres, and with it the stand against the satellites.
_BASE_LIMIT = 100.0  # m


def walk(source: Path, bag: BagWriter) -> None:
    """Import a folder like `gnss_imu_walk_60s`: IMU, raw GNSS, RTK track.

    There is no base station. While the receiver stands, at the place that the track gives, it is its own: the
    corrections of that time and the place as a fix go into the bag. The track is /truth/position, ENU from
    the stand.
    """
    try:
        imu = read_walk_imu(_only(source, 'imu*.csv'))
        track = read_track(_only(source, '*.pos'))
        epochs = gnss_epochs(_only(source, '*.obs'), (_only(source, '*.nav'),))
    except (OSError, ValueError, IndexError) as error:
        raise BagError(f'{source}: {error}') from None
    standing = track.stamps - track.stamps[0] < _STAND * 1e9
    stand = track.geodetic[standing].mean(axis=0)
    degrees = (math.degrees(stand[0]), math.degrees(stand[1]), float(stand[2]))
    base = DgpsBase(BaseParams(position=degrees, position_limit=_BASE_LIMIT))
    records: list[tuple[int, int, str, Callable[[Any, Any], None], Any]] = [
        (int(t), 0, '/imu/data_raw', codec.encode_imu, ImuSample(int(t), w, f))
        for t, w, f in zip(imu.stamps, imu.rate, imu.force, strict=True)
    ]
    for epoch in epochs:
        if epoch.stamp - track.stamps[0] < _STAND * 1e9:
            corrections = base.on_gnss(epoch)
            if corrections is not None:
                records.append((epoch.stamp, 1, '/gnss/corrections', codec.encode_corrections, corrections))
            fix = FixEstimate(epoch.stamp, stand, np.eye(3) * _SURVEYED**2)
            records.append((epoch.stamp, 2, '/gnss/fix', codec.encode_fix, fix))
        records.append((epoch.stamp, 3, '/gnss/observations', codec.encode_observations, epoch))
    for t, place in zip(track.stamps, track.geodetic, strict=True):
        enu = enu_from_ecef(ecef_from_geodetic(*place), *stand)
        records.append((int(t), 4, '/truth/position', _encode_point, (int(t), enu)))
    _write(bag, records)


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise ValueError(f'{len(found)} files {pattern}, expected one')
    return found[0]


_TYPES = {
    '/imu/data_raw': codec.IMU,
    '/gnss/corrections': codec.CLOUD,
    '/gnss/fix': codec.FIX,
    '/gnss/observations': codec.CLOUD,
    '/truth/position': 'geometry_msgs/msg/PointStamped',
}


def _encode_point(sample: tuple[int, np.ndarray], message: Any) -> None:
    stamp, enu = sample
    set_stamp(message.header, stamp)
    message.header.frame_id = 'map'
    set3(message.point, enu)


def _write(bag: BagWriter, records: list[tuple[int, int, str, Callable[[Any, Any], None], Any]]) -> None:
    messages = {topic: zeroed(kind) for topic, kind in _TYPES.items()}
    for topic, kind in _TYPES.items():
        bag.add(topic, kind)
    for stamp, _, topic, encode, sample in sorted(records, key=lambda record: record[:2]):
        encode(sample, messages[topic])
        bag.write(topic, stamp, messages[topic])


IMPORTERS: dict[str, Callable[[Path, BagWriter], None]] = {'gnss_imu_walk': walk}
