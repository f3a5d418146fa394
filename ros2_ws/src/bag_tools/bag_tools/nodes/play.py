# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools play BAG``: publish a bag."""

from __future__ import annotations

import os
import signal
import sys

# Imports stand in the functions: they take a second, and Ctrl-C in that second has to be as clean as later.


def run(argv: list[str]) -> int:
    """Play as the command line says."""
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError
    from rclpy.executors import ExternalShutdownException

    from bag_tools import rosargs
    from bag_tools.bag import BagReader
    from bag_tools.cli import Progress
    from bag_tools.nodes.player import Player
    from bag_tools.play import options_from
    from node_core.spin import Interrupt

    own, ros = rosargs.split(argv)
    options = options_from(own)
    with BagReader(options.bag) as reader:
        interrupt = Interrupt().install()
        interrupt.watched = True
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
        except RCLError:
            if rclpy.ok():  # else the signal came within a call of ROS
                raise
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    # An interrupted import of a compiled module does not always surface as KeyboardInterrupt.
    signal.signal(signal.SIGINT, lambda _number, _frame: os._exit(0))
    from bag_tools.cli import guarded

    return guarded('play', run, argv, interrupted=0)


if __name__ == '__main__':
    sys.exit(main())
