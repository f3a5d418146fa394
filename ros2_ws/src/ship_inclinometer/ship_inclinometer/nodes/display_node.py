# SPDX-License-Identifier: Apache-2.0
"""The node around the web page: ROS in one thread, HTTP in another."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from typing import Any

from aiohttp import web

from kalman_core.parameters import ParameterError
from ship_inclinometer import topics
from ship_inclinometer.bridge_params import DisplayParams
from ship_inclinometer.nodes.bridge_node import BridgeNode, open_log
from ship_inclinometer.roll_analysis import NO_ROLL
from ship_inclinometer.samples import INVALID
from ship_inclinometer.web import application

# Length and step (s) of the trend that a page gets when it is opened.
_TREND, _TREND_STEP = 300.0, 0.25


class DisplayNode(BridgeNode):
    """Serves the display; commands go to ship/command and into the event log."""

    def __init__(self) -> None:
        super().__init__('display', DisplayParams)
        self._params: DisplayParams = self.parameters[DisplayParams]
        self._log = open_log(self._params.event_log)
        self._publisher, self._message = self.publish_to('std_msgs/msg/String', topics.COMMAND)
        self._watch()
        self._watch_settings()
        self._trend: deque[tuple[float, float]] = deque(maxlen=round(_TREND / _TREND_STEP))
        self.create_timer(_TREND_STEP, self._remember, clock=self.steady_clock)
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        try:
            self._runner = asyncio.run_coroutine_threadsafe(self._start(), self._loop).result()
        except OSError as error:
            raise ParameterError(f'{self._params.host}:{self._params.port}: {error}') from error
        self.get_logger().info(f'http://{self._params.host}:{self._params.port}/')

    async def _start(self) -> web.AppRunner:
        app = application(self.snapshot, self._command, self._params.token, lambda: list(self._trend))
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        await web.TCPSite(runner, self._params.host, self._params.port).start()
        return runner

    def destroy_node(self) -> None:
        """Stop serving."""
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result(10.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._log.close()
        super().destroy_node()

    def _remember(self) -> None:
        now = self.get_clock().now().nanoseconds
        known = self._picture.shown_validity(now)[0] != INVALID
        if self._trend and now * 1e-9 < self._trend[-1][0]:
            self._trend.clear()
        self._trend.append((now * 1e-9, self._picture.shown_roll if known else math.nan))

    def snapshot(self) -> dict[str, Any]:
        """Return what the page shows now."""
        now = self.get_clock().now().nanoseconds
        picture = self._picture
        validity, reason = picture.shown_validity(now)
        known = validity != INVALID
        alarms = picture.shown_alarms(now)
        rolling = ('amplitude_port', 'amplitude_starboard', 'peak_port', 'peak_starboard')
        return {
            'time': now * 1e-9,
            'validity': validity,
            'reason': reason,
            'roll': picture.shown_roll if known else math.nan,
            'pitch': picture.pitch if known else math.nan,
            'heading': picture.heading if known and picture.heading_valid else math.nan,
            'heading_valid': known and picture.heading_valid,
            'sigma': picture.sigma_roll if known else math.nan,
            'roll_known': picture.rolling_known(now),
            'no_roll': picture.number('status', now) == NO_ROLL,
            'period': picture.number('roll_period', now),
            **{name: picture.number(name, now) for name in rolling},
            'alarms_known': picture.alarms_known(now),
            'stopped': bool(alarms.get('stop_flag')),
            'alarms': alarms,
        }

    def _command(self, name: str, who: str) -> None:
        self._log.append(time.time_ns(), 'command', who, name)
        self._message.data = f'{name} {who}'
        self._publisher.publish(self._message)
