# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools play BAG``: publish a bag."""

from __future__ import annotations

import sys

import rclpy
from rclpy.executors import ExternalShutdownException

from bag_tools import rosargs
from bag_tools.bag import BagReader
from bag_tools.cli import Progress, guarded
from bag_tools.play import options_from


def run(argv: list[str]) -> int:
    """Play as the command line says."""
    from bag_tools.nodes.player import Player

    own, ros = rosargs.split(argv)
    options = options_from(own)
    with BagReader(options.bag) as reader:
        rclpy.init(args=['--ros-args', *ros] if ros else [])
        node = None
        try:
            node = Player(reader, options)
            node.start()
            with Progress('playing', 1.0) as progress:
                node.play(progress.update if options.progress else lambda _share: None)
            print(f'played {node.played} messages of {options.bag}')
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('play', run, argv)


if __name__ == '__main__':
    sys.exit(main())
