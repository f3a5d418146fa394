# SPDX-License-Identifier: Apache-2.0
"""The node that reads a car's CAN bus or replays a log of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ev_velocity.can_frames import CanDecoder, CanError, Reading, load_dbc
from ev_velocity.can_profiles import PROFILES
from ev_velocity.can_source import BusFrames, Frame, LogFrames
from ev_velocity.driver_codec import TOPICS, encode_reading
from ev_velocity.sim_params import CanParams
from kalman_core.parameters import ParameterError
from node_core.byte_node import SourceNode
from node_core.byte_sources import SourceError
from node_core.diagnostics import OK, WARN


class CanDriverNode(SourceNode):
    """Publishes what frames say, each kind of reading on its topic; live frames are stamped on arrival."""

    what = 'reading'
    params: CanParams

    def __init__(self) -> None:
        super().__init__('can_driver', CanParams)
        params = self.params
        # Only the i-MiEV's brake signal is raw.
        brake_full = params.brake_full if params.profile == 'imiev' else 1.0
        try:
            self._decoder = CanDecoder(load_dbc(params.dbc), PROFILES[params.profile], brake_full)
        except CanError as error:
            raise ParameterError(f"parameter 'dbc': {error}") from None
        self._outputs = {
            kind: self.publish_to(type_name, topic) for kind, (topic, type_name) in TOPICS.items()
        }
        self._newest, self._frames = 0, 0
        log = params.interface == 'log'
        name = params.channel if log else f"{params.interface} '{params.channel}'"
        try:
            self.begin(name, *(publisher for publisher, _ in self._outputs.values()), recorded=log)
        except SourceError as error:
            raise ParameterError(f"parameter 'channel': {error}") from None

    def open(self) -> LogFrames | BusFrames:
        """Open the log or the interface."""
        params = self.params
        if self.recorded:
            return LogFrames(params.channel)
        return BusFrames(params.interface, params.channel, params.bitrate)

    def samples(self, item: Frame, arrival: int) -> Iterable[Reading]:
        """Decode a frame."""
        self._frames += 1
        self._newest = item.stamp or arrival
        return self._decoder.on_frame(self._newest, item.frame_id, item.data, item.error)

    def publish(self, sample: Reading) -> bool:
        """Publish a reading."""
        publisher, message = self._outputs[type(sample)]
        encode_reading(sample, message, sample.stamp, self.params.wheel_radius)
        publisher.publish(message)
        return True

    def rejected(self) -> dict[str, int]:
        """Return the refused frames by name and reason."""
        return {
            f'{name}: {reason}': count
            for name, health in self._decoder.health.items()
            for reason, count in dict(health.rejected).items()
        }

    def report(self) -> tuple[bytes, str, dict[str, Any]]:
        """Report every frame: accepted, missing, stale."""
        now = self._newest if self.recorded else self.get_clock().now().nanoseconds
        values: dict[str, Any] = {'frames': self._frames, 'bus_errors': self._decoder.bus_errors}
        for name, health in self._decoder.health.items():
            values[f'{name}: accepted'] = health.accepted
            values[f'{name}: missing'] = health.missing
        stale = self._decoder.stale(now, self.params.stale_time) if self._frames else []
        if stale:
            return WARN, f'stale: {", ".join(stale)}', values
        return OK, 'ok', values
