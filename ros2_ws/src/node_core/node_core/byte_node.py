# SPDX-License-Identifier: Apache-2.0
"""The base of drivers: reads a device or a recording in a thread of its own and publishes what it says."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.publisher import Publisher

from kalman_core.parameters import ParameterError
from node_core.byte_params import RecordingParams, StreamParams
from node_core.byte_replay import Audience, Pace
from node_core.byte_sources import Source, SourceError, is_recorded, open_source, public_name
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode

_STALE = 2.5  # s without a sample, at the slowest usual rate of 1 Hz
_END_CHECK = 0.1  # s
LAST_WORDS = Duration(seconds=5.0)  # for subscribers to take the last samples of a recording
_JOIN = 5.0  # s


class SourceNode(WorkspaceNode, ABC):
    """Reads a source in a thread; a recording goes by its own times, a lost device is opened again.

    Subclasses say where items come from (`open`), make samples of them (`samples`), publish those
    (`publish`) and call `begin` once they are set up. `what` names the samples in messages. A recording
    starts when somebody listens, and the node ends with code 0 at its end. A device that is missing, lost
    or silent is said on the terminal once, and when it is back.
    """

    what = 'sample'

    def __init__(self, name: str, params: type[RecordingParams]) -> None:
        super().__init__(name, params)
        self.params: Any = self.parameters[params]
        self.recorded = False
        self.source_name = ''
        self._source: Source[Any] | None = None
        self._error = ''
        self._state = OK
        self._connections, self._published = 0, 0
        self._refused: Counter[str] = Counter()
        self._arrived = time.monotonic()
        self._over = False
        self._failure: BaseException | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def begin(self, source_name: str, *publishers: Publisher, recorded: bool) -> None:
        """Start reading. A recording is opened now, so that a wrong name ends the node; a device may come."""
        self.source_name, self.recorded = source_name, recorded
        self._publishers = list(publishers)
        self._error = '' if recorded else f'{source_name}: not open yet'
        if recorded:
            self._source = self.open()
        self._thread.start()
        self.create_timer(_END_CHECK, self._end, clock=self.steady_clock)

    @abstractmethod
    def open(self) -> Source[Any]:
        """Return the open source; SourceError if it cannot be, ParameterError if it never will."""

    @abstractmethod
    def samples(self, item: Any, arrival: int) -> Iterable[Any]:
        """Return the samples that `item`, which came at `arrival` (ns, the node's clock), completes."""

    def rest(self) -> Iterable[Any]:
        """Return the samples that were held back, at the end of a recording."""
        return ()

    def recorded_time(self, sample: Any) -> int:
        """Return when (ns) a sample of a recording is due."""
        return sample.stamp

    @abstractmethod
    def publish(self, sample: Any) -> bool:
        """Publish one sample; return whether it shows that the device does what it should."""

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Return level, text and values for /diagnostics, apart from what the source itself is like."""
        return OK, 'ok', {}

    def rejected(self) -> dict[str, int]:
        """Return how much was refused, by reason."""
        return {}

    def _run(self) -> None:
        try:
            if self.recorded:
                Audience(self, self._publishers).wait(self.params.wait_for_subscribers, self._stopping)
            self._read(Pace(self.params.replay_rate))
        except Exception as error:
            # A fault of the program must not leave a node that looks alive: `_end` raises it again. What
            # Ctrl-C takes away under the thread is none.
            if not self._stopping.is_set() and self.context.ok():
                self._failure = error

    def _read(self, pace: Pace) -> None:
        while not self._stopping.is_set():
            try:
                if self._source is None:
                    self._source = self.open()
                    self._connections += 1
                    self._opened()
                item = self._source.read()
            except SourceError as error:
                if self.recorded:
                    raise
                self._lose(str(error))
                self._stopping.wait(self.params.reconnect_time)
                continue
            if item is None:
                self._take(self.rest(), pace)
                self._finish()
                return
            if item:
                self._take(self.samples(item, self.get_clock().now().nanoseconds), pace)

    def _take(self, samples: Iterable[Any], pace: Pace) -> None:
        for sample in samples:
            if self.recorded:
                pace.wait(self.recorded_time(sample), self._stopping)
            if self._stopping.is_set():
                return
            if self.publish(sample):
                self._published += 1
                self._arrived = time.monotonic()

    def _opened(self) -> None:
        self._error = ''
        self._arrived = time.monotonic()
        self.get_logger().info(f'{self.source_name}: open')

    def _lose(self, error: str) -> None:
        # After Ctrl-C there is no terminal of ROS to say it on.
        if error != self._error and self.context.ok():
            self.get_logger().warning(f'{error}; tried again every {self.params.reconnect_time:g} s')
        self._error = error
        if self._source is not None:
            self._source.close()
            self._source = None

    def _finish(self) -> None:
        # What a reliable writer still holds dies with it.
        for publisher in self._publishers:
            publisher.wait_for_all_acked(LAST_WORDS)
        self.get_logger().info(f'{self.source_name}: over, {self._published} x {self.what}')
        self._over = True

    def _end(self) -> None:
        if isinstance(self._failure, SourceError):
            raise ParameterError(str(self._failure))
        if self._failure is not None:
            raise self._failure
        if self._over:
            raise SystemExit(0)

    def destroy_node(self) -> None:
        """Stop reading, then close."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=_JOIN)
        if self._source is not None and not self._thread.is_alive():
            self._source.close()
        super().destroy_node()

    def diagnose(self) -> DiagnosticArray:
        """Report the source, what was read, and what was refused with its reason."""
        level, text, values = self.report()
        rejected = Counter(self.rejected())
        fresh = rejected - self._refused
        self._refused = rejected
        age = time.monotonic() - self._arrived
        if self._error:
            level, text = ERROR, self._error
        elif not self.recorded and age > _STALE:
            level, text = ERROR, f'{self.source_name}: no {self.what} for {age:.0f} s'
        elif fresh and level == OK:
            level, text = WARN, f'{fresh.total()} rejected, mostly: {fresh.most_common(1)[0][0]}'
        self._say(level, text)
        counts = {'source': self.source_name, 'connections': self._connections, 'published': self._published}
        reasons = {f'rejected: {reason}': count for reason, count in sorted(rejected.items())}
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, counts | values | reasons)])

    def _say(self, level: bytes, text: str) -> None:
        """Say on the terminal that an open device falls silent, and that it speaks again."""
        silent = level == ERROR and not self._error
        if silent and self._state != ERROR:
            self.get_logger().warning(text)
        elif level != ERROR and self._state == ERROR:
            self.get_logger().info(f'{self.source_name}: {self.what} again')
        if silent or level != ERROR:
            self._state = level


class ByteNode(SourceNode):
    """A `SourceNode` whose items are bytes of the source that `StreamParams` name."""

    params: StreamParams

    def begin_bytes(self, *publishers: Publisher) -> None:
        """Start reading; ParameterError names a source that is empty, malformed or a missing file."""
        source = self.params.source
        if not source:
            raise ParameterError("parameter 'source' is empty, expected a file, a port or tcp://HOST:PORT")
        try:
            self.begin(public_name(source), *publishers, recorded=is_recorded(source))
        except SourceError as error:
            raise ParameterError(f"parameter 'source': {error}") from None

    def open(self) -> Source[bytes]:
        """Open the source."""
        return open_source(self.params.source, self.params.baud, self.recorded)
