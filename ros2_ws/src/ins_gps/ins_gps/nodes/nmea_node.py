# SPDX-License-Identifier: Apache-2.0
"""The node that reads a receiver's NMEA sentences."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from ins_gps import codec
from ins_gps.nmea import NmeaDecoder
from ins_gps.params import NmeaParams
from ins_gps.samples import ReceiverFix, VelocitySample
from node_core.byte_node import ByteNode
from node_core.diagnostics import OK, WARN


class NmeaDriverNode(ByteNode):
    """Publishes fixes and, if asked for, velocities."""

    what = 'GGA or RMC with a time'
    params: NmeaParams

    def __init__(self) -> None:
        super().__init__('nmea_driver', NmeaParams)
        params = self.params
        self._decoder = NmeaDecoder(
            params.range_sigma,
            params.speed_sigma,
            utc=params.time_scale == 'utc',
            leap=params.leap_seconds,
            reference=self._reference,
        )
        fixes, self._fix = self.publish_to(codec.FIX, params.fix_topic)
        publishers = [fixes]
        self._publish_fix, self._publish_velocity = fixes.publish, None
        if params.velocity_topic:
            velocities, self._velocity = self.publish_to(codec.TWIST, params.velocity_topic)
            self._publish_velocity = velocities.publish
            publishers.append(velocities)
        self._status = -1
        self.begin_bytes(*publishers)

    def _reference(self) -> int:
        """Return a time (ns) near which times without a date are: now, or that of the parameter."""
        day = self.params.day
        if day:
            return day
        return 0 if self.recorded else self.get_clock().now().nanoseconds

    def samples(self, item: bytes, arrival: int) -> Iterable[ReceiverFix | VelocitySample]:
        """Decode bytes."""
        return self._decoder.feed(item)

    def rest(self) -> Iterator[ReceiverFix | VelocitySample]:
        """Return the last epoch."""
        return self._decoder.rest()

    def publish(self, sample: ReceiverFix | VelocitySample) -> bool:
        """Publish a fix or a velocity."""
        if isinstance(sample, ReceiverFix):
            self._status = sample.status
            codec.encode_receiver_fix(sample, self._fix, self.params.frame)
            self._publish_fix(self._fix)
            return True
        if self._publish_velocity is not None:
            codec.encode_velocity(sample, self._velocity)
            self._publish_velocity(self._velocity)
        return False

    def rejected(self) -> dict[str, int]:
        """Return the refused sentences by reason."""
        return self._decoder.rejected

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Report the sentences that were read and whether there is a fix."""
        values: dict[str, Any] = dict(self._decoder.accepted)
        values['quality'] = self._decoder.quality
        if self._status < 0:
            return WARN, 'no fix', values
        return OK, 'ok', values
