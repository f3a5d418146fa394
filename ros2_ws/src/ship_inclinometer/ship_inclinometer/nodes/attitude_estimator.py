# SPDX-License-Identifier: Apache-2.0
"""The attitude estimator as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from node_core.node import EstimatorNode
    from ship_inclinometer.codec import ATTITUDE_PORTS

    return EstimatorNode(ATTITUDE_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
