# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures of this package, each written from a seed by one function."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bag_tools.bag import BagWriter, zeroed
from ev_velocity.codec import BODY, IMU, JOINTS, TWIST
from ev_velocity.scenarios import PULSES, SCENARIOS, Drive, simulate
from node_core.messages import set_floats, set_stamp

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
TWIST_STAMPED = 'geometry_msgs/msg/TwistStamped'
RESOLUTION = 2.0**-8  # m/s², of a 14-bit accelerometer with a range of ±32 m/s²
TRUTH_EVERY = 10  # 50 Hz
PEDALS_EVERY = 10  # 50 Hz, as on the car's bus


class DriveMessages:
    """Turns the streams of a `Drive` into messages, in order of arrival."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._imu = zeroed(IMU)
        self._imu.header.frame_id = BODY
        self._imu.orientation_covariance[0] = -1.0
        self._imu.angular_velocity_covariance[0] = -1.0
        self._imu.linear_acceleration_covariance[0] = drive.settings.accelerometer_noise**2
        self._imu.linear_acceleration.z = 9.80665
        self._gps = zeroed(TWIST)
        self._gps.header.frame_id = 'gps'
        self._gps.twist.covariance[0] = drive.settings.gps_noise**2
        self._encoder = _joints('encoder')
        self._pedals = _joints('accelerator', 'brake')
        self._truth = zeroed(TWIST_STAMPED)
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
            ('/truth/velocity', drive.t, self._fill_truth, TRUTH_EVERY),
        )
        events = [
            (START + round(float(t) * 1e9), order, i * every, topic, fill)
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


def _joints(*names: str) -> Any:
    message = zeroed(JOINTS)
    message.header.frame_id = BODY
    message.name = list(names)
    return message


def write_drive(path: Path, drive: Drive) -> None:
    """Write a drive into a bag (mcap, zstd) at `path`."""
    messages = DriveMessages(drive)
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
