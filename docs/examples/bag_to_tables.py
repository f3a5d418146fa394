# SPDX-License-Identifier: Apache-2.0
"""Writes my_log.csv and my_log.npz from a fixture: what a logger of a nine-axis IMU might have left.

Stamps in s, specific force in g, rates in degrees per second, field in µT; the table with a header line.
"""

import sys

import numpy as np

from bag_tools.bag import BagReader

GRAVITY = 9.80665
HEAD = ('t', 'ax', 'ay', 'az', 'gx', 'gy', 'gz', 'mx', 'my', 'mz')


def vector(v) -> list[float]:
    """Return x, y, z of a Vector3."""
    return [v.x, v.y, v.z]


def main() -> None:
    """Read the bag named first; write both files beside."""
    imu, mag = [], {}
    with BagReader(sys.argv[1]) as reader:
        types = {name: topic.type for name, topic in reader.topics.items()}
        for topic, stamp, data in reader.messages(['/imu/data_raw', '/imu/mag']):
            message = reader.decode(data, types[topic])
            if topic == '/imu/mag':
                mag[stamp] = vector(message.magnetic_field)
            else:
                imu.append((stamp, vector(message.linear_acceleration), vector(message.angular_velocity)))
    field = np.array([mag.get(stamp, [np.nan] * 3) for stamp, _, _ in imu])
    table = np.column_stack(
        [
            np.array([(stamp - imu[0][0]) * 1e-9 for stamp, _, _ in imu]),
            np.array([force for _, force, _ in imu]) / GRAVITY,
            np.degrees([rate for _, _, rate in imu]),
            field * 1e6,
        ]
    )
    np.savetxt('my_log.csv', table, fmt='%.9g', delimiter=',', header=','.join(HEAD), comments='')
    np.savez('my_log.npz', t=table[:, 0], acc=table[:, 1:4], gyr=table[:, 4:7], mag=table[:, 7:10])


if __name__ == '__main__':
    main()
