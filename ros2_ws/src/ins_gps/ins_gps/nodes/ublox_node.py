# SPDX-License-Identifier: Apache-2.0
"""The node that reads a u-blox receiver from a file, a serial port or a TCP server."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ins_gps import codec
from ins_gps.params import UbloxParams
from ins_gps.samples import GnssEpoch, ReceiverFix
from ins_gps.ublox import UbloxDecoder
from node_core.byte_node import ByteNode
from node_core.diagnostics import OK, WARN


class UbloxDriverNode(ByteNode):
    """Publishes epochs with satellite states, and the receiver's own fixes."""

    what = 'RXM-RAWX with a time'
    params: UbloxParams

    def __init__(self) -> None:
        super().__init__('ublox_driver', UbloxParams)
        params = self.params
        self._decoder = UbloxDecoder(
            params.band_numbers,
            atmosphere=params.atmosphere,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
        )
        epochs, self._cloud = self.publish_to(codec.CLOUD, params.topic)
        fixes, self._fix = self.publish_to(codec.FIX, params.fix_topic)
        self._publish_cloud, self._publish_fix = epochs.publish, fixes.publish
        self.begin_bytes(epochs, fixes)

    def samples(self, item: bytes, arrival: int) -> Iterable[GnssEpoch | ReceiverFix]:
        """Decode bytes."""
        return self._decoder.feed(item)

    def publish(self, sample: GnssEpoch | ReceiverFix) -> bool:
        """Publish an epoch or a fix; only epochs show that the receiver is set up."""
        if isinstance(sample, ReceiverFix):
            codec.encode_receiver_fix(sample, self._fix, self.params.frame)
            self._publish_fix(self._fix)
            return False
        codec.encode_observations(sample, self._cloud, self.params.frame)
        self._publish_cloud(self._cloud)
        return True

    def rejected(self) -> dict[str, int]:
        """Return the refused messages by reason."""
        return self._decoder.rejected

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Report what was read and left out."""
        missing = self._decoder.missing
        values: dict[str, Any] = dict(self._decoder.accepted)
        values |= {f'left out: {reason}': count for reason, count in dict(self._decoder.left_out).items()}
        values['missing ephemerides'] = ' '.join(missing)
        if missing:
            return WARN, f'{len(missing)} satellites without ephemeris', values
        return OK, 'ok', values
