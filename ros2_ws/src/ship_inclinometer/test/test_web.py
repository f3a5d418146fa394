# SPDX-License-Identifier: Apache-2.0
import asyncio
import contextlib
import math
import os
import shutil

import pytest
from aiohttp import ClientSession, web

from ship_inclinometer.web import PAGE, application

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
# CI sets WS_REQUIRE_PROGRAMS: there a missing program fails the test instead of skipping it.
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None and 'WS_REQUIRE_PROGRAMS' not in os.environ,
    reason='no chromium (apt-get install chromium)',
)
STATE = {
    'time': 1767225600.0,
    'validity': 0,
    'reason': '',
    'roll': 12.34,
    'pitch': -1.5,
    'heading': 271.2,
    'heading_valid': True,
    'sigma': 0.14,
    'roll_known': True,
    'no_roll': False,
    'period': 11.6,
    'amplitude_port': 9.8,
    'amplitude_starboard': 13.1,
    'peak_port': 14.0,
    'peak_starboard': 15.2,
    'alarms_known': True,
    'alarms': {'heel_warning': 1.0, 'heel_warning_unacknowledged': 1.0},
}


@contextlib.asynccontextmanager
async def served(state, token='secret'):
    commands = []
    app = application(lambda: state, lambda name, who: commands.append((name, who)), token)
    runner = web.AppRunner(app)
    await runner.setup()
    site = web.TCPSite(runner, '127.0.0.1', 0)
    await site.start()
    try:
        yield f'http://127.0.0.1:{site._server.sockets[0].getsockname()[1]}', commands
    finally:
        await runner.cleanup()


def test_a_page_that_is_opened_gets_the_trend_so_far():
    async def scene():
        app = application(lambda: STATE, lambda _name, _who: None, '', lambda: [(1.0, 2.5), (2.0, math.nan)])
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, '127.0.0.1', 0)
        await site.start()
        port = site._server.sockets[0].getsockname()[1]
        try:
            async with ClientSession() as session, session.get(f'http://127.0.0.1:{port}/state') as reply:
                return await reply.json()
        finally:
            await runner.cleanup()

    assert asyncio.run(scene())['history'] == [[1.0, 2.5], [2.0, None]]


async def post(url, body, token=None):
    headers = {'X-Token': token} if token is not None else {}
    async with (
        ClientSession() as session,
        session.post(f'{url}/command', json=body, headers=headers) as reply,
    ):
        return reply.status


def test_commands_need_the_token():
    async def scene():
        async with served(STATE) as (url, commands):
            body = {'command': 'acknowledge heel_warning'}
            assert await post(url, body) == 403
            assert await post(url, body, 'wrong') == 403
            assert commands == []
            assert await post(url, body, 'secret') == 200
            assert commands[0][0] == 'acknowledge heel_warning'
            assert '127.0.0.1' in commands[0][1]
            for bad in ({'command': 'stop_set'}, {}, [1], {'command': 'acknowledge a;b'}):
                assert await post(url, bad, 'secret') == 400

    asyncio.run(scene())


def test_without_a_token_the_page_is_read_only():
    async def scene():
        async with served(STATE, token='') as (url, _):
            assert await post(url, {'command': 'acknowledge'}, '') == 403

    asyncio.run(scene())


def test_unknown_numbers_are_null_and_the_page_loads_nothing_from_elsewhere():
    async def scene():
        async with served({**STATE, 'roll': math.nan}) as (url, _), ClientSession() as session:
            async with session.get(f'{url}/state') as reply:
                assert (await reply.json())['roll'] is None
            async with session.get(url) as reply:
                page = await reply.text()
            assert 'http://' not in page.replace('http://www.w3.org/2000/svg', '')
            assert 'https://' not in page
            async with session.ws_connect(f'{url}/ws') as socket:
                assert (await socket.receive_json())['period'] == 11.6

    asyncio.run(scene())


async def browse(url, folder, *options):
    assert CHROMIUM is not None, 'chromium is not installed'
    process = await asyncio.create_subprocess_exec(
        CHROMIUM,
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        '--disable-dev-shm-usage',
        f'--user-data-dir={folder}',
        '--virtual-time-budget=1200',
        *options,
        url,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    out, _ = await asyncio.wait_for(process.communicate(), 90)
    return out.decode()


@needs_chromium
def test_a_browser_shows_heel_period_and_alarm(tmp_path):
    async def scene():
        async with served(STATE) as (url, _):
            return await browse(f'{url}/?token=secret', tmp_path, '--dump-dom')

    page = asyncio.run(scene())
    assert '12.3° S' in page
    assert '>VALID<' in page
    assert '12 s' in page
    assert 'Heel warning' in page
    assert '<button>Acknowledge</button>' in page


@needs_chromium
def test_a_browser_shows_no_heel_when_it_is_invalid(tmp_path):
    async def scene():
        async with served({**STATE, 'validity': 2, 'reason': 'attitude is stale'}) as (url, _):
            return await browse(url, tmp_path, '--dump-dom')

    page = asyncio.run(scene())
    assert 'INVALID: attitude is stale' in page
    assert '12.3°' not in page
    assert '<button>Acknowledge</button>' not in page


@needs_chromium
def test_a_browser_says_where_nobody_speaks_any_more(tmp_path):
    async def scene():
        silent = {
            'roll_known': False,
            'alarms_known': False,
            'alarms': {},
            'period': math.nan,
            'heading': 359.97,
        }
        async with served({**STATE, **silent}) as (url, _):
            return await browse(url, tmp_path, '--dump-dom')

    page = asyncio.run(scene())
    assert '12.3° S' in page
    assert 'no data' in page
    assert 'the alarm monitor is silent' in page
    assert '>No alarms<' not in page
    assert '>0.0°<' in page
    assert '360.0' not in page


@needs_chromium
def test_a_browser_that_loses_the_connection_shows_no_old_number(tmp_path):
    async def page(_request):
        return web.FileResponse(PAGE)

    async def told_once(_request):
        return web.json_response(STATE)

    async def scene():
        # One state, and no stream after it.
        app = web.Application()
        app.router.add_get('/', page)
        app.router.add_get('/state', told_once)
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, '127.0.0.1', 0)
        await site.start()
        port = site._server.sockets[0].getsockname()[1]
        try:
            # For the page, seconds pass.
            return await browse(
                f'http://127.0.0.1:{port}', tmp_path, '--dump-dom', '--virtual-time-budget=20000'
            )
        finally:
            await runner.cleanup()

    shown = asyncio.run(scene())
    assert 'NO CONNECTION' in shown
    assert 'the alarm monitor is silent' in shown
    for old in ('12.3°', '9.8°', '14.0°', 'Heel warning<', '12 s'):
        assert old not in shown
