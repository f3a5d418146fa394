# SPDX-License-Identifier: Apache-2.0
"""Calibration from a bag: `ros2 run ship_inclinometer calibration BAG --out calibration.yaml`."""

import sys


def main() -> None:
    """Run the command."""
    from ship_inclinometer.calibrate_bag import command

    sys.exit(command(sys.argv[1:]))
