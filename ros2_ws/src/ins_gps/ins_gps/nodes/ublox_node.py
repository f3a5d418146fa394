# SPDX-License-Identifier: Apache-2.0
"""The node that reads a u-blox receiver from a file, a serial port or a TCP server."""

from __future__ import annotations

import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from ins_gps import codec
from ins_gps.byte_sources import ByteSource, SourceError, is_recorded, open_source, tcp_address
from ins_gps.params import UbloxParams
from ins_gps.samples import GnssEpoch, ReceiverFix
from ins_gps.ublox import UbloxDecoder
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode

NANOSECONDS = 1_000_000_000
_STALE = 2.5  # s without an epoch, at the slowest usual rate of 1 Hz
_LONGEST_GAP = 10.0  # s, beyond which a recording is not waited for
_END_CHECK = 0.2  # s


class UbloxDriverNode(WorkspaceNode):
    """Reads in a thread of its own. A file goes by its own times; a lost source is opened again."""

    def __init__(self) -> None:
        super().__init__('ublox_driver', UbloxParams)
        self._params = params = self.parameters[UbloxParams]
        self._recorded = is_recorded(params.source)
        self._source = self._first_source()
        self._decoder = UbloxDecoder(
            params.band_numbers,
            atmosphere=params.atmosphere,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
        )
        epochs, self._cloud = self.publish_to(codec.CLOUD, params.topic)
        fixes, self._fix = self.publish_to(codec.FIX, params.fix_topic)
        self._publish_cloud, self._publish_fix = epochs.publish, fixes.publish
        self._error = '' if self._source is not None else f'{params.source}: not open yet'
        self._connections, self._refused, self._over = 0, 0, False
        self._arrived = time.monotonic()
        self._paced: tuple[int, float] | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='ublox', daemon=True)
        self._thread.start()
        self.create_timer(_END_CHECK, self._end, clock=self.steady_clock)

    def _first_source(self) -> ByteSource | None:
        """Open a file now, that a wrong name ends the node; a receiver may come later."""
        source = self._params.source
        if not source:
            raise ParameterError("parameter 'source' is empty, expected a file, a port or tcp://HOST:PORT")
        try:
            if source.startswith('tcp://'):
                tcp_address(source)
            return open_source(source, self._params.baud) if self._recorded else None
        except SourceError as error:
            raise ParameterError(f"parameter 'source': {error}") from None

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if self._source is None:
                    self._source = open_source(self._params.source, self._params.baud)
                    self._connections += 1
                    self._error = ''
                data = self._source.read()
            except SourceError as error:
                self._lose(str(error))
                self._stopping.wait(self._params.reconnect_time)
                continue
            if data is None:
                self._over = True
                return
            for sample in self._decoder.feed(data):
                self._publish(sample)
                if self._stopping.is_set():
                    return

    def _lose(self, error: str) -> None:
        if error != self._error:
            self.get_logger().warning(error)
        self._error = error
        if self._source is not None:
            self._source.close()
            self._source = None

    def _publish(self, sample: GnssEpoch | ReceiverFix) -> None:
        if self._recorded:
            self._wait_for(sample.stamp)
        if isinstance(sample, ReceiverFix):
            codec.encode_receiver_fix(sample, self._fix, self._params.frame)
            self._publish_fix(self._fix)
            return
        codec.encode_observations(sample, self._cloud, self._params.frame)
        self._publish_cloud(self._cloud)
        self._arrived = time.monotonic()

    def _wait_for(self, stamp: int) -> None:
        """Wait until a recorded sample is due; after a leap in time the pace starts anew."""
        now = time.monotonic()
        if self._paced is not None:
            due = self._paced[1] + (stamp - self._paced[0]) / NANOSECONDS / self._params.speed
            if abs(due - now) * self._params.speed <= _LONGEST_GAP:
                self._stopping.wait(max(0.0, due - now))
                return
        self._paced = stamp, now

    def _end(self) -> None:
        if self._over:
            raise SystemExit(0)

    def destroy_node(self) -> None:
        """Stop reading, then close."""
        self._stopping.set()
        self._thread.join(timeout=5.0)
        if self._source is not None and not self._thread.is_alive():
            self._source.close()
        super().destroy_node()

    def diagnose(self) -> DiagnosticArray:
        """Report the source, what was read, and what was refused with its reason."""
        decoder = self._decoder
        missing = decoder.missing
        # Copies in one step each: the reading thread adds reasons meanwhile.
        accepted, rejected, left_out = (
            dict(counts) for counts in (decoder.accepted, decoder.rejected, decoder.left_out)
        )
        values: dict[str, Any] = {'source': self._params.source, 'connections': self._connections}
        values |= accepted
        values |= {f'rejected: {reason}': count for reason, count in rejected.items()}
        values |= {f'left out: {reason}': count for reason, count in left_out.items()}
        values['missing ephemerides'] = ' '.join(missing)
        refused = sum(rejected.values())
        fresh, self._refused = refused > self._refused, refused
        age = time.monotonic() - self._arrived
        level, text = OK, 'ok'
        if self._error:
            level, text = ERROR, self._error
        elif not self._recorded and age > _STALE:
            level, text = ERROR, f'no RXM-RAWX with a time for {age:.0f} s'
        elif missing:
            level, text = WARN, f'{len(missing)} satellites without ephemeris'
        elif fresh:
            level, text = WARN, 'messages were rejected'
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, values)])
