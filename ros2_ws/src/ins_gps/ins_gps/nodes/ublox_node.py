# SPDX-License-Identifier: Apache-2.0
"""The node that reads a u-blox receiver from a file, a serial port or a TCP server."""

from __future__ import annotations

from ins_gps.nodes.observation_node import ObservationNode
from ins_gps.params import UbloxParams
from ins_gps.ublox import UbloxDecoder


class UbloxDriverNode(ObservationNode):
    """Publishes epochs with satellite states, and the receiver's own fixes."""

    what = 'RXM-RAWX with a time'

    def __init__(self) -> None:
        super().__init__('ublox_driver', UbloxParams)

    def decoder(self) -> UbloxDecoder:
        """Return the decoder that the parameters ask for."""
        params = self.params
        return UbloxDecoder(
            params.band_numbers,
            atmosphere=params.atmosphere,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
        )

    def fix_topic(self) -> str:
        """Return the topic of the receiver's fixes."""
        return self.params.fix_topic
