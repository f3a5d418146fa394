# SPDX-License-Identifier: Apache-2.0
"""A car's CAN bus, live or from a log, as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ev_velocity.nodes.can_node import CanDriverNode

    return CanDriverNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
