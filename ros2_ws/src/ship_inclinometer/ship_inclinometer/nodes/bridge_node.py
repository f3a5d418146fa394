# SPDX-License-Identifier: Apache-2.0
"""What the bridges to the rest of the ship share: the picture of attitude, roll and settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from kalman_core.parameters import ParameterError
from node_core.messages import stamp_of
from node_core.node import WorkspaceNode
from node_core.ports import BadMessage
from ship_inclinometer import topics
from ship_inclinometer.attitude_estimator import angles_of
from ship_inclinometer.codec import IMU, VALUES, decode_attitude, decode_numbers, decode_validity
from ship_inclinometer.event_log import EventLog, LogError
from ship_inclinometer.marine import Picture


class BridgeNode(WorkspaceNode):
    """Keeps `_picture` up to date once `_watch` was called."""

    def __init__(self, name: str, params: type) -> None:
        super().__init__(name, params)
        self._picture = Picture()

    def _watch(self) -> None:
        picture = self._picture
        self._take(IMU, topics.ATTITUDE, lambda m: picture.take_angles(angles_of(decode_attitude(m))))
        self._take(VALUES, topics.VALIDITY, lambda m: picture.take_validity(decode_validity(m)), latched=True)
        self._take(VALUES, topics.ROLL, lambda m: picture.take_roll(stamp_of(m), decode_numbers(m)))
        self._take(
            VALUES,
            topics.ALARMS,
            lambda m: picture.take_alarms(stamp_of(m), decode_numbers(m)),
            latched=True,
        )

    def _watch_settings(self) -> None:
        """Follow the settings that the Modbus bridge publishes."""
        take = self._picture.take_settings
        self._take(VALUES, topics.SETTINGS, lambda m: take(decode_numbers(m)), latched=True)

    def _take(self, kind: str, topic: str, take: Callable[[Any], None], latched: bool = False) -> None:
        def guarded(message: Any) -> None:
            try:
                take(message)
            except BadMessage as error:
                self.get_logger().warning(f'{topic}: {error}', throttle_duration_sec=5.0)

        self.listen(kind, topic, guarded, latched=latched)


def open_log(path: str) -> EventLog:
    """Return the event log of the parameter 'event_log'."""
    try:
        return EventLog(Path(path).expanduser())
    except LogError as error:
        raise ParameterError(f"parameter 'event_log' is {path!r}: {error}") from error
