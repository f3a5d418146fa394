# SPDX-License-Identifier: Apache-2.0
import base64
import contextlib
import os
import socket
import threading

import pytest

from node_core.byte_sources import (
    NtripBytes,
    SourceError,
    TcpBytes,
    is_recorded,
    ntrip_address,
    open_source,
    public_name,
    tcp_address,
)


@contextlib.contextmanager
def server(*answers):
    """A server that takes one connection and one request, sends `answers` and hangs up."""
    requests = []
    with socket.create_server(('127.0.0.1', 0)) as listening:

        def serve():
            connection, _ = listening.accept()
            with connection:
                requests.append(connection.recv(4096) if answers[0] is None else b'')
                for answer in answers:
                    connection.sendall(answer or b'')

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listening.getsockname()[1], requests
        thread.join(timeout=10.0)


def read_all(source):
    data = []
    with pytest.raises(SourceError, match='closed by the server'):
        data.extend(iter(source.read, None))
    source.close()
    return b''.join(data)


@pytest.mark.parametrize('source', ['tcp://nowhere', 'tcp://:5', 'tcp://host:70000', 'tcp://host:x'])
def test_a_bad_address_is_named(source):
    with pytest.raises(SourceError, match='expected tcp://HOST:PORT'):
        tcp_address(source)
    with pytest.raises(SourceError, match='expected tcp://HOST:PORT'):
        public_name(source)


def test_sources_are_told_apart_by_name(tmp_path):
    names = ('a.ubx', '/dev/ttyACM0', 'COM3', 'tcp://h:1', 'ntrip://h/M')
    assert [is_recorded(name) for name in names] == [True, False, False, False, False]
    _, slave = os.openpty()
    link = tmp_path / 'gps0'
    link.symlink_to(os.ttyname(slave))
    assert not is_recorded(str(link))


def test_a_file_gives_its_bytes_and_ends(tmp_path):
    path = tmp_path / 'drive.nmea'
    path.write_bytes(b'$GP')
    source = open_source(str(path), 9600, True)
    assert source.read() == b'$GP'
    assert source.read() is None
    source.close()
    with pytest.raises(SourceError, match='No such file'):
        open_source(str(tmp_path / 'none.ubx'), 9600, True)
    with pytest.raises(SourceError, match='directory'):
        open_source(str(tmp_path), 9600, True)


def test_a_serial_port_gives_its_bytes_and_its_loss_is_named():
    master, slave = os.openpty()
    port = open_source(os.ttyname(slave), 115_200, False)
    os.write(master, b'\xb5\x62\x00\xff')
    data = b''
    while len(data) < 4:
        data += port.read()
    assert data == b'\xb5\x62\x00\xff'
    assert port.read() == b''
    os.close(slave)
    os.close(master)
    with pytest.raises(SourceError, match='lost'):
        port.read()
    port.close()
    with pytest.raises(SourceError, match='/dev/none: No such file'):
        open_source('/dev/none', 115_200, False)


def test_a_server_gives_its_bytes_and_its_end_is_named():
    with server(b'abc') as (port, _):
        assert read_all(TcpBytes(f'tcp://127.0.0.1:{port}')) == b'abc'


def test_a_server_that_is_not_there_is_named():
    with socket.create_server(('127.0.0.1', 0)) as listening:
        port = listening.getsockname()[1]
    with pytest.raises(SourceError, match=f'tcp://127.0.0.1:{port}: Connection refused'):
        open_source(f'tcp://127.0.0.1:{port}', 0, False)


@pytest.mark.parametrize(
    'head',
    [
        b'ICY 200 OK\r\n',
        b'ICY 200 OK\r\n\r\n',
        b'HTTP/1.0 200 OK\r\nServer: a caster\r\nContent-Type: gnss/data\r\n\r\n',
    ],
)
def test_a_caster_is_asked_with_a_login_and_its_head_taken_off(head):
    with server(None, head + b'\xd3\x00\x13') as (port, requests):
        source = NtripBytes(f'ntrip://me:se%40cret@127.0.0.1:{port}/BASE0')
        assert read_all(source) == b'\xd3\x00\x13'
    lines = requests[0].decode().split('\r\n')
    assert lines[0] == 'GET /BASE0 HTTP/1.0'
    assert any(line.startswith('User-Agent: NTRIP ') for line in lines)
    assert f'Authorization: Basic {base64.b64encode(b"me:se@cret").decode()}' in lines
    assert lines[-2:] == ['', '']


@pytest.mark.parametrize(
    ('answer', 'words'),
    [
        (b'SOURCETABLE 200 OK\r\n\r\nSTR;BASE1\r\n', 'no such mountpoint'),
        (b'HTTP/1.0 401 Unauthorized\r\n\r\n', '401 Unauthorized'),
        (b'', "answered ''"),
    ],
)
def test_what_a_caster_refuses_is_said_without_the_password(answer, words):
    with server(None, answer) as (port, _), pytest.raises(SourceError, match=words) as error:
        NtripBytes(f'ntrip://me:secret@127.0.0.1:{port}/BASE0')
    assert 'secret' not in str(error.value)


def test_names_that_are_said_hold_no_password():
    assert ntrip_address('ntrip://me:pw@host/M') == ('host', 2101, 'M', 'me:pw')
    assert public_name('ntrip://me:pw@host/M') == 'ntrip://host:2101/M'
    for bad in ('ntrip://me:pw@host', 'ntrip://me:pw@/M', 'ntrip://me:pw@host:x/M'):
        with pytest.raises(SourceError, match='expected ntrip://') as error:
            public_name(bad)
        assert 'pw' not in str(error.value)
