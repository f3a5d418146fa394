# SPDX-License-Identifier: Apache-2.0
"""An RTCM stream, or a recording of one, as a node."""

import sys

from node_core.spin import run


def build():
    """Return the node; imports are here so that Ctrl-C while modules load is clean too."""
    from ins_gps.nodes.rtcm_node import RtcmDriverNode

    return RtcmDriverNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
