# SPDX-License-Identifier: Apache-2.0
"""The node that reads a GPS receiver's speed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ev_velocity.codec import TWIST
from ev_velocity.driver_codec import encode_gps
from ev_velocity.gps_stream import GpsSpeed, GpsStream
from ev_velocity.sim_params import GpsParams
from node_core.byte_node import ByteNode
from node_core.byte_sources import Source
from node_core.diagnostics import OK


class GpsDriverNode(ByteNode):
    """Publishes the speeds of NMEA and UBX messages."""

    what = 'speed'
    params: GpsParams

    def __init__(self) -> None:
        super().__init__('gps_driver', GpsParams)
        self._stream = GpsStream(self.params.nmea_sigma)
        speeds, self._message = self.publish_to(TWIST, 'gps/speed')
        self._publish = speeds.publish
        self.begin_bytes(speeds)

    def open(self) -> Source[bytes]:
        """Open the source; the end of a message from before it was lost will not come."""
        self._stream.clear()
        return super().open()

    def samples(self, item: bytes, arrival: int) -> Iterable[GpsSpeed]:
        """Decode bytes."""
        return self._stream.feed(item, arrival)

    def recorded_time(self, sample: GpsSpeed) -> int:
        """Return the time of validity, 0 if the receiver did not know it."""
        return sample.utc

    def publish(self, sample: GpsSpeed) -> bool:
        """Publish a speed."""
        # The bytes of a file have no arrival: only the receiver's own time says when they were valid.
        message_time = self.recorded or self.params.stamp_source == 'message'
        stamp = sample.utc if message_time else sample.arrival
        if stamp <= 0:
            self._stream.rejected['no time'] += 1
            return False
        encode_gps(sample, self._message, stamp, self.params.frame_id)
        self._publish(self._message)
        return True

    def rejected(self) -> dict[str, int]:
        """Return the refused messages by reason."""
        return self._stream.rejected

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Report how many speeds were read."""
        return OK, 'ok', {'speeds': self._stream.accepted}
