# SPDX-License-Identifier: Apache-2.0
"""The node that reads an RTCM 3 stream from a file, a serial port, a TCP server or an NTRIP caster."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from ins_gps import codec
from ins_gps.params import RtcmParams
from ins_gps.rtcm import RtcmDecoder
from ins_gps.samples import GnssEpoch, ReceiverFix
from node_core.byte_node import ByteNode
from node_core.diagnostics import OK, WARN


class RtcmDriverNode(ByteNode):
    """Publishes epochs with satellite states, and the position that a base says it has."""

    what = 'epoch of MSM4-MSM7'
    params: RtcmParams

    def __init__(self) -> None:
        super().__init__('rtcm_driver', RtcmParams)
        params = self.params
        self._decoder = RtcmDecoder(
            params.band_numbers,
            atmosphere=params.atmosphere,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
            week=params.gps_week,
        )
        epochs, self._cloud = self.publish_to(codec.CLOUD, params.topic)
        positions, self._position = self.publish_to(codec.FIX, params.position_topic)
        self._publish_cloud, self._publish_position = epochs.publish, positions.publish
        self.begin_bytes(epochs, positions)

    def samples(self, item: bytes, arrival: int) -> Iterable[GnssEpoch | ReceiverFix]:
        """Decode bytes."""
        return self._decoder.feed(item)

    def rest(self) -> Iterator[GnssEpoch]:
        """Return an epoch whose end was not said."""
        return self._decoder.rest()

    def publish(self, sample: GnssEpoch | ReceiverFix) -> bool:
        """Publish an epoch or a base position; only epochs show that the stream is what it should be."""
        if isinstance(sample, ReceiverFix):
            codec.encode_receiver_fix(sample, self._position, self.params.frame)
            self._publish_position(self._position)
            return False
        codec.encode_observations(sample, self._cloud, self.params.frame)
        self._publish_cloud(self._cloud)
        return True

    def rejected(self) -> dict[str, int]:
        """Return the refused messages by reason."""
        return self._decoder.rejected

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Report the messages by number, and what was left out."""
        missing = self._decoder.missing
        values: dict[str, Any] = dict(sorted(dict(self._decoder.accepted).items()))
        values |= {f'left out: {reason}': count for reason, count in dict(self._decoder.left_out).items()}
        values['missing ephemerides'] = ' '.join(missing)
        if missing:
            return WARN, f'{len(missing)} satellites without ephemeris', values
        return OK, 'ok', values
