# SPDX-License-Identifier: Apache-2.0
"""The node that reads a car's CAN bus or replays a log of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import can
from diagnostic_msgs.msg import DiagnosticArray

from ev_velocity.can_frames import CanDecoder, CanError, load_dbc, replay
from ev_velocity.can_profiles import PROFILES
from ev_velocity.driver_codec import TOPICS, encode_reading
from ev_velocity.sim_params import CanParams
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode

RECONNECT = 1.0  # s
TIMEOUT = 0.2  # s, after which a silent bus gives the thread a chance to stop

Frame = tuple[int, int, bytes, bool]


class CanDriverNode(WorkspaceNode):
    """Reads in a thread of its own, since a bus waits for no executor; each kind of reading has its topic."""

    def __init__(self) -> None:
        super().__init__('can_driver', CanParams)
        self._params = params = self.parameters[CanParams]
        profile = PROFILES[params.profile]
        try:
            self._decoder = CanDecoder(load_dbc(params.dbc), profile, self._brake_full())
            self._frames = self._replayed() if params.interface == 'log' else self._live()
            self._first = next(self._frames, None) if params.interface == 'log' else None
        except CanError as error:
            raise ParameterError(str(error)) from None
        self._outputs = {
            kind: self.publish_to(type_name, topic) for kind, (topic, type_name) in TOPICS.items()
        }
        self._state = 'waiting for frames'
        self._over = False
        self._newest = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='can', daemon=True)
        self._thread.start()

    def _brake_full(self) -> float:
        """Return what the brake signal is divided by: only the i-MiEV's is raw."""
        return self._params.brake_full if self._params.profile == 'imiev' else 1.0

    def _run(self) -> None:
        try:
            if self._first is not None:
                self._take(self._first)
            for frame in self._frames:
                if self._stopping.is_set():
                    return
                self._take(frame)
        except CanError as error:
            self._state = str(error)
            return
        if self._stopping.is_set():
            return
        self._over = True
        self._state = 'the log is over'
        self.get_logger().info(self._state)

    def _take(self, frame: Frame) -> None:
        stamp = frame[0]
        self._newest = stamp
        for reading in self._decoder.on_frame(*frame):
            publisher, message = self._outputs[type(reading)]
            encode_reading(reading, message, stamp, self._params.wheel_radius)
            publisher.publish(message)

    def _replayed(self) -> Iterator[Frame]:
        """Yield the frames of the log when they are due; their stamps are the recorded times."""
        rate = self._params.replay_rate
        start: tuple[int, float] | None = None
        for frame in replay(self._params.channel):
            if rate > 0.0:
                if start is None:
                    start = frame[0], time.monotonic()
                due = start[1] + (frame[0] - start[0]) * 1e-9 / rate
                wait = due - time.monotonic()
                if wait > 0.0 and self._stopping.wait(wait):
                    return
            yield frame

    def _live(self) -> Iterator[Frame]:
        """Yield frames of the bus, stamped on arrival; a lost bus is opened again."""
        params = self._params
        while not self._stopping.is_set():
            try:
                bus = can.Bus(interface=params.interface, channel=params.channel, bitrate=params.bitrate)
            except Exception as error:  # python-can's interfaces raise whatever their libraries do
                self._state = f"cannot open {params.interface} '{params.channel}': {error}"
                self._stopping.wait(RECONNECT)
                continue
            try:
                yield from self._received(bus)
            finally:
                bus.shutdown()
            self._stopping.wait(RECONNECT)

    def _received(self, bus: Any) -> Iterator[Frame]:
        while not self._stopping.is_set():
            try:
                message = bus.recv(TIMEOUT)
                silent = message is None and bus.state is can.BusState.ERROR
            except can.CanError as error:
                self._state = f'bus-off or interface lost: {error}'
                return
            if silent:
                self._state = 'bus-off: the controller has left the bus'
                return
            if message is not None:
                self._state = 'ok'
                stamp = self.get_clock().now().nanoseconds
                yield stamp, message.arbitration_id, bytes(message.data), message.is_error_frame

    def destroy_node(self) -> None:
        """Stop reading, then close."""
        self._stopping.set()
        self._thread.join(timeout=2.0)
        super().destroy_node()

    def diagnose(self) -> DiagnosticArray:
        """Report the bus and every frame: accepted, missing, rejected with reason, stale."""
        params = self._params
        now = self._newest if params.interface == 'log' else self.get_clock().now().nanoseconds
        stale = [] if self._over else self._decoder.stale(now, params.stale_time)
        values: dict[str, Any] = {'state': self._state, 'bus_errors': self._decoder.bus_errors}
        for name, health in self._decoder.health.items():
            values[f'{name}: accepted'] = health.accepted
            values[f'{name}: missing'] = health.missing
            for reason, count in health.rejected.items():
                values[f'{name}: {reason}'] = count
        name = self.get_fully_qualified_name().lstrip('/')
        if self._state != 'ok' and params.interface != 'log':
            return DiagnosticArray(status=[status(name, ERROR, self._state, values)])
        if stale:
            return DiagnosticArray(status=[status(name, WARN, f'stale: {", ".join(stale)}', values)])
        return DiagnosticArray(status=[status(name, OK, 'ok', values)])
