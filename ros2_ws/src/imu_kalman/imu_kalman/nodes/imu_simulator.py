# SPDX-License-Identifier: Apache-2.0
"""A simulated inertial and magnetic sensor as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from imu_kalman.nodes.simulator_node import ImuSimulatorNode

    return ImuSimulatorNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
