# SPDX-License-Identifier: Apache-2.0
"""The bridge display in the browser as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ship_inclinometer.nodes.display_node import DisplayNode

    return DisplayNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
