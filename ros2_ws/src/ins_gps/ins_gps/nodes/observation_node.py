# SPDX-License-Identifier: Apache-2.0
"""What the nodes that read raw observations from a stream of bytes share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

from ins_gps import codec
from ins_gps.params import RtcmParams, UbloxParams
from ins_gps.rtcm import RtcmDecoder
from ins_gps.samples import GnssEpoch, ReceiverFix
from ins_gps.ublox import UbloxDecoder
from node_core.byte_node import ByteNode
from node_core.diagnostics import OK, WARN


class ObservationNode(ByteNode):
    """Publishes epochs with satellite states, and fixes, as `decoder` makes them of bytes."""

    params: Any

    def __init__(self, name: str, params: type[UbloxParams] | type[RtcmParams]) -> None:
        super().__init__(name, params)
        self._decoder = self.decoder()
        epochs, self._cloud = self.publish_to(codec.CLOUD, self.params.topic)
        fixes, self._fix = self.publish_to(codec.FIX, self.fix_topic())
        self._publish_cloud, self._publish_fix = epochs.publish, fixes.publish
        self.begin_bytes(epochs, fixes)

    @abstractmethod
    def decoder(self) -> UbloxDecoder | RtcmDecoder:
        """Return the decoder that the parameters ask for."""

    @abstractmethod
    def fix_topic(self) -> str:
        """Return the topic of fixes or positions."""

    def samples(self, item: bytes, arrival: int) -> Iterable[GnssEpoch | ReceiverFix]:
        """Decode bytes."""
        return self._decoder.feed(item)

    def publish(self, sample: GnssEpoch | ReceiverFix) -> bool:
        """Publish an epoch or a fix; only epochs show that the source is what it should be."""
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
        """Report the messages by kind, and what was left out."""
        missing = self._decoder.missing
        values: dict[str, Any] = dict(sorted(dict(self._decoder.accepted).items()))
        values |= {f'left out: {reason}': count for reason, count in dict(self._decoder.left_out).items()}
        values['missing ephemerides'] = ' '.join(missing)
        if missing:
            return WARN, f'{len(missing)} satellites without ephemeris', values
        return OK, 'ok', values
