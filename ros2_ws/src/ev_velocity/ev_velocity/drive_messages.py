# SPDX-License-Identifier: Apache-2.0
"""A simulated drive as messages, for bags and for the simulator node."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from ev_velocity.codec import BODY, IMU, JOINTS, TWIST
from ev_velocity.scenarios import GRAVITY, PULSES, Drive
from node_core.messages import set_floats, set_stamp

TWIST_STAMPED = 'geometry_msgs/msg/TwistStamped'
RESOLUTION = 2.0**-8  # m/s², of a 14-bit accelerometer with a range of ±32 m/s²
PEDALS_EVERY = 10  # 50 Hz, as on the car's bus


class DriveMessages:
    """Turns the streams of a `Drive` into messages, in order of arrival.

    `make` gives an empty message by its type, `start` (ns) is the stamp of the drive's beginning, truth is
    said at every `truth_every` fast samples.
    """

    def __init__(self, drive: Drive, make: Callable[[str], Any], start: int, truth_every: int) -> None:
        self._drive = drive
        self._start = start
        self._truth_every = truth_every
        self._imu = make(IMU)
        self._imu.header.frame_id = BODY
        self._imu.orientation_covariance[0] = -1.0
        self._imu.angular_velocity_covariance[0] = -1.0
        self._imu.linear_acceleration_covariance[0] = drive.settings.accelerometer_noise**2
        self._imu.linear_acceleration.z = GRAVITY
        self._gps = make(TWIST)
        self._gps.header.frame_id = 'gps'
        self._gps.twist.covariance[0] = drive.settings.gps_noise**2
        self._encoder = _joints(make, 'encoder')
        self._pedals = _joints(make, 'accelerator', 'brake')
        self._truth = make(TWIST_STAMPED)
        self._truth.header.frame_id = BODY

    topics = (
        ('/imu/data_raw', IMU),
        ('/gps/speed', TWIST),
        ('/wheel/encoder', JOINTS),
        ('/vehicle/pedals', JOINTS),
        ('/truth/velocity', TWIST_STAMPED),
    )

    def __iter__(self) -> Iterator[tuple[int, str, Any]]:
        """Yield (stamp ns, topic, message); the message object is used again."""
        drive = self._drive
        streams = (
            ('/imu/data_raw', drive.t, self._fill_imu, 1),
            ('/gps/speed', drive.gps_t, self._fill_gps, 1),
            ('/wheel/encoder', drive.wheel_t, self._fill_encoder, 1),
            ('/vehicle/pedals', drive.t, self._fill_pedals, PEDALS_EVERY),
            ('/truth/velocity', drive.t, self._fill_truth, self._truth_every),
        )
        events = [
            (self._start + round(float(t) * 1e9), order, i * every, topic, fill)
            for order, (topic, times, fill, every) in enumerate(streams)
            for i, t in enumerate(times[::every])
        ]
        events.sort(key=lambda event: event[:3])
        for stamp, _, index, topic, fill in events:
            message = fill(index)
            set_stamp(message.header, stamp)
            yield stamp, topic, message

    def _fill_imu(self, i: int) -> Any:
        value = float(self._drive.accelerometer[i])
        self._imu.linear_acceleration.x = round(value / RESOLUTION) * RESOLUTION
        return self._imu

    def _fill_gps(self, i: int) -> Any:
        self._gps.twist.twist.linear.x = float(self._drive.gps_v[i])
        return self._gps

    def _fill_encoder(self, i: int) -> Any:
        set_floats(self._encoder, 'position', [float(self._drive.counts[i]) * 2.0 * math.pi / PULSES])
        return self._encoder

    def _fill_pedals(self, i: int) -> Any:
        values = [float(self._drive.accelerator[i]), float(self._drive.brake[i])]
        set_floats(self._pedals, 'position', values)
        return self._pedals

    def _fill_truth(self, i: int) -> Any:
        self._truth.twist.linear.x = float(self._drive.v[i])
        return self._truth


def _joints(make: Callable[[str], Any], *names: str) -> Any:
    message = make(JOINTS)
    message.header.frame_id = BODY
    message.name = list(names)
    return message
