# SPDX-License-Identifier: Apache-2.0
from collections import Counter
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps import NMEAMessage
from pyrtcm.rtcmhelpers import calc_crc24q
from pyubx2 import GET, UBXMessage

from node_core.byte_frames import NMEA, RTCM, UBX, MessageCutter, crc24q


def ubx(second=1):
    return UBXMessage('NAV', 'NAV-PVT', GET, second=second).serialize()


@cache  # pynmeagps writes the present time into it
def nmea(speed=10.0):
    return NMEAMessage('GN', 'RMC', GET, status='A', spd=speed).serialize()


def rtcm(payload=b'\x43\x50' + bytes(range(40))):
    frame = b'\xd3' + len(payload).to_bytes(2, 'big') + payload
    return frame + calc_crc24q(frame).to_bytes(3, 'big')


def cut(stream, *protocols, piece=10**6):
    rejected = Counter()
    cutter = MessageCutter(rejected, *protocols)
    out = [m for i in range(0, len(stream), piece) for m in cutter.feed(stream[i : i + piece])]
    return out, rejected


@pytest.mark.parametrize('piece', [1, 7, 10**6])
def test_three_protocols_on_one_port_are_told_apart(piece):
    messages = [ubx(), nmea(), rtcm(), nmea(3.0), ubx(2), rtcm(b'\x3e\xd0' * 9)]
    out, rejected = cut(b''.join(messages), UBX, NMEA, RTCM, piece=piece)
    assert out == messages
    assert not rejected


@pytest.mark.parametrize('piece', [1, 7, 10**6])
@pytest.mark.parametrize(
    ('protocol', 'make'), [(UBX, ubx), (NMEA, nmea), (RTCM, rtcm)], ids=['ubx', 'nmea', 'rtcm']
)
def test_garbage_truncation_and_bad_checksums_cost_no_good_message(protocol, make, piece):
    good = make()
    broken = bytearray(good)
    broken[-8] ^= 1
    stream = b'noise\xb5' + good + bytes(broken) + good + good[:20] + good + good
    out, rejected = cut(stream + bytes(300), protocol, piece=piece)
    assert out == [good] * 4
    assert rejected['checksum'] >= 1


@pytest.mark.parametrize('piece', [1, 33, 10**6])
@pytest.mark.parametrize(('protocol', 'make'), [(UBX, ubx), (RTCM, rtcm)], ids=['ubx', 'rtcm'])
def test_a_damaged_length_holds_nothing_back(protocol, make, piece):
    good = make()
    broken = bytearray(good)
    broken[5 if protocol is UBX else 1] ^= 0x03
    out, rejected = cut(bytes(broken) + good, protocol, piece=piece)
    assert out == [good]
    assert rejected == {'no message': 1}


@pytest.mark.parametrize('piece', [1, 7, 64])
def test_every_message_has_the_arrival_of_its_own_first_byte(piece):
    stream = ubx(1)[:40] + ubx(2) + nmea() + ubx(3)[:50] + nmea(3.0) + b'$GP' + ubx(4) + nmea() + nmea(3.0)
    cutter = MessageCutter(Counter(), UBX, NMEA)
    found = [
        (message, cutter.arrival)
        for at in range(0, len(stream), piece)
        for message in cutter.feed(stream[at : at + piece], at)
    ]
    begins, position = [], 0
    for message in (ubx(2), nmea(), nmea(3.0), ubx(4), nmea(), nmea(3.0)):
        position = stream.index(message, position)
        begins.append((message, position - position % piece))
        position += len(message)
    assert found == begins


def test_a_source_opened_anew_has_nothing_from_before():
    cutter = MessageCutter(Counter(), UBX)
    assert not list(cutter.feed(ubx()[:60], 1))
    cutter.clear()
    assert not list(cutter.feed(ubx()[60:], 2))
    assert list(cutter.feed(ubx(2), 3)) == [ubx(2)]
    assert cutter.arrival == 3


def test_a_length_that_cannot_be_is_not_waited_for():
    out, rejected = cut(b'\xb5\x62\x02\x15\xff\xff' + ubx(), UBX)
    assert (len(out), rejected) == (1, {'no message': 1})
    out, rejected = cut(b'\xd3\xff\xff' + rtcm(), RTCM)
    assert (len(out), rejected) == (1, {'no message': 1})
    out, rejected = cut(b'$' + b'A' * 300 + nmea(), NMEA)
    assert (len(out), rejected) == (1, {'no message': 1})


def test_a_sentence_without_checksum_is_refused():
    out, rejected = cut(b'$GPRMC,1,A\r\n' + nmea(), NMEA)
    assert (out, rejected) == ([nmea()], {'checksum': 1})


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=60))
def test_the_checksum_is_that_of_pyrtcm(data):
    assert crc24q(data) == calc_crc24q(data)


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=400), st.integers(1, 50))
def test_pieces_of_any_size_give_the_same(noise, piece):
    stream = noise + ubx() + noise + nmea() + rtcm() + bytes(9000)
    assert cut(stream, UBX, NMEA, RTCM, piece=piece)[0] == cut(stream, UBX, NMEA, RTCM)[0]
