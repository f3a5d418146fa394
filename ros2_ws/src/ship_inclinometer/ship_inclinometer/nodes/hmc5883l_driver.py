# SPDX-License-Identifier: Apache-2.0
"""An HMC5883L on an I2C bus, or a simulated one, as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ship_inclinometer.nodes.hmc5883l_node import Hmc5883lNode

    return Hmc5883lNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
