# SPDX-License-Identifier: Apache-2.0
"""Writes a fixture as another driver might have recorded it; it stands for your bag.

The IMU on /sensor/imu: axes forward-right-down, specific force in g, rates in degrees per second, stamps of
zero. All other topics as they are.
"""

import math
import sys

from bag_tools.bag import BagReader, BagWriter

GRAVITY = 9.80665
NAMES = {'/imu/data_raw': '/sensor/imu'}


def spoil(message) -> None:
    """Give an Imu the driver's axes and units, and no stamp."""
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    for vector, unit in ((message.angular_velocity, math.pi / 180), (message.linear_acceleration, GRAVITY)):
        vector.x, vector.y, vector.z = vector.x / unit, -vector.y / unit, -vector.z / unit


def main() -> None:
    """Read the bag named first; write the one named second."""
    with BagReader(sys.argv[1]) as reader, BagWriter(sys.argv[2]) as bag:
        for name, topic in reader.topics.items():
            bag.add(NAMES.get(name, name), topic.type)
        for name, bag_time, data in reader.messages():
            message = reader.decode(data, reader.topics[name].type)
            if name in NAMES:
                spoil(message)
            bag.write(NAMES.get(name, name), bag_time, message)


if __name__ == '__main__':
    main()
