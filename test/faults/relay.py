# SPDX-License-Identifier: Apache-2.0
"""A relay that faults one topic of Imu messages between two counts, and passes all else on as it is.

As a node: ``relay.py FAULT FIRST LAST SEED IN OUT``. Messages are counted, not timed: the same input gives
the same output on any machine.
"""

from __future__ import annotations

import math
import random
import sys
from typing import Any

from node_core.messages import set3, set_stamp, stamp_of
from node_core.spin import run

IMU = 'sensor_msgs/msg/Imu'
# One message in three is corrupted: a filter that holds on for the other two must do so.
_CORRUPTED_EVERY = 3
_DROPPED = 0.3  # share of messages
_HELD = 20  # messages that a delay holds back
_BLOCK = 5  # messages that are shuffled among themselves
_HUGE = 1e30
_FOREIGN_FRAME = 'somewhere_else'


def _not_a_number(message: Any) -> None:
    set3(message.angular_velocity, (math.nan, 0.0, 0.0))
    set3(message.linear_acceleration, (math.nan, 0.0, math.nan))


def _infinite(message: Any) -> None:
    set3(message.linear_acceleration, (math.inf, -math.inf, 0.0))


def _huge(message: Any) -> None:
    set3(message.angular_velocity, (_HUGE, -_HUGE, _HUGE))
    set3(message.linear_acceleration, (_HUGE, _HUGE, -_HUGE))


def _zero_force(message: Any) -> None:
    set3(message.linear_acceleration, (0.0, 0.0, 0.0))


def _zero_stamp(message: Any) -> None:
    set_stamp(message.header, 0)


def _far_future(message: Any) -> None:
    set_stamp(message.header, stamp_of(message) + 3600 * 1_000_000_000)


CORRUPTIONS = {
    'nan': _not_a_number,
    'infinite': _infinite,
    'huge': _huge,
    'zero_force': _zero_force,
    'zero_stamp': _zero_stamp,
    'future_stamp': _far_future,
}
FAULTS = ('drop', 'delay', 'duplicate', 'reorder', 'silence', *CORRUPTIONS)


class Injector:
    """Takes one message after the other and returns what is to be sent instead.

    Message number `first` (from 0) is the first that may be faulted, `last` the first that is not any more;
    with it everything held back is let go.
    """

    def __init__(self, fault: str, first: int, last: int, seed: int = 0) -> None:
        if fault not in FAULTS:
            raise ValueError(f"no fault '{fault}'; known: {', '.join(FAULTS)}")
        self._fault = fault
        self._first, self._last = first, last
        self._random = random.Random(seed)
        self._count = 0
        self._held: list[Any] = []

    def __call__(self, message: Any) -> list[Any]:
        """Return the messages to send now; a corrupted one is changed in place."""
        number = self._count
        self._count += 1
        if number < self._first:
            return [message]
        if number >= self._last:
            released, self._held = self._held, []
            return [*released, message]
        if self._fault in CORRUPTIONS:
            if number % _CORRUPTED_EVERY == 0:
                CORRUPTIONS[self._fault](message)
            return [message]
        return getattr(self, f'_{self._fault}')(message)

    def _silence(self, _message: Any) -> list[Any]:
        return []

    def _drop(self, message: Any) -> list[Any]:
        return [] if self._random.random() < _DROPPED else [message]

    def _duplicate(self, message: Any) -> list[Any]:
        return [message, message]

    def _delay(self, message: Any) -> list[Any]:
        self._held.append(message)
        return [self._held.pop(0)] if len(self._held) > _HELD else []

    def _reorder(self, message: Any) -> list[Any]:
        self._held.append(message)
        if len(self._held) < _BLOCK:
            return []
        block, self._held = self._held, []
        self._random.shuffle(block)
        return block


def build() -> Any:
    """Return the node."""
    from node_core.node import WorkspaceNode

    fault, first, last, seed, source, target = sys.argv[1:7]
    injector = Injector(fault, int(first), int(last), int(seed))

    class Relay(WorkspaceNode):
        def __init__(self) -> None:
            super().__init__('fault_relay')
            publisher, _ = self.publish_to(IMU, target)

            def relay(message: Any) -> None:
                for sent in injector(message):
                    publisher.publish(sent)

            self.listen(IMU, source, relay)

    return Relay()


if __name__ == '__main__':
    sys.exit(run(build))
