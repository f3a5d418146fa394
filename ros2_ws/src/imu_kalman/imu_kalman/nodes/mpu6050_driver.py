# SPDX-License-Identifier: Apache-2.0
"""An MPU6050 on an I2C bus, or a simulated one, as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from imu_kalman.nodes.mpu6050_node import Mpu6050Node

    return Mpu6050Node()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
