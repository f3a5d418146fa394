# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools record BAG TOPIC ...``: record a graph."""

from __future__ import annotations

import signal
import sys

# Imports stand in the functions: they take a second, and Ctrl-C in that second has to be as clean as later.


def run(argv: list[str]) -> int:
    """Record as the command line says."""
    stop: list[int] = []
    # rclpy's own handler would invalidate the context before the last messages are taken.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _frame: stop.append(received))
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from bag_tools import rosargs
    from bag_tools.bag import BagWriter
    from bag_tools.nodes.recorder import Recorder, record
    from bag_tools.record import options_from

    own, ros = rosargs.split(argv)
    options = options_from(own)
    rclpy.init(args=['--ros-args', *ros] if ros else [], signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        with BagWriter(
            options.bag,
            storage=options.storage,
            compression=options.compression,
            overwrite=options.overwrite,
            salvage=True,
        ) as writer:
            node = Recorder(options, writer)
            record(node, options, stop)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    print(f'recorded {sum(writer.counts.values())} messages to {options.bag}')
    for topic, count in writer.counts.items():
        print(f'{count:8d}  {topic}')
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    try:
        from bag_tools.cli import guarded

        return guarded('record', run, argv, interrupted=0)
    except KeyboardInterrupt:
        return 0


if __name__ == '__main__':
    sys.exit(main())
