# SPDX-License-Identifier: Apache-2.0
"""The 6- or 9-axis error-state filter as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from imu_kalman.codec import ATTITUDE_PORTS
    from node_core.node import EstimatorNode

    return EstimatorNode(ATTITUDE_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
