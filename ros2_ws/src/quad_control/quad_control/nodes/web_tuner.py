# SPDX-License-Identifier: Apache-2.0
"""Entry point of the node web_tuner."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from quad_control.nodes.web_tuner_node import build_node

    return build_node()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
