# SPDX-License-Identifier: Apache-2.0
"""A small driver: publishes every line of its source; for the tests of the base of drivers."""

import sys

from node_core.byte_node import ByteNode
from node_core.byte_params import StreamParams
from node_core.spin import run


class Line:
    def __init__(self, text):
        self.text = text
        self.stamp = int(text.split()[0]) if text[:1].isdigit() else 0


class LineNode(ByteNode):
    what = 'line'

    def __init__(self):
        super().__init__('line_driver', StreamParams)
        self._rest = b''
        lines, self._message = self.publish_to('std_msgs/msg/String', 'lines')
        self._send = lines.publish
        self.begin_bytes(lines)

    def samples(self, item, arrival):
        *lines, self._rest = (self._rest + item).split(b'\n')
        return [Line(line.decode()) for line in lines]

    def publish(self, sample):
        if sample.text == 'fault':
            raise RuntimeError('a fault of the program')
        self._message.data = sample.text
        self._send(self._message)
        return True


if __name__ == '__main__':
    sys.exit(run(LineNode))
