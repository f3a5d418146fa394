# SPDX-License-Identifier: Apache-2.0
"""The paper's two-state filter for roll and pitch as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from imu_kalman.codec import ANGLE_PORTS
    from node_core.node import EstimatorNode

    return EstimatorNode(ANGLE_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
