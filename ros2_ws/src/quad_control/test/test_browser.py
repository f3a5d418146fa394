# SPDX-License-Identifier: Apache-2.0
import asyncio
import base64
import contextlib
import json
import os
import shutil
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web
from page_backend import FlyingBackend

from quad_control.params import GAINS
from quad_control.web_server import TunerServer

TOKEN = 'a-token-of-the-test-0123456789'
CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
# Limits that only a fault reaches (s).
START, WAIT = 180.0, 180.0

# CI sets WS_REQUIRE_PROGRAMS: there a missing program fails the test instead of skipping it.
pytestmark = pytest.mark.skipif(
    CHROMIUM is None and 'WS_REQUIRE_PROGRAMS' not in os.environ, reason='needs the Debian package chromium'
)


class Browser:
    """A page in headless Chromium over its DevTools websocket."""

    def __init__(self, socket):
        self._socket = socket
        self._next = 0
        self.errors = []

    async def call(self, method, **params):
        self._next += 1
        await self._socket.send_json({'id': self._next, 'method': method, 'params': params})
        while True:
            message = await self._socket.receive_json()
            if message.get('method') in ('Runtime.exceptionThrown', 'Log.entryAdded'):
                self.errors.append(message['params'])
            if message.get('id') == self._next:
                assert 'error' not in message, message
                return message['result']

    async def run(self, script):
        result = await self.call('Runtime.evaluate', expression=script, awaitPromise=True, returnByValue=True)
        assert 'exceptionDetails' not in result, result
        return result['result'].get('value')

    async def until(self, script):
        # Before the page is there its elements are null: that is "not yet", not an error.
        guarded = f'(() => {{ try {{ return {script}; }} catch {{ return false; }} }})()'

        async def poll():
            while not (value := await self.run(guarded)):
                await asyncio.sleep(0.05)  # between looks at the page, not instead of a condition
            return value

        return await asyncio.wait_for(poll(), WAIT)

    async def picture(self, path):
        shot = await self.call('Page.captureScreenshot', format='png')
        path.write_bytes(base64.b64decode(shot['data']))


@contextlib.asynccontextmanager
async def browser(url, folder):
    assert CHROMIUM is not None, 'chromium is not installed'
    options = ('--headless=new', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage', '--no-first-run')
    process = await asyncio.create_subprocess_exec(
        CHROMIUM,
        *options,
        '--remote-debugging-port=0',
        f'--user-data-dir={folder}',
        '--window-size=1440,900',
        'about:blank',
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        port_file = Path(folder) / 'DevToolsActivePort'

        async def port():
            while not (port_file.exists() and len(port_file.read_text().splitlines()) == 2):
                assert process.returncode is None, 'chromium ended'
                await asyncio.sleep(0.05)
            return int(port_file.read_text().splitlines()[0])

        base = f'http://127.0.0.1:{await asyncio.wait_for(port(), START)}'
        async with aiohttp.ClientSession() as client:
            async with client.get(f'{base}/json/list') as r:
                target = next(t for t in json.loads(await r.text()) if t['type'] == 'page')
            async with client.ws_connect(target['webSocketDebuggerUrl'], max_msg_size=0) as socket:
                page = Browser(socket)
                for domain in ('Page', 'Runtime', 'Log'):
                    await page.call(f'{domain}.enable')
                await page.call('Page.navigate', url=url)
                yield page
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def visit(check, folder, token=TOKEN):
    async def main():
        hosts = set()
        backend = FlyingBackend()
        runner = web.AppRunner(TunerServer(backend, TOKEN, hosts).app)
        await runner.setup()
        await web.TCPSite(runner, '127.0.0.1', 0).start()
        host = f'127.0.0.1:{runner.addresses[0][1]}'
        hosts.add(host)
        try:
            async with browser(f'http://{host}/#token={token}', folder) as page:
                await check(page, backend)
        finally:
            await runner.cleanup()

    asyncio.run(main())


def type_into(name, text):
    return f"""(() => {{
        const field = document.getElementById('{name}');
        field.value = '{text}';
        field.dispatchEvent(new Event('input'));
        return true;
    }})()"""


def test_a_gain_is_changed_the_plot_moves_undo_brings_it_back_and_nonsense_is_refused(tmp_path):
    async def check(page, backend):
        await page.until("document.getElementById('roll_rate_p') && samples.length > 100")
        assert await page.run("document.getElementById('arming').textContent") == 'armed'
        before = await page.run("document.getElementById('roll').toDataURL()")
        await page.run(type_into('roll_rate_p', '0.07'))
        await page.run("document.getElementById('apply').click()")
        await page.until("document.querySelectorAll('#history li:not(.empty)').length === 1")
        assert backend.controller.params.roll_rate_p == 0.07
        await page.run("document.querySelector('[data-action=step_roll]').click()")
        await page.until('samples.some(s => s.estimate[0] * 180 / Math.PI > 9.5)')
        assert await page.run("document.getElementById('roll').toDataURL()") != before
        if 'PAGE_PICTURE' in os.environ:
            await page.until('samples[samples.length - 1].t - samples[0].t > 8')
            await page.picture(Path(os.environ['PAGE_PICTURE']))
        await page.run("document.getElementById('undo').click()")
        await page.until("document.getElementById('roll_rate_p').value === '0.06'")
        assert backend.controller.params.roll_rate_p == 0.06
        assert page.errors == []
        await page.run(type_into('roll_rate_p', '99'))
        await page.run("document.getElementById('apply').click()")
        await page.until("document.getElementById('message').textContent.includes('allowed: 0 … 1')")
        assert backend.controller.params.roll_rate_p == 0.06

    visit(check, tmp_path)


@pytest.mark.parametrize('width', [360, 390, 768])
def test_the_page_fits_a_small_screen_with_a_trial_running(width, tmp_path):
    async def check(page, backend):
        await page.call(
            'Emulation.setDeviceMetricsOverride', width=width, height=844, deviceScaleFactor=2, mobile=True
        )
        backend.trial = f'on trial: {", ".join(GAINS)} for 4 s'
        await page.until("!document.getElementById('trial').hidden && samples.length > 100")
        assert await page.run('document.scrollingElement.scrollWidth') == width
        assert await page.run("document.getElementById('kill').getBoundingClientRect().right") <= width
        if 'PAGE_PICTURE' in os.environ:
            await page.picture(Path(os.environ['PAGE_PICTURE']).with_suffix(f'.{width}.png'))

    visit(check, tmp_path)


def test_a_page_without_the_token_shows_what_to_do_and_no_gain(tmp_path):
    async def check(page, _backend):
        await page.until("document.getElementById('message').textContent.includes('Wrong token')")
        assert await page.run("document.querySelectorAll('.gain').length") == 0

    visit(check, tmp_path, token='wrong')
