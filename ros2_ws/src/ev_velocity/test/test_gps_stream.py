# SPDX-License-Identifier: Apache-2.0
import calendar
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps import NMEAMessage
from pyubx2 import UBXMessage

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
    assert len(list(GpsStream(0.1).feed(pvt() + rmc() + pvt() + rmc()))) == 2


def test_without_a_fix_there_is_no_speed():
    stream = GpsStream(0.1)
    assert not list(stream.feed(rmc(status='V') + pvt(ok=0) + pvt(fix=0) + rmc(knots='')))
    assert stream.rejected['no fix'] == 3


def test_a_standing_receiver_without_course_is_used_a_moving_one_is_not():
    stream = GpsStream(0.1)
    (speed,) = stream.feed(rmc(knots='0.02', course=''))
    assert math.hypot(speed.east, speed.north) == pytest.approx(0.02 * KNOT)
    assert not list(stream.feed(rmc(knots='10.0', course='')))
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
    assert len(list(stream.feed(bytes(bad_nmea) + bytes(bad_ubx) + b'\xb5\x62\x01\x07\xff\xff' + rmc()))) == 1
    assert stream.rejected == {'checksum': 2, 'no message': 1}


def test_a_speed_has_the_arrival_of_its_first_byte():
    stream, data = GpsStream(0.1), rmc() + rmc('3.0')
    assert list(stream.feed(data[:20], 100)) == []
    first, *_ = stream.feed(data[20:-5], 200)
    (second,) = stream.feed(data[-5:], 300)
    assert (first.arrival, second.arrival) == (100, 200)


def test_messages_of_other_kinds_are_passed_over():
    stream = GpsStream(0.1)
    other = NMEAMessage('GP', 'GLL', 0, lat=47.0, lon=8.0).serialize()
    assert len(list(stream.feed(other + rmc()))) == 1
    assert not stream.rejected
