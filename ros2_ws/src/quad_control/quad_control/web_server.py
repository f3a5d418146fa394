# SPDX-License-Identifier: Apache-2.0
"""The tuning page's server without ROS: checks every request, then asks a Backend.

Whoever can reach the port could fly the craft, so: a token for everything but the page's own files, the Host
header must name this server (no DNS rebinding), a browser's Origin must be this server's (over TLS where a
proxy adds it), bodies are JSON with exactly the expected keys and finite numbers within bounds, and the page
may load nothing from elsewhere.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import yaml
from aiohttp import WSMsgType, web

_FOLDER = Path(__file__).parent / 'web'
_FILES = {
    '/': ('index.html', 'text/html'),
    '/app.js': ('app.js', 'text/javascript'),
    '/plot.js': ('plot.js', 'text/javascript'),
    '/style.css': ('style.css', 'text/css'),
}
_HEADERS = {
    'Content-Security-Policy': (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store',
}
# The largest body that means anything here: a YAML file of all gains (bytes).
_LARGEST_BODY = 64 * 1024
# The page gets what is new this often (s).
_PUSH = 0.05
_TOKEN_PREFIX = 'token.'


class Gain(NamedTuple):
    """One gain as the page shows it."""

    name: str
    value: float
    minimum: float
    maximum: float
    unit: str
    text: str


class Refused(Exception):
    """The craft's own nodes refused a change or a command; the text says why."""


class Backend(Protocol):
    """What the server asks of the node."""

    actions: tuple[str, ...]

    def gains(self) -> list[Gain]:
        """Return all gains with their present values."""
        ...

    async def set_gains(self, changes: dict[str, float]) -> None:
        """Set gains all or none; raise Refused."""
        ...

    async def act(self, name: str) -> str:
        """Run one of `actions`; return what happened or raise Refused."""
        ...

    def state(self) -> dict[str, Any]:
        """Return arming state, events and the like."""
        ...

    def samples(self, after: int) -> tuple[int, list]:
        """Return plot samples newer than the counter `after`, and the counter now."""
        ...


class _Bad(Exception):
    """A request is refused with an HTTP status and a reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class History:
    """Changes made to the gains, newest last; `undo` gives the way back."""

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []

    def add(self, changes: dict[str, float], before: dict[str, float], by: str) -> None:
        """Remember a change of gains."""
        moved = {name: [before[name], value] for name, value in changes.items() if before[name] != value}
        if moved:
            self.entries.append({'by': by, 'changes': moved})

    def undo(self) -> dict[str, float]:
        """Return the values before the newest change; empty when there is none."""
        if not self.entries:
            return {}
        return {name: pair[0] for name, pair in self.entries[-1]['changes'].items()}


def authority(host: str, port: int) -> str:
    """Return `host` and `port` as URLs and Host headers have them: an IPv6 address in brackets."""
    return f'[{host}]:{port}' if ':' in host else f'{host}:{port}'


class TunerServer:
    """The aiohttp application. `hosts` are the Host headers that name this server.

    `proxy_host` is one more, that of a proxy which speaks TLS with the browser and passes Host on.
    """

    def __init__(self, backend: Backend, token: str, hosts: set[str], proxy_host: str = '') -> None:
        self._backend = backend
        self._token = token
        self._hosts = hosts
        self._proxy_host = proxy_host
        self.history = History()
        self._changing = asyncio.Lock()
        self.app = web.Application(middlewares=[self._guard], client_max_size=_LARGEST_BODY)
        for path in _FILES:
            self.app.router.add_get(path, self._file)
        self.app.router.add_get('/api/state', self._state)
        self.app.router.add_get('/api/yaml', self._save)
        self.app.router.add_post('/api/gains', self._gains)
        self.app.router.add_post('/api/undo', self._undo)
        self.app.router.add_post('/api/action', self._action)
        self.app.router.add_post('/api/yaml', self._load)
        self.app.router.add_get('/ws', self._socket)

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        try:
            self._check(request)
            response = await handler(request)
        except _Bad as bad:
            response = web.json_response({'error': str(bad)}, status=bad.status)
        except Refused as refused:
            response = web.json_response({'error': str(refused)}, status=409)
        except web.HTTPException as error:
            response = web.json_response({'error': error.reason}, status=error.status)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    def _check(self, request: web.Request) -> None:
        host = request.headers.get('Host', '')
        origins = {f'https://{host}'}
        if host in self._hosts:
            origins.add(f'http://{host}')
        elif not host or host != self._proxy_host:
            raise _Bad(403, 'wrong host')
        origin = request.headers.get('Origin')
        socket = request.path == '/ws'
        # A browser always sends Origin with a websocket; without one it is not the page.
        if (origin is not None or socket) and origin not in origins:
            raise _Bad(403, 'wrong origin')
        if request.path in _FILES:
            return
        if socket:
            offered = [p.strip() for p in request.headers.get('Sec-WebSocket-Protocol', '').split(',')]
            given = next((p.removeprefix(_TOKEN_PREFIX) for p in offered if p.startswith(_TOKEN_PREFIX)), '')
        else:
            given = request.headers.get('Authorization', '').removeprefix('Bearer ')
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            raise _Bad(401, 'wrong token')
        if request.method == 'POST' and request.content_type != 'application/json':
            raise _Bad(415, 'expected application/json')

    async def _body(self, request: web.Request, *keys: str) -> dict[str, Any]:
        try:
            body = json.loads(await request.text(), parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise _Bad(422, f'not JSON: {error}') from None
        if not isinstance(body, dict) or set(body) != set(keys):
            raise _Bad(422, f'expected an object with the keys: {", ".join(keys) or "none"}')
        return body

    def _numbers(self, given: Any) -> dict[str, float]:
        """Return `given` as gains, every one known, finite and within its bounds."""
        if not isinstance(given, dict) or not given:
            raise _Bad(422, 'expected gains by name')
        known = {gain.name: gain for gain in self._backend.gains()}
        for name, value in given.items():
            if name not in known:
                raise _Bad(422, f"unknown gain '{name}'")
            if isinstance(value, bool) or not isinstance(value, int | float) or not _finite(value):
                raise _Bad(422, f"'{name}' is no finite number")
            gain = known[name]
            if not gain.minimum <= value <= gain.maximum:
                raise _Bad(422, f"'{name}' is {value:g}, allowed: {gain.minimum:g} … {gain.maximum:g}")
        return {name: float(value) for name, value in given.items()}

    async def _change(self, changes: dict[str, float], by: str) -> None:
        async with self._changing:
            before = {gain.name: gain.value for gain in self._backend.gains()}
            await self._backend.set_gains(changes)
            self.history.add(changes, before, by)

    def _reply(self) -> web.Response:
        return web.json_response(
            {
                'gains': [gain._asdict() for gain in self._backend.gains()],
                'history': self.history.entries[-50:],
                'actions': self._backend.actions,
                **self._backend.state(),
            }
        )

    async def _file(self, request: web.Request) -> web.Response:
        name, kind = _FILES[request.path]
        return web.Response(text=(_FOLDER / name).read_text(encoding='utf-8'), content_type=kind)

    async def _state(self, _request: web.Request) -> web.Response:
        return self._reply()

    async def _gains(self, request: web.Request) -> web.Response:
        body = await self._body(request, 'gains')
        await self._change(self._numbers(body['gains']), 'page')
        return self._reply()

    async def _undo(self, request: web.Request) -> web.Response:
        await self._body(request)
        async with self._changing:
            back = self.history.undo()
            if not back:
                raise _Bad(409, 'nothing to undo')
            await self._backend.set_gains(back)
            self.history.entries.pop()
        return self._reply()

    async def _action(self, request: web.Request) -> web.Response:
        name = (await self._body(request, 'name'))['name']
        if name not in self._backend.actions:
            raise _Bad(422, f'unknown action; known: {", ".join(self._backend.actions)}')
        return web.json_response({'text': await self._backend.act(name)})

    async def _save(self, _request: web.Request) -> web.Response:
        gains = {gain.name: gain.value for gain in self._backend.gains()}
        text = yaml.safe_dump({'attitude_controller': {'ros__parameters': gains}}, sort_keys=False)
        return web.Response(text=text, content_type='application/yaml')

    async def _load(self, request: web.Request) -> web.Response:
        text = (await self._body(request, 'yaml'))['yaml']
        if not isinstance(text, str):
            raise _Bad(422, 'expected YAML as a string')
        try:
            gains = yaml.safe_load(text)['attitude_controller']['ros__parameters']
        except (yaml.YAMLError, TypeError, KeyError, RecursionError):
            raise _Bad(422, 'expected attitude_controller: ros__parameters: gains') from None
        await self._change(self._numbers(gains), 'file')
        return self._reply()

    async def _socket(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(
            heartbeat=10.0, max_msg_size=1024, protocols=(f'{_TOKEN_PREFIX}{self._token}',)
        )
        socket.headers.update(_HEADERS)
        await socket.prepare(request)
        pushing = asyncio.create_task(self._push(socket))
        try:
            async for message in socket:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    break  # the page only listens
        finally:
            pushing.cancel()
        return socket

    async def _push(self, socket: web.WebSocketResponse) -> None:
        after, _ = self._backend.samples(-1)
        while not socket.closed:
            after, samples = self._backend.samples(after)
            state = self._backend.state()
            values = {gain.name: gain.value for gain in self._backend.gains()}
            history = self.history.entries[-50:]
            try:
                await socket.send_json({'samples': samples, 'values': values, 'history': history, **state})
            except ConnectionError:
                return
            await asyncio.sleep(_PUSH)


def _no_constant(name: str) -> Any:
    raise ValueError(f'{name} is no number')


def _finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond float
        return False
