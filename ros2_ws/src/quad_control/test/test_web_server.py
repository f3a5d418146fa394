# SPDX-License-Identifier: Apache-2.0
import asyncio

import aiohttp
import pytest
from aiohttp import web
from page_backend import FlyingBackend, has_ipv6

from quad_control.web_server import TunerServer, authority

TOKEN = 'a-token-of-the-test-0123456789'


def serve(check, address='127.0.0.1', proxy_host=''):
    """Run ``check(client, backend, url)`` against a real server on a free port."""

    async def main():
        hosts = set()
        backend = FlyingBackend()
        runner = web.AppRunner(TunerServer(backend, TOKEN, hosts, proxy_host).app)
        await runner.setup()
        await web.TCPSite(runner, address, 0).start()
        host = authority(address, runner.addresses[0][1])
        hosts.add(host)
        headers = {'Authorization': f'Bearer {TOKEN}'}
        try:
            async with aiohttp.ClientSession(f'http://{host}', headers=headers) as client:
                await check(client, backend, f'http://{host}')
        finally:
            await runner.cleanup()

    asyncio.run(main())


def value(backend, name):
    return next(g.value for g in backend.gains() if g.name == name)


def test_a_gain_is_set_remembered_and_undone():
    async def check(client, backend, _):
        async with client.post('/api/gains', json={'gains': {'roll_rate_p': 0.07}}) as r:
            assert r.status == 200
            assert (await r.json())['history'] == [{'by': 'page', 'changes': {'roll_rate_p': [0.06, 0.07]}}]
        assert value(backend, 'roll_rate_p') == 0.07
        async with client.post('/api/undo', json={}) as r:
            assert r.status == 200
        assert value(backend, 'roll_rate_p') == 0.06
        async with client.post('/api/undo', json={}) as r:
            assert r.status == 409

    serve(check)


@pytest.mark.parametrize('token', ['', 'wrong', TOKEN + 'x', 'ünïcode'])
def test_a_wrong_token_is_401(token):
    async def check(client, backend, _):
        bearer = {'Authorization': f'Bearer {token}'}
        async with client.get('/api/state', headers=bearer) as r:
            assert r.status == 401
        async with client.post('/api/gains', json={'gains': {'roll_rate_p': 0.07}}, headers=bearer) as r:
            assert r.status == 401
        assert value(backend, 'roll_rate_p') == 0.06

    serve(check)


@pytest.mark.parametrize(
    'headers', [{'Origin': 'http://evil.example'}, {'Origin': 'null'}, {'Host': 'evil.example'}]
)
def test_a_foreign_origin_or_host_is_403(headers):
    async def check(client, backend, _):
        async with client.post('/api/gains', json={'gains': {'roll_rate_p': 0.07}}, headers=headers) as r:
            assert r.status == 403
        async with client.get('/', headers=headers) as r:
            assert r.status == 403
        assert value(backend, 'roll_rate_p') == 0.06

    serve(check)


async def statuses(client, headers):
    """Return the status of a change of a gain and of the page's file under `headers`."""
    async with client.post('/api/gains', json={'gains': {'roll_rate_p': 0.07}}, headers=headers) as r:
        change = r.status
    async with client.get('/', headers=headers) as r:
        return change, r.status


def test_the_own_origin_is_the_page_with_and_without_tls():
    async def check(client, _backend, url):
        assert await statuses(client, {'Origin': url}) == (200, 200)
        assert await statuses(client, {'Origin': url.replace('http:', 'https:')}) == (200, 200)
        for foreign in (
            f'{url}0',
            f'{url}.evil.example',
            url.replace('http:', 'ftp:'),
            'https://',
            'https://evil.example',
        ):
            assert await statuses(client, {'Origin': foreign}) == (403, 403)

    serve(check)


def test_a_proxy_serves_the_page_under_its_name_over_tls_only_when_it_was_named():
    proxied = {'Host': 'quad.example', 'Origin': 'https://quad.example'}

    async def named(client, _backend, url):
        assert await statuses(client, proxied) == (200, 200)
        async with client.ws_connect('/ws', protocols=(f'token.{TOKEN}',), headers=proxied) as socket:
            assert await socket.receive_json()
        assert await statuses(client, {'Origin': url}) == (200, 200)
        for change in ({'Origin': 'http://quad.example'}, {'Origin': url}, {'Host': 'evil.example'}):
            assert await statuses(client, proxied | change) == (403, 403)
        assert await statuses(client, {'Origin': 'https://quad.example'}) == (403, 403)

    async def closed(client, _backend, _url):
        assert await statuses(client, proxied) == (403, 403)
        assert await statuses(client, {'Host': '', 'Origin': 'https://'}) == (403, 403)

    serve(named, proxy_host='quad.example')
    serve(closed)


@pytest.mark.skipif(not has_ipv6(), reason='this machine has no IPv6 loopback')
def test_an_ipv6_address_stands_in_brackets():
    async def check(client, _backend, url):
        assert url.startswith('http://[::1]:')
        assert await statuses(client, {'Origin': url}) == (200, 200)
        assert await statuses(client, {'Origin': 'http://[::2]:80'}) == (403, 403)

    serve(check, address='::1')


@pytest.mark.parametrize(
    'body',
    [
        '{"gains": {"roll_rate_p": NaN}}',
        '{"gains": {"roll_rate_p": Infinity}}',
        '{"gains": {"roll_rate_p": 1e999}}',
        '{"gains": {"roll_rate_p": 1' + '0' * 400 + '}}',
        '{"gains": {"roll_rate_p": 99.0}}',
        '{"gains": {"roll_rate_p": -0.1}}',
        '{"gains": {"roll_rate_p": true}}',
        '{"gains": {"roll_rate_p": "0.07"}}',
        '{"gains": {"roll_rate_p": 0.07, "no_such_gain": 1.0}}',
        '{"gains": {}}',
        '{"gains": {"roll_rate_p": 0.07}, "more": 1}',
        '{}',
        '[]',
        'nonsense',
        '[' * 20000,
    ],
)
def test_what_is_not_finite_bounded_and_exact_is_422_and_changes_nothing(body):
    async def check(client, backend, _):
        headers = {'Content-Type': 'application/json'}
        async with client.post('/api/gains', data=body, headers=headers) as r:
            assert r.status == 422
            assert (await r.json())['error']
        assert value(backend, 'roll_rate_p') == 0.06

    serve(check)


def test_other_content_is_415_and_too_much_of_it_413():
    async def check(client, backend, _):
        form = {'Content-Type': 'application/x-www-form-urlencoded'}
        async with client.post('/api/gains', data='{"gains": {"roll_rate_p": 0.07}}', headers=form) as r:
            assert r.status == 415
        async with client.post('/api/gains', json={'gains': 'x' * 100_000}) as r:
            assert r.status == 413

    serve(check)


def test_a_refusal_of_the_craft_is_409_with_its_reason():
    async def check(client, backend, _):
        async with client.post('/api/gains', json={'gains': {'max_rate': 13.0}}) as r:
            assert (r.status, await r.json()) == (409, {'error': 'thirteen is refused'})

    serve(check)


def test_yaml_is_saved_and_loaded_under_the_same_checks():
    async def check(client, backend, _):
        async with client.get('/api/yaml') as r:
            text = await r.text()
        assert 'attitude_controller:' in text
        changed = text.replace('roll_rate_p: 0.06', 'roll_rate_p: 0.065')
        async with client.post('/api/yaml', json={'yaml': changed}) as r:
            assert r.status == 200
        assert value(backend, 'roll_rate_p') == 0.065
        for bad in (
            changed.replace('0.065', '.nan'),
            changed.replace('0.065', '99'),
            'a: [',
            '!!python/object:os.x {}',
        ):
            async with client.post('/api/yaml', json={'yaml': bad}) as r:
                assert r.status == 422
        assert value(backend, 'roll_rate_p') == 0.065

    serve(check)


def test_only_known_actions_run():
    async def check(client, backend, _):
        async with client.post('/api/action', json={'name': 'kill'}) as r:
            assert r.status == 200
        for name in ('reboot', None, ['kill']):
            async with client.post('/api/action', json={'name': name}) as r:
                assert r.status == 422
        assert backend.acted == ['kill']

    serve(check)


def test_every_answer_carries_the_content_security_policy():
    async def check(client, _backend, _):
        for path in ('/', '/app.js', '/style.css', '/api/state', '/nowhere'):
            async with client.get(path) as r:
                assert "default-src 'none'" in r.headers['Content-Security-Policy']
                assert 'unsafe' not in r.headers['Content-Security-Policy']

    serve(check)


def test_the_page_loads_nothing_from_elsewhere():
    async def check(client, _backend, _):
        for path in ('/', '/app.js', '/plot.js', '/style.css'):
            async with client.get(path) as r:
                text = await r.text()
                assert r.status == 200
                assert 'https://' not in text
                assert 'src="http' not in text

    serve(check)


@pytest.mark.parametrize(
    ('origin', 'token', 'status'),
    [('http://evil.example', TOKEN, 403), (None, TOKEN, 403), ('own', 'wrong', 401)],
)
def test_a_websocket_needs_origin_and_token(origin, token, status):
    async def check(client, _backend, url):
        headers = {} if origin is None else {'Origin': url if origin == 'own' else origin}
        with pytest.raises(aiohttp.WSServerHandshakeError) as error:
            await client.ws_connect('/ws', protocols=(f'token.{token}',), headers=headers)
        assert error.value.status == status

    serve(check)


def test_the_websocket_streams_new_samples_and_the_values():
    async def check(client, _backend, url):
        async with client.ws_connect('/ws', protocols=(f'token.{TOKEN}',), headers={'Origin': url}) as socket:
            first, second = await socket.receive_json(), await socket.receive_json()
        assert first['values']['roll_rate_p'] == 0.06
        assert second['samples'][0][0] > first['samples'][-1][0]

    serve(check)
