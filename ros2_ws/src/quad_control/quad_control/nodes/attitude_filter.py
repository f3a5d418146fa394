# SPDX-License-Identifier: Apache-2.0
"""The attitude filter as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from node_core.node import EstimatorNode
    from quad_control.codec import FILTER_PORTS

    return EstimatorNode(FILTER_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
