# SPDX-License-Identifier: Apache-2.0
import calendar
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pynmeagps import NMEAMessage
from pyubx2 import UBXMessage

from ev_velocity.gps_stream import KNOT, GpsStream
from node_core.byte_frames import UBX


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


def test_sentences_are_believed_again_when_a_receiver_leaves_its_binary_messages_out():
    stream = GpsStream(0.1)
    assert [s.sigma for s in stream.feed(rmc() + pvt() + rmc())] == [0.1, pytest.approx(0.12)]
    assert len(list(stream.feed(rmc() * 40))) == 11
    assert len(list(stream.feed(pvt() + rmc()))) == 1


def test_a_speed_has_the_arrival_of_its_first_byte():
    stream, data = GpsStream(0.1), rmc() + rmc('3.0')
    assert list(stream.feed(data[:20], 100)) == []
    first, *_ = stream.feed(data[20:-5], 200)
    (second,) = stream.feed(data[-5:], 300)
    assert (first.arrival, second.arrival) == (100, 200)


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 20),
    st.integers(0, 99),
    st.integers(1, 255),
    st.integers(7, 120),
    st.sampled_from((pvt, rmc)),
)
@example(10, 5, 0x1F, 100, pvt)
@example(10, 4, 0xFF, 100, pvt)
def test_one_damaged_byte_costs_one_speed_and_ages_none(which, at, flip, piece, make):
    """10 Hz; `make` gives a message of its own speed each time, fed in pieces 1 ms apart."""
    stream, began, got = GpsStream(0.1), {}, []
    for i in range(30):
        speed = 1.0 + i
        data = bytearray(pvt(0, round(speed * 1e3)) if make is pvt else rmc(f'{speed / KNOT:.6f}'))
        if i == which:
            data[at % len(data)] ^= flip
        now = 1000 + 100 * i
        began[i] = now
        for start in range(0, len(data), piece):
            got += [(now, s) for s in stream.feed(bytes(data[start : start + piece]), now)]
            now += 1
    # A damaged line end takes the next line with it.
    assert len(got) >= 28
    assert all(s.arrival == began[round(s.speed - 1.0)] for _, s in got)
    assert np.diff([now for now, _ in got]).max(initial=0) <= 320


def test_after_the_source_was_lost_no_speed_has_a_time_from_before():
    stream = GpsStream(0.1)
    assert not list(stream.feed(rmc()[:40], 100))
    stream.clear()
    (speed,) = stream.feed(rmc('3.0'), 10_100)
    assert speed.arrival == 10_100


def test_what_a_parser_stumbles_over_is_counted():
    stream = GpsStream(0.1)
    assert not list(stream.feed(rmc('1.2.3')))
    # Whole by its checksum, but of another length than a NAV-PVT.
    body = b'\x01\x07' + (20).to_bytes(2, 'little') + bytes(20)
    first = second = 0
    for byte in body:
        first = (first + byte) & 255
        second = (second + first) & 255
    assert not list(stream.feed(UBX.sync + body + bytes((first, second))))
    assert stream.rejected == {'not decodable (NMEATypeError)': 1, 'no fix': 1}
    assert len(list(stream.feed(pvt()))) == 1


def test_messages_of_other_kinds_are_passed_over():
    stream = GpsStream(0.1)
    other = NMEAMessage('GP', 'GLL', 0, lat=47.0, lon=8.0).serialize()
    assert len(list(stream.feed(other + rmc()))) == 1
    assert not stream.rejected


def test_a_message_without_date_has_no_utc():
    body = 'GPRMC,083559.50,A,4717.11437,N,00833.91522,E,12.5,90.0,,,,A'
    checksum = 0
    for character in body:
        checksum ^= ord(character)
    (speed,) = GpsStream(0.1).feed(f'${body}*{checksum:02X}\r\n'.encode())
    assert speed.utc == 0
    plain = UBXMessage(
        'NAV', 'NAV-PVT', 0, validDate=0, validTime=0, fixType=3, gnssFixOk=1, velE=3000, velN=4000, sAcc=120
    )
    (speed,) = GpsStream(0.1).feed(plain.serialize())
    assert (speed.utc, speed.speed) == (0, pytest.approx(5.0))
