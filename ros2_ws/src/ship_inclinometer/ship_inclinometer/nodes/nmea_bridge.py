# SPDX-License-Identifier: Apache-2.0
"""The NMEA 0183 bridge as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ship_inclinometer.nodes.nmea_node import NmeaNode

    return NmeaNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
