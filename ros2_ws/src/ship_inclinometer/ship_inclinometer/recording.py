# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings as messages in order of time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from kalman_core.rotation import quat_from_euler
from node_core.messages import set3, set_quaternion, set_stamp
from ship_inclinometer import codec, topics
from ship_inclinometer.simulation import Recording

TRUTH = 'truth/orientation'
TRUTH_TYPE = 'geometry_msgs/msg/QuaternionStamped'
TYPES = {
    topics.IMU: codec.IMU,
    topics.MAG: codec.FIELD,
    topics.GNSS: codec.TWIST,
    topics.LOG: codec.TWIST,
    TRUTH: TRUTH_TYPE,
}
_FRAME = 'imu_link'


def events(recording: Recording, start: int, truth_every: int = 1) -> Iterator[tuple[int, str, int]]:
    """Yield (stamp in ns, topic, index) of all samples in order of time, from `start` on.

    Truth stands beside each `truth_every`-th IMU sample.
    """
    times = (recording.truth.t, recording.magnetometer_t, recording.gnss_t, recording.log_t)
    rows: list[tuple[int, int, int]] = []
    for port, values in enumerate(times):
        stamps = start + np.round(values * 1e9).astype(np.int64)
        rows += [(stamp, port, i) for i, stamp in enumerate(stamps.tolist())]
    names = (topics.IMU, topics.MAG, topics.GNSS, topics.LOG)
    for stamp, port, index in sorted(rows):
        yield stamp, names[port], index
        if port == 0 and index % truth_every == 0:
            yield stamp, TRUTH, index


def fill(recording: Recording, topic: str, index: int, stamp: int, message: Any) -> None:
    """Write one sample into a message of the topic's type."""
    set_stamp(message.header, stamp)
    message.header.frame_id = _FRAME
    params = recording.params
    if topic == topics.IMU:
        set3(message.angular_velocity, recording.gyro[index])
        set3(message.linear_acceleration, recording.accelerometer[index])
        message.orientation_covariance[0] = -1.0
        message.angular_velocity_covariance[:] = _diagonal(np.radians(params.gyro_noise) ** 2)
        message.linear_acceleration_covariance[:] = _diagonal((9.8e-3 * params.accelerometer_noise[0]) ** 2)
    elif topic == topics.MAG:
        set3(message.magnetic_field, recording.magnetometer[index])
        message.magnetic_field_covariance[:] = _diagonal((1e-7 * params.magnetometer_noise) ** 2)
    elif topic == TRUTH:
        message.header.frame_id = 'map'
        set_quaternion(message.quaternion, quat_from_euler(*recording.truth.angles[index]))
    else:
        gnss = topic == topics.GNSS
        message.header.frame_id = 'map' if gnss else _FRAME
        velocity = recording.gnss_velocity[index] if gnss else (recording.log_speed[index], 0.0, 0.0)
        set3(message.twist.twist.linear, velocity)
        variance = (params.gnss_noise if gnss else params.log_noise) ** 2
        message.twist.covariance[:] = (np.diag([variance] * 3 + [0.0] * 3)).ravel()


def _diagonal(variance: float) -> np.ndarray:
    return np.diag([variance] * 3).ravel()
