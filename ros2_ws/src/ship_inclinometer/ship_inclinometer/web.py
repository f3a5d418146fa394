# SPDX-License-Identifier: Apache-2.0
"""The display's web application: one page, one stream of states, one command. No ROS."""

from __future__ import annotations

import asyncio
import hmac
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

PAGE = Path(__file__).with_name('display.html')
# The page is redrawn at this rate (Hz); the standard asks for 5 at least.
_RATE = 10.0
COMMANDS = ('acknowledge', 'silence', 'peak_reset', 'log_mark')


def finite(value: Any) -> Any:
    """Return `value` with every number that is not finite as None: JSON has no NaN."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value


def application(
    snapshot: Callable[[], dict[str, Any]],
    command: Callable[[str, str], None],
    token: str,
    history: Callable[[], list[tuple[float, float]]] = list,
) -> web.Application:
    """Return the application: GET / the page, GET /ws states, POST /command with the token.

    `snapshot` returns the present state, `command(name, who)` carries out a command, `history` returns the
    trend so far as (time in s, heel in degrees): a page that is opened shows the last minutes at once.
    """

    async def page(_request: web.Request) -> web.StreamResponse:
        return web.Response(
            text=PAGE.read_text(encoding='utf-8'),
            content_type='text/html',
            headers={
                'Content-Security-Policy': "default-src 'self' 'unsafe-inline'; connect-src 'self' ws: wss:",
                'X-Frame-Options': 'DENY',
                'Cache-Control': 'no-store',
            },
        )

    async def state(_request: web.Request) -> web.StreamResponse:
        return web.json_response(finite({'history': history(), **snapshot()}))

    async def stream(request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(heartbeat=10.0)
        await socket.prepare(request)
        try:
            while not socket.closed:
                await socket.send_str(json.dumps(finite(snapshot())))
                await asyncio.sleep(1.0 / _RATE)
        except ConnectionError:
            # The tablet has gone to sleep; it will connect anew.
            pass
        return socket

    async def act(request: web.Request) -> web.StreamResponse:
        given = request.headers.get('X-Token', '')
        if not token or not hmac.compare_digest(given.encode(), token.encode()):
            return web.json_response({'error': 'read-only: no valid token'}, status=403)
        try:
            body = await request.json()
            name = body['command']
        except (ValueError, KeyError, TypeError):
            return web.json_response({'error': 'expected {"command": …}'}, status=400)
        base, _, argument = str(name).partition(' ')
        if base not in COMMANDS or (not argument.replace('_', '').isalnum() and argument):
            return web.json_response({'error': f'unknown command {name!r}'}, status=400)
        command(str(name), f'display {request.remote}')
        return web.json_response({'done': name})

    app = web.Application(client_max_size=4096)
    app.router.add_get('/', page)
    app.router.add_get('/state', state)
    app.router.add_get('/ws', stream)
    app.router.add_post('/command', act)
    return app
