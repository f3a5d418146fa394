# SPDX-License-Identifier: Apache-2.0
"""A DGPS base as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from ins_gps.codec import BASE_PORTS
    from node_core.node import EstimatorNode

    return EstimatorNode(BASE_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
