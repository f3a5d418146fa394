# SPDX-License-Identifier: Apache-2.0
"""A receiver that speaks NMEA, or a recording of one, as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ins_gps.nodes.nmea_node import NmeaDriverNode

    return NmeaDriverNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
