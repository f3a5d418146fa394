# SPDX-License-Identifier: Apache-2.0
"""The node that reads an RTCM 3 stream from a file, a serial port, a TCP server or an NTRIP caster."""

from __future__ import annotations

from collections.abc import Iterator

from ins_gps.nodes.observation_node import ObservationNode
from ins_gps.params import RtcmParams
from ins_gps.rtcm import RtcmDecoder
from ins_gps.samples import GnssEpoch


class RtcmDriverNode(ObservationNode):
    """Publishes epochs with satellite states, and the position that a base says it has."""

    what = 'epoch of MSM4-MSM7'
    _decoder: RtcmDecoder

    def __init__(self) -> None:
        super().__init__('rtcm_driver', RtcmParams)

    def decoder(self) -> RtcmDecoder:
        """Return the decoder that the parameters ask for."""
        params = self.params
        return RtcmDecoder(
            params.band_numbers,
            atmosphere=params.atmosphere,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
            week=params.gps_week,
        )

    def fix_topic(self) -> str:
        """Return the topic of the base's position."""
        return self.params.position_topic

    def rest(self) -> Iterator[GnssEpoch]:
        """Return an epoch whose end was not said."""
        return self._decoder.rest()
