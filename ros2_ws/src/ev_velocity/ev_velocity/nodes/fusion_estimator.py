# SPDX-License-Identifier: Apache-2.0
"""The paper's fusion as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from ev_velocity.codec import FUSION_PORTS
    from node_core.node import EstimatorNode

    return EstimatorNode(FUSION_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
