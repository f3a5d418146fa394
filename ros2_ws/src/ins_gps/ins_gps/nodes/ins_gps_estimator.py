# SPDX-License-Identifier: Apache-2.0
"""The navigation filter as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from ins_gps.codec import INS_GPS_PORTS
    from node_core.node import EstimatorNode

    return EstimatorNode(INS_GPS_PORTS)


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
