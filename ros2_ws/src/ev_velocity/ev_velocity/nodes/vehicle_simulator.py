# SPDX-License-Identifier: Apache-2.0
"""A simulated electric car with its sensors as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ev_velocity.nodes.simulator_node import VehicleSimulatorNode

    return VehicleSimulatorNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
