# SPDX-License-Identifier: Apache-2.0
import calendar
import math
import socket
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps import NMEAMessage
from pyubx2 import UBXMessage

from ev_velocity.gps_source import FileSource, SourceError, TcpSource, open_source
from ev_velocity.gps_stream import KNOT, GpsStream


def rmc(knots='12.5', course='90.0', status='A'):
    body = f'GPRMC,083559.50,{status},4717.11437,N,00833.91522,E,{knots},{course},091202,,,A'
    checksum = 0
    for character in body:
        checksum ^= ord(character)
    return f'${body}*{checksum:02X}\r\n'.encode()


def pvt(east=3000, north=4000, sigma=120, ok=1, fix=3):
    return UBXMessage(
        'NAV', 'NAV-PVT', 0,
        year=2026, month=1, day=2, hour=3, min=4, second=5, validDate=1, validTime=1, nano=250_000_000,
        fixType=fix, gnssFixOk=ok, velE=east, velN=north, sAcc=sigma,
    ).serialize()  # fmt: skip


def test_nmea_gives_speed_course_and_time():
    (speed,) = GpsStream(0.1).feed(rmc())
    assert speed.speed == pytest.approx(12.5 * KNOT)
    assert speed.east == pytest.approx(12.5 * KNOT)
    assert speed.north == pytest.approx(0.0, abs=1e-9)
    assert speed.sigma == 0.1
    assert speed.utc == calendar.timegm((2002, 12, 9, 8, 35, 59)) * 10**9 + 500_000_000


def test_ubx_gives_speed_with_its_accuracy_and_time():
    (speed,) = GpsStream(0.1).feed(pvt())
    assert speed.speed == pytest.approx(5.0)
    assert (speed.east, speed.north) == pytest.approx((3.0, 4.0))
    assert speed.sigma == pytest.approx(0.12)
    assert speed.utc == calendar.timegm((2026, 1, 2, 3, 4, 5)) * 10**9 + 250_000_000


def test_a_receiver_that_speaks_both_counts_once():
    assert len(GpsStream(0.1).feed(pvt() + rmc() + pvt() + rmc())) == 2


def test_without_a_fix_there_is_no_speed():
    stream = GpsStream(0.1)
    assert stream.feed(rmc(status='V') + pvt(ok=0) + pvt(fix=0) + rmc(knots='')) == []
    assert stream.rejected['no fix'] == 3


def test_a_standing_receiver_without_course_is_used_a_moving_one_is_not():
    stream = GpsStream(0.1)
    (speed,) = stream.feed(rmc(knots='0.02', course=''))
    assert math.hypot(speed.east, speed.north) == pytest.approx(0.02 * KNOT)
    assert stream.feed(rmc(knots='10.0', course='')) == []
    assert stream.rejected['no course'] == 1


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=30), st.binary(max_size=30))
def test_pieces_and_noise_between_messages_lose_none(sizes, noise):
    noise = bytes(b for b in noise if b not in b'$\xb5')
    data = noise + rmc() + noise + rmc('3.0')
    stream, got, at = GpsStream(0.1), [], 0
    for size in [*sizes, len(data)]:
        got += stream.feed(data[at : at + size])
        at += size
    assert [s.speed for s in got] == pytest.approx([12.5 * KNOT, 3.0 * KNOT])


def test_damage_is_counted_and_the_next_message_read():
    stream = GpsStream(0.1)
    bad_nmea = bytearray(rmc())
    bad_nmea[12] ^= 1
    bad_ubx = bytearray(pvt())
    bad_ubx[30] ^= 255
    assert len(stream.feed(bytes(bad_nmea) + bytes(bad_ubx) + b'\xb5\x62\x01\x07\xff\xff' + rmc())) == 1
    assert stream.rejected['checksum or format'] == 2
    assert stream.rejected['bytes between messages'] >= 2


def test_sources_give_bytes_or_one_clear_line(tmp_path):
    path = tmp_path / 'drive.nmea'
    path.write_bytes(rmc())
    source = open_source(str(path), 9600)
    assert isinstance(source, FileSource)
    assert source.read() == rmc()
    assert source.read() is None
    source.close()
    with pytest.raises(SourceError, match='expected tcp://HOST:PORT'):
        open_source('tcp://nowhere', 9600)
    with pytest.raises(SourceError, match='/dev/none'):
        open_source('/dev/none', 9600)


def test_a_tcp_source_says_when_the_server_hangs_up():
    with socket.create_server(('127.0.0.1', 0)) as server:

        def serve():
            connection, _ = server.accept()
            connection.sendall(rmc())
            connection.close()

        thread = threading.Thread(target=serve)
        thread.start()
        source = TcpSource(f'tcp://127.0.0.1:{server.getsockname()[1]}')
        assert source.read() == rmc()
        thread.join()
        with pytest.raises(SourceError, match='closed by the server'):
            source.read()
        source.close()


def test_messages_of_other_kinds_are_passed_over():
    stream = GpsStream(0.1)
    other = NMEAMessage('GP', 'GLL', 0, lat=47.0, lon=8.0).serialize()
    assert stream.feed(other + rmc()) != []
    assert not stream.rejected
