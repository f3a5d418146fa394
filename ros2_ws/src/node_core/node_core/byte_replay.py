# SPDX-License-Identifier: Apache-2.0
"""When a recording starts, and when each of its samples is due."""

from __future__ import annotations

import threading
import time

from rclpy.node import Node
from rclpy.publisher import Publisher

NANOSECONDS = 1_000_000_000
_LOOK = 0.05  # s between two looks at the graph
# Subscriptions of one process are discovered one after the other, on a loaded machine with pauses: none must
# have come for this long.
_SETTLED = 1.0  # s
_LONGEST_GAP = 10.0  # s of a recording, beyond which a gap is not waited for


class Audience:
    """Who listens to some publishers: a recording that starts before DDS has matched them is lost on them."""

    def __init__(self, node: Node, publishers: list[Publisher]) -> None:
        self._node = node
        self._publishers = publishers

    def wait(self, limit: float, stopping: threading.Event) -> bool:
        """Wait until somebody listens and every discovered subscription is matched, at most `limit` (s).

        Returns whether that is so. Says once, at INFO, what it waits for.
        """
        if limit <= 0.0:
            return False
        topics = ', '.join(f"'{publisher.topic_name}'" for publisher in self._publishers)
        self._node.get_logger().info(
            f'the recording starts once somebody subscribes to {topics}, at the latest in {limit:g} s '
            "(parameter 'wait_for_subscribers')"
        )
        end = time.monotonic() + limit
        seen, since = self._matched(), time.monotonic()
        while not stopping.wait(_LOOK):
            now = time.monotonic()
            matched = self._matched()
            if matched != seen:
                seen, since = matched, now
            met = all(ours >= there for ours, there in zip(matched, self._discovered(), strict=True))
            if any(matched) and met and now - since >= _SETTLED:
                return True
            if now > end:
                return False
        return False

    def _matched(self) -> list[int]:
        return [publisher.get_subscription_count() for publisher in self._publishers]

    def _discovered(self) -> list[int]:
        return [self._node.count_subscribers(publisher.topic_name) for publisher in self._publishers]


class Pace:
    """Holds samples of a recording until they are due; after a leap in time the pace starts anew."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._start: tuple[int, float] | None = None

    def wait(self, stamp: int, stopping: threading.Event) -> None:
        """Wait until a sample of the recorded time `stamp` (ns) is due; not for one without time (0)."""
        if self._rate <= 0.0 or stamp <= 0:
            return
        now = time.monotonic()
        if self._start is not None:
            due = self._start[1] + (stamp - self._start[0]) / NANOSECONDS / self._rate
            if abs(due - now) * self._rate <= _LONGEST_GAP:
                stopping.wait(max(0.0, due - now))
                return
        self._start = stamp, now
