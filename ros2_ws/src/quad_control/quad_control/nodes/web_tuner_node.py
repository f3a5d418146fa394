# SPDX-License-Identifier: Apache-2.0
"""The tuning page as a node: ROS in the spinning thread, the web server in a thread of its own."""

from __future__ import annotations

import asyncio
import secrets
import threading
from typing import Any

from aiohttp import web
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from std_msgs.msg import String
from std_srvs.srv import Trigger

from kalman_core.parameters import ParameterError
from node_core.diagnostics import OK, status
from node_core.node import WorkspaceNode, reliable
from quad_control import codec
from quad_control.params import WebParams
from quad_control.tuner_data import ACTIONS, STEP_ANGLE, STEP_TIME, TunerData
from quad_control.web_server import Gain, Refused, TunerServer, authority

CONTROLLER, PILOT = 'attitude_controller', 'pilot'
# An answer of another node that takes longer than this (s) counts as none.
_ANSWER = 2.0


class WebTunerNode(WorkspaceNode):
    """Serves the page; gains go through the controller's ROS parameters and their checks."""

    actions: tuple[str, ...] = ACTIONS

    def __init__(self) -> None:
        super().__init__('web_tuner', WebParams)
        params = self.parameters[WebParams]
        self._data = TunerData()
        self._get = self.create_client(GetParameters, f'{CONTROLLER}/get_parameters')
        self._set = {
            node: self.create_client(SetParametersAtomically, f'{node}/set_parameters_atomically')
            for node in (CONTROLLER, PILOT)
        }
        self._triggers = {
            name: self.create_client(Trigger, f'{CONTROLLER}/{name}')
            for name in ACTIONS
            if name == 'kill' or name.startswith(('autotune', 'apply'))
        }
        self.listen(codec.JOINTS, 'controller/report', self._data.on_report)
        self.listen(codec.VECTOR, 'imu/angle_raw', self._data.on_raw)
        self.listen(codec.JOINTS, 'motors/command', self._data.on_motors)
        self.listen(codec.BATTERY, 'battery', self._data.on_battery)
        self.listen(codec.STRING, 'controller/events', self._data.on_event)
        self.create_subscription(String, 'arming/state', self._data.on_arming, reliable(1, latched=True))
        self.create_subscription(ParameterEvent, '/parameter_events', self._on_parameters, 100)
        self.create_timer(0.2, self._fetch, clock=self.steady_clock)
        self._fetching = False
        self._token = params.token or secrets.token_urlsafe(24)
        self._serve(params)

    # The server's thread ------------------------------------------------------------------------------

    def _serve(self, params: WebParams) -> None:
        self._loop = asyncio.new_event_loop()
        started = threading.Event()
        failed: list[OSError] = []

        async def begin() -> None:
            hosts: set[str] = set()
            server = TunerServer(self, self._token, hosts, params.proxy_host)
            self._data.history = server.history
            self._runner = web.AppRunner(server.app, access_log=None)
            await self._runner.setup()
            site = web.TCPSite(self._runner, params.host, params.port)
            await site.start()
            port = self._runner.addresses[0][1]
            hosts.update(authority(name, port) for name in {params.host, '127.0.0.1', 'localhost'})
            self.url = f'http://{authority(params.host, port)}/#token={self._token}'

        def work() -> None:
            asyncio.set_event_loop(self._loop)
            try:
                self._loop.run_until_complete(begin())
            except OSError as error:
                failed.append(error)
                return
            finally:
                started.set()
            self._loop.run_forever()
            self._loop.run_until_complete(self._runner.cleanup())

        self._thread = threading.Thread(target=work, name='web', daemon=True)
        self._thread.start()
        started.wait()
        if failed:
            raise ParameterError(f"parameter 'port' is {params.port}: {failed[0].strerror or failed[0]}")
        self.get_logger().info(f'page: {self.url}')

    def gains(self) -> list[Gain]:
        """See web_server.Backend."""
        return self._data.gains()

    def state(self) -> dict[str, Any]:
        """See web_server.Backend."""
        return self._data.state()

    def samples(self, after: int) -> tuple[int, list]:
        """See web_server.Backend."""
        return self._data.samples(after)

    async def set_gains(self, changes: dict[str, float]) -> None:
        """See web_server.Backend."""
        self._data.expect(changes)
        await self._set_parameters(CONTROLLER, changes)
        self._data.known(changes)

    async def act(self, name: str) -> str:
        """See web_server.Backend."""
        if name in self._triggers:
            response = await self._ask(self._triggers[name], Trigger.Request(), CONTROLLER)
            if not response.success:
                raise Refused(response.message)
            return response.message
        if name == 'takeoff':
            await self._set_parameters(PILOT, {'mission': 'hover'})
            return 'The pilot arms and takes off.'
        if name == 'disarm':
            await self._set_parameters(PILOT, {'mission': 'manual', 'arm': False, 'throttle': 0.0})
            return 'The pilot has turned the arm switch off.'
        axis = name.removeprefix('step_')
        await self._set_parameters(PILOT, {axis: STEP_ANGLE})
        try:
            await asyncio.sleep(STEP_TIME)
        finally:
            await self._set_parameters(PILOT, {axis: 0.0})
        return f'{axis}: 10° for {STEP_TIME:g} s'

    async def _set_parameters(self, node: str, values: dict[str, Any]) -> None:
        request = SetParametersAtomically.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        )
        result = (await self._ask(self._set[node], request, node)).result
        if not result.successful:
            raise Refused(result.reason)

    async def _ask(self, client: Any, request: Any, node: str) -> Any:
        """Call a service from the server's thread; the spinning thread completes the future."""
        if not client.service_is_ready():
            raise Refused(f'{node} is not running')
        loop = asyncio.get_running_loop()
        answered = loop.create_future()

        def settle(response: Any) -> None:
            if not answered.done():  # it may have timed out
                answered.set_result(response)

        def done(future: Any) -> None:
            loop.call_soon_threadsafe(settle, future.result())

        client.call_async(request).add_done_callback(done)
        try:
            return await asyncio.wait_for(answered, _ANSWER)
        except TimeoutError:
            raise Refused(f'{node} does not answer') from None

    # The spinning thread ------------------------------------------------------------------------------

    def _fetch(self) -> None:
        """Ask the controller for its gains until it has told them; again when it comes back."""
        ready = self._get.service_is_ready()
        if not ready:
            self._data.fetched = False
        if self._data.fetched or self._fetching or not ready:
            return
        self._fetching = True
        names = [gain.name for gain in self._data.gains()]

        def done(future: Any) -> None:
            self._fetching = False
            values = [parameter_value_to_python(value) for value in future.result().values]
            if len(values) == len(names):
                self._data.known(dict(zip(names, values)))
                self._data.fetched = True

        self._get.call_async(GetParameters.Request(names=names)).add_done_callback(done)

    def _on_parameters(self, event: ParameterEvent) -> None:
        if event.node == self.resolve_service_name(CONTROLLER):
            changes = {p.name: parameter_value_to_python(p.value) for p in event.changed_parameters}
            self._data.changed_elsewhere(changes)

    def diagnose(self) -> DiagnosticArray:
        """Report the address and whether the controller was heard."""
        values = {'address': self.url.split('#')[0], 'controller_heard': self._data.fetched}
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, OK, 'ok', values)])

    def destroy_node(self) -> None:
        """Stop the server, then the node."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_ANSWER)
        super().destroy_node()


def build_node() -> WebTunerNode:
    """Return the node."""
    return WebTunerNode()
