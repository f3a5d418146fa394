# SPDX-License-Identifier: Apache-2.0
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_fakes import UNIT, rtu

from ship_inclinometer.modbus_frames import FramingLostError, Request, split_rtu, split_tcp

READ = (3, 0, 10, 0, 2)
MINE = rtu(UNIT, *READ)
WANTED = [Request(UNIT, bytes(READ))]
REPLY = rtu(2, 3, 4, 0, 1, 0, 2)
WRITE16 = rtu(2, 16, 0, 0, 0, 2, 4, 1, 2, 3, 4)


def test_one_request_is_found_whole():
    assert split_rtu(MINE, UNIT) == (WANTED, len(MINE))


@pytest.mark.parametrize(
    'before',
    [
        b'\x00',
        b'\xff' * 7,
        os.urandom(20),
        MINE[:3],
        MINE[:7],
        REPLY,
        REPLY[:-3],
        WRITE16,
        WRITE16[:9],
        rtu(2, 16, 0, 0, 0, 2),
        rtu(2, 0x83, 2),
        rtu(9, *READ),
        rtu(UNIT, 3, 0, 10, 0, 2)[:-1] + b'\x00',
    ],
    ids=lambda b: b.hex()[:16],
)
def test_the_next_request_is_found_after_anything_without_a_pause(before):
    requests, done = split_rtu(before + MINE, UNIT)
    assert requests == WANTED
    assert done == len(before) + len(MINE)


def test_a_request_inside_anothers_data_is_not_for_us():
    assert split_rtu(rtu(2, 3, len(MINE), *MINE), UNIT)[0] == []
    assert split_rtu(rtu(2, 16, 0, 0, 0, 4, 8, *MINE), UNIT)[0] == []
    assert split_rtu(rtu(2, 0x2B, 14, 1, *MINE), UNIT)[0] == []


def test_two_requests_in_one_burst_are_both_found():
    assert split_rtu(MINE + MINE, UNIT)[0] == 2 * WANTED


def test_a_bad_crc_is_silence():
    for position in range(len(MINE)):
        broken = bytearray(MINE)
        broken[position] ^= 0x10
        assert split_rtu(bytes(broken), UNIT)[0] == []


def test_an_unknown_function_of_ours_is_handed_on_and_a_reply_is_not():
    assert split_rtu(rtu(UNIT, 0x2B, 14, 1, 0), UNIT)[0] == [Request(UNIT, bytes([0x2B, 14, 1, 0]))]
    assert split_rtu(rtu(UNIT, 0x83, 2), UNIT)[0] == []


def test_a_half_frame_is_left_for_its_other_half():
    requests, done = split_rtu(MINE[:5], UNIT)
    assert requests == []
    assert done == 0


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_noise_never_raises_and_never_uses_more_than_it_has(data):
    requests, done = split_rtu(data, UNIT)
    assert 0 <= done <= len(data)
    assert all(r.unit in (0, UNIT) for r in requests)


def tcp(transaction, *pdu, unit=UNIT, protocol=0):
    body = bytes([unit, *pdu])
    return transaction.to_bytes(2, 'big') + protocol.to_bytes(2, 'big') + len(body).to_bytes(2, 'big') + body


def test_pipelined_requests_come_out_in_order_and_a_part_is_left():
    data = tcp(1, *READ) + tcp(2, *READ) + tcp(3, *READ)[:9]
    requests, used = split_tcp(data)
    assert [r.transaction for r in requests] == [1, 2]
    assert used == len(data) - 9


def test_another_protocol_is_passed_over():
    requests, used = split_tcp(tcp(1, *READ, protocol=1) + tcp(2, *READ))
    assert [r.transaction for r in requests] == [2]
    assert used == 24


@pytest.mark.parametrize('length', [0, 1, 255, 65535])
def test_an_impossible_length_ends_the_stream(length):
    with pytest.raises(FramingLostError):
        split_tcp(b'\x00\x01\x00\x00' + length.to_bytes(2, 'big') + b'\x07\x03')
