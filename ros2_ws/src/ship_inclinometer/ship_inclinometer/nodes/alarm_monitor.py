# SPDX-License-Identifier: Apache-2.0
"""The alarm monitor as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ship_inclinometer.nodes.alarm_node import AlarmNode

    return AlarmNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
