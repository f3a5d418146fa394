# SPDX-License-Identifier: Apache-2.0
"""The node that reads a GPS receiver's speed."""

from __future__ import annotations

import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from ev_velocity.codec import TWIST
from ev_velocity.driver_codec import encode_gps
from ev_velocity.gps_source import FileSource, Source, SourceError, open_source
from ev_velocity.gps_stream import GpsSpeed, GpsStream
from ev_velocity.sim_params import GpsParams
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode

STALE = 2_500_000_000  # ns without a speed, at the slowest usual rate of 1 Hz


class GpsDriverNode(WorkspaceNode):
    """Reads in a thread of its own. A file goes by its own times; a lost source is opened again."""

    def __init__(self) -> None:
        super().__init__('gps_driver', GpsParams)
        self._params = params = self.parameters[GpsParams]
        self._publisher, self._message = self.publish_to(TWIST, 'gps/speed')
        self._stream = GpsStream(params.nmea_sigma)
        self._state, self._over, self._last = 'waiting for a speed', False, 0
        self._paced: tuple[int, float] | None = None
        self._stopping = threading.Event()
        try:
            self._source: Source | None = open_source(params.source, params.baud)
        except SourceError as error:
            if 'expected' in str(error):
                raise ParameterError(f'source: {error}') from None
            self._source, self._state = None, str(error)
        self._thread = threading.Thread(target=self._run, name='gps', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if self._source is None:
                    self._source = open_source(self._params.source, self._params.baud)
                data = self._source.read()
            except SourceError as error:
                self._state = str(error)
                self._close()
                self._stopping.wait(self._params.reconnect_time)
                continue
            if data is None:
                self._over, self._state = True, 'the file is over'
                self.get_logger().info(self._state)
                return
            arrival = self.get_clock().now().nanoseconds
            for speed in self._stream.feed(data):
                self._publish(speed, arrival)

    def _publish(self, speed: GpsSpeed, arrival: int) -> None:
        recorded = isinstance(self._source, FileSource)
        if recorded and not self._wait_for(speed.utc):
            return
        # The bytes of a file have no arrival: only the receiver's own time says when they were valid.
        stamp = speed.utc if recorded or self._params.stamp_source == 'message' else arrival
        if stamp <= 0:
            self._stream.rejected['no time'] += 1
            return
        encode_gps(speed, self._message, stamp, self._params.frame_id)
        self._publisher.publish(self._message)
        self._state, self._last = 'ok', time.monotonic_ns()

    def _wait_for(self, utc: int) -> bool:
        """Wait until a recorded speed is due; False when the node stops meanwhile."""
        rate = self._params.replay_rate
        if rate <= 0.0 or utc <= 0:
            return True
        if self._paced is None:
            self._paced = utc, time.monotonic()
        due = self._paced[1] + (utc - self._paced[0]) * 1e-9 / rate
        return not self._stopping.wait(max(0.0, due - time.monotonic()))

    def _close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None

    def destroy_node(self) -> None:
        """Stop reading, then close."""
        self._stopping.set()
        self._thread.join(timeout=2.0)
        self._close()
        super().destroy_node()

    def diagnose(self) -> DiagnosticArray:
        """Report the source, what was read and what was refused with its reason."""
        values: dict[str, Any] = {'state': self._state, 'speeds': self._stream.accepted}
        values |= dict(self._stream.rejected)
        name = self.get_fully_qualified_name().lstrip('/')
        if self._source is None and not self._over:
            level, text = ERROR, self._state
        elif not self._over and time.monotonic_ns() - self._last > STALE:
            level, text = WARN, 'no speed'
        else:
            level, text = OK, self._state
        return DiagnosticArray(status=[status(name, level, text, values)])
