# SPDX-License-Identifier: Apache-2.0
"""Field access that works alike on rclpy's and rosbags' message objects."""

from __future__ import annotations

import array
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from node_core.ports import BadMessage

NANOSECONDS = 1_000_000_000


def stamp_of(message: Any) -> int:
    """Return the header stamp (ns); raise BadMessage when it is zero or malformed."""
    stamp = message.header.stamp
    value = stamp.sec * NANOSECONDS + stamp.nanosec
    if value <= 0:
        raise BadMessage('zero stamp')
    return value


def set_stamp(header: Any, stamp: int) -> None:
    """Write `stamp` (ns) into a std_msgs/Header."""
    sec, nanosec = divmod(stamp, NANOSECONDS)
    header.stamp.sec = sec
    header.stamp.nanosec = nanosec


def finite3(vector: Any, name: str) -> tuple[float, float, float]:
    """Return (x, y, z) of a Vector3 or Point; raise BadMessage when one is not finite."""
    x, y, z = vector.x, vector.y, vector.z
    if not math.isfinite(x + y + z):
        raise BadMessage(f'{name} not finite')
    return x, y, z


def set3(vector: Any, values: Sequence[float] | np.ndarray) -> None:
    """Write three numbers into a Vector3 or Point."""
    vector.x = float(values[0])
    vector.y = float(values[1])
    vector.z = float(values[2])


def set_quaternion(quaternion: Any, q: Sequence[float] | np.ndarray) -> None:
    """Write a (w, x, y, z) quaternion into a geometry_msgs/Quaternion, which is ordered (x, y, z, w)."""
    quaternion.w = float(q[0])
    quaternion.x = float(q[1])
    quaternion.y = float(q[2])
    quaternion.z = float(q[3])


def get_quaternion(quaternion: Any) -> np.ndarray:
    """Return a geometry_msgs/Quaternion as (4,) wxyz of unit norm; raise BadMessage when its norm is off."""
    q = np.array([quaternion.w, quaternion.x, quaternion.y, quaternion.z])
    norm = float(np.sqrt(q @ q))
    if not 0.5 < norm < 2.0:  # also rejects NaN; drivers round, but never by half
        raise BadMessage('quaternion norm')
    return q / norm


def set_floats(message: Any, name: str, values: Sequence[float] | np.ndarray) -> None:
    """Write a variable-length float64 sequence: array.array for rclpy, numpy for rosbags."""
    if isinstance(getattr(message, name), array.array):
        setattr(message, name, array.array('d', values))
    else:
        setattr(message, name, np.asarray(values, dtype=np.float64))


def set_bytes(message: Any, name: str, values: bytes) -> None:
    """Write a uint8 sequence: array.array for rclpy, numpy for rosbags."""
    if isinstance(getattr(message, name), array.array):
        setattr(message, name, array.array('B', values))
    else:
        setattr(message, name, np.frombuffer(values, dtype=np.uint8))
