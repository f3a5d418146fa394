# SPDX-License-Identifier: Apache-2.0
"""What a replay without DDS costs, beside rosbags merely reading, decoding and writing the same bag."""

import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bag_tools.bag import BagWriter, zeroed
from bag_tools.bench import Options, Row
from bag_tools.offline import offline
from imu_kalman.codec import ESTIMATORS

RATE = 200  # Hz, IMU and magnetometer alike
SECOND = 1_000_000_000
ROUNDS = 5


def _make_bag(path: Path, seconds: int) -> int:
    """Write a hand-held 9-axis sensor that turns slowly; return the number of messages."""
    rng = np.random.default_rng(0)
    imu, mag = zeroed('sensor_msgs/msg/Imu'), zeroed('sensor_msgs/msg/MagneticField')
    with BagWriter(path) as bag:
        bag.add('imu/data_raw', 'sensor_msgs/msg/Imu')
        bag.add('imu/mag', 'sensor_msgs/msg/MagneticField')
        for k in range(seconds * RATE):
            stamp = SECOND + k * (SECOND // RATE)
            for message in (imu, mag):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
            noise = rng.normal(size=9)
            angle = 0.3 * np.sin(k / RATE)
            imu.angular_velocity.x = float(0.3 * np.cos(k / RATE) + 0.002 * noise[0])
            imu.angular_velocity.y, imu.angular_velocity.z = (float(v) for v in 0.002 * noise[1:3])
            imu.linear_acceleration.x = float(0.03 * noise[3])
            imu.linear_acceleration.y = float(9.81 * np.sin(angle) + 0.03 * noise[4])
            imu.linear_acceleration.z = float(9.81 * np.cos(angle) + 0.03 * noise[5])
            mag.magnetic_field.y = float(20e-6 * np.cos(angle) - 45e-6 * np.sin(angle) + 5e-7 * noise[7])
            mag.magnetic_field.z = float(-45e-6 * np.cos(angle) - 20e-6 * np.sin(angle) + 5e-7 * noise[8])
            mag.magnetic_field.x = float(5e-7 * noise[6])
            bag.write('/imu/data_raw', stamp, imu)
            bag.write('/imu/mag', stamp, mag)
    return 2 * seconds * RATE


def _rosbags(source: Path, target: Path) -> None:
    """Read, decode and write with rosbags alone."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(source) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        copies = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections
        }
        for connection, stamp, data in reader.messages():
            store.deserialize_cdr(data, connection.msgtype)
            writer.write(copies[connection.id], stamp, data)


def _seconds(work, *arguments) -> float:
    # Processor time: the ratio must not depend on what else the machine does.
    start = time.process_time()
    work(*arguments)
    return time.process_time() - start


def measure(options: Options) -> Iterable[Row]:
    """Measure the ratio for the estimators of imu_kalman; the median over rounds that alternate."""
    if not options.live:
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        count = _make_bag(folder / 'in', 20 if options.quick else 60)
        for estimator in ('attitude_estimator', 'angle_estimator'):
            ports = ESTIMATORS[estimator]
            offline(ports, {}, folder / 'in', folder / 'warm', overwrite=True)
            ours, theirs = [], []
            for k in range(2 if options.quick else ROUNDS):
                theirs.append(_seconds(_rosbags, folder / 'in', folder / f'{estimator}_{k}'))
                ours.append(_seconds(offline, ports, {}, folder / 'in', folder / f'{estimator}_{k}_ours'))
            yield Row(
                'bag_tools',
                f'offline replay of {estimator}: time over rosbags read, decode and write',
                float(np.median(np.array(ours) / np.array(theirs))),
                '',
                bar=2.0,
                reference={'rosbags [µs/message]': float(np.median(theirs)) / count * 1e6},
            )
