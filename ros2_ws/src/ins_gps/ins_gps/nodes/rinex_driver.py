# SPDX-License-Identifier: Apache-2.0
"""RINEX files as a receiver node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ins_gps.nodes.replay_nodes import RinexDriverNode

    return RinexDriverNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
