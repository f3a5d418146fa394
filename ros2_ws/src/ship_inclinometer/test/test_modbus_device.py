# SPDX-License-Identifier: Apache-2.0
import asyncio
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_fakes import KEY, make

from ship_inclinometer import modbus_map as m


def ask(device, *pdu):
    return asyncio.run(device.respond(bytes(pdu), 'test'))


def words(*values):
    return struct.pack(f'>{len(values)}H', *values)


def unlock(device):
    assert ask(device, 6, *words(m.UNLOCK, KEY)) == bytes([6]) + words(m.UNLOCK, KEY)


HEEL_WARNING = m.FIRST_SETTING
LAST = m.FIRST_SETTING + len(m.SETTINGS) - 1


@pytest.mark.parametrize('function', [0, 7, 8, 11, 17, 20, 24, 43, 99, 127])
def test_an_unknown_function_is_answered_with_01(function):
    assert ask(make()[0], function, 0, 0, 0, 1) == bytes([function | 0x80, 1])


@pytest.mark.parametrize(
    ('pdu', 'code'),
    [
        ((1, 0, 0, 0, 0), 3),
        ((1, 0, 0, 0x07, 0xD1), 3),
        ((2, 0, 0, 0x07, 0xD0), 2),
        ((3, 0, 0, 0, 0), 3),
        ((3, 0, 0, 0, 126), 3),
        ((3, 0xFF, 0xFF, 0, 2), 2),
        ((3, 0, 3, 0, 2), 2),
        ((4, 0, m.INPUT_COUNT, 0, 1), 2),
        ((4, 0, 0, 0, m.INPUT_COUNT + 1), 2),
        ((4, 0, 0, 0), 3),
        ((4, 0, 0, 0, 1, 0), 3),
        ((5, 0, 0, 0x12, 0x34), 3),
        ((5, 0, 0, 0x00, 0xFF), 3),
        ((5, 0, 0, 0x00, 0x01), 3),
        ((5, 0, len(m.COILS), 0xFF, 0), 2),
        ((6, 0, 200, 0, 1), 2),
        ((6, 0, m.SETTINGS_CRC, 0, 1), 2),
        ((15, 0, 0, 0, 0, 0), 3),
        ((15, 0, 0, 0, 2, 2, 1, 0), 3),
        ((15, 0, 0, 0, 9, 2, 1, 0), 2),
        ((15, 0, 0, 0x07, 0xB1, 0xF7), 3),
        ((16, 0, HEEL_WARNING, 0, 0, 0), 3),
        ((16, 0, HEEL_WARNING, 0, 1, 4, 0, 1, 0, 1), 3),
        ((16, 0, HEEL_WARNING, 0, 2, 4, 0, 1), 3),
        ((16, 0, LAST, 0, 2, 4, 0, 1, 0, 1), 2),
        ((22, 0, 200, 0, 0, 0, 0), 2),
        ((22, 0, HEEL_WARNING, 0, 0), 3),
        ((23, 0, 0, 0, 0, 0, HEEL_WARNING, 0, 1, 2, 0, 1), 3),
        ((23, 0, 0, 0, 126, 0, HEEL_WARNING, 0, 1, 2, 0, 1), 3),
        ((23, 0, 200, 0, 1, 0, HEEL_WARNING, 0, 1, 2, 0, 50), 2),
        ((23, 0, 0, 0, 1, 0, HEEL_WARNING, 0, 2, 2, 0, 1), 3),
    ],
)
def test_malformed_requests_get_the_code_of_the_specification(pdu, code):
    device, ship, _ = make()
    unlock(device)
    before = dict(device.settings)
    assert ask(device, *pdu) == bytes([pdu[0] | 0x80, code])
    assert device.settings == before
    assert ship.commands == []


WRITES = [
    (5, 0, 2, 0xFF, 0),
    (6, *words(HEEL_WARNING, 110)),
    (15, 0, 2, 0, 1, 1, 1),
    (16, *words(HEEL_WARNING, 1), 2, 0, 110),
    (22, *words(HEEL_WARNING, 0, 110)),
    (23, *words(0, 1, HEEL_WARNING, 1), 2, 0, 110),
]


@pytest.mark.parametrize('pdu', WRITES, ids=lambda p: f'FC{p[0]}')
def test_each_writing_function_is_locked_until_the_key_and_again_after_its_time(pdu):
    device, ship, clock = make()
    assert ask(device, *pdu) == bytes([pdu[0] | 0x80, 1])
    assert ship.commands == []
    assert device.settings['heel_warning'] == 10.0
    unlock(device)
    assert ask(device, *pdu)[0] == pdu[0]
    assert ship.commands == ['log_mark'] or device.settings['heel_warning'] == 11.0
    kinds = [kind for kind, _, _ in ship.events]
    assert kinds[0] == 'refused'
    assert kinds[1] == 'unlock'
    assert kinds[2] in ('command', 'setting')
    clock.now += 60.1
    assert ask(device, *pdu) == bytes([pdu[0] | 0x80, 1])


def test_the_unlock_register_never_tells_the_key():
    device, _, _ = make()
    unlock(device)
    assert ask(device, 3, *words(m.UNLOCK, 1)) == bytes([3, 2, 0, 0])
    assert ask(device, 3, *words(m.REMAINING, 1)) == bytes([3, 2, 0, 60])


def test_the_key_counts_only_when_written_alone():
    device, _, _ = make()
    assert ask(device, 16, *words(m.UNLOCK, 2), 4, *words(KEY, m.SAVE_COMMAND))[1] == 3
    assert not device.unlocked


def test_three_wrong_keys_close_the_lock_for_a_while():
    device, ship, clock = make()
    for _ in range(3):
        assert ask(device, 6, *words(m.UNLOCK, 0x4321)) == bytes([0x86, 3])
    assert ask(device, 6, *words(m.UNLOCK, KEY)) == bytes([0x86, 3])
    assert not device.unlocked
    clock.now += 31.0
    unlock(device)
    assert [kind for kind, _, _ in ship.events] == ['refused'] * 3 + ['unlock']


def test_a_key_of_zero_never_opens():
    device, _, _ = make()
    device._key = 0
    assert ask(device, 6, *words(m.UNLOCK, 0)) == bytes([0x86, 3])


def test_values_out_of_range_change_nothing_not_even_the_good_ones_beside_them():
    device, ship, _ = make()
    unlock(device)
    assert ask(device, 16, *words(HEEL_WARNING, 2), 4, *words(110, 9999)) == bytes([0x90, 3])
    assert device.settings['heel_warning'] == 10.0
    assert [kind for kind, _, _ in ship.events] == ['unlock']
    assert ask(device, 6, *words(HEEL_WARNING, 250)) == bytes([0x86, 3])


def test_a_write_that_cannot_be_logged_is_answered_with_04_and_changes_nothing():
    device, ship, _ = make()
    unlock(device)
    ship.broken = True
    assert ask(device, 6, *words(HEEL_WARNING, 110)) == bytes([0x86, 4])
    assert ask(device, 5, 0, 2, 0xFF, 0) == bytes([0x85, 4])
    assert device.settings['heel_warning'] == 10.0
    assert ship.commands == []


def test_negative_offsets_are_twos_complement():
    device, ship, _ = make()
    unlock(device)
    address = m.FIRST_SETTING + [s.name for s in m.SETTINGS].index('roll_offset')
    ask(device, 6, *words(address, 0xFF85))
    assert ship.settings['roll_offset'] == pytest.approx(-1.23)
    assert ask(device, 3, *words(address, 1)) == bytes([3, 2]) + words(0xFF85)


def test_mask_write_works_on_the_present_value():
    device, _, _ = make()
    unlock(device)
    # 100 = 0b01100100; AND 0xFFFB clears bit 2, OR 0x0004 with AND bit clear sets it again.
    assert ask(device, 22, *words(HEEL_WARNING, 0xFFFB, 0)) == bytes([22]) + words(HEEL_WARNING, 0xFFFB, 0)
    assert device.settings['heel_warning'] == pytest.approx(9.6)
    ask(device, 22, *words(HEEL_WARNING, 0xFFFB, 4))
    assert device.settings['heel_warning'] == pytest.approx(10.0)


def test_read_write_reads_what_it_has_written():
    device, _, _ = make()
    unlock(device)
    answer = ask(device, 23, *words(HEEL_WARNING, 1, HEEL_WARNING, 1), 2, 0, 123)
    assert answer == bytes([23, 2, 0, 123])


def test_coils_clear_themselves():
    device, ship, _ = make()
    unlock(device)
    assert ask(device, 15, 0, 0, 0, 3, 1, 0b101) == bytes([15, 0, 0, 0, 3])
    assert ship.commands == ['acknowledge', 'log_mark']
    assert ask(device, 1, 0, 0, 0, len(m.COILS)) == bytes([1, 1, 0])


def test_save_reports_a_crc_of_what_was_saved():
    device, ship, _ = make()
    unlock(device)
    ask(device, 6, *words(m.SAVE, m.SAVE_COMMAND))
    settings_, crc = ship.saved
    assert settings_['heel_warning'] == 10.0
    assert ask(device, 3, *words(m.SETTINGS_CRC, 1)) == bytes([3, 2]) + words(crc)
    assert ask(device, 6, *words(m.SAVE, 1)) == bytes([0x86, 3])


def test_the_input_block_says_what_it_was_given():
    device, _, _ = make()
    values = {f.name: 1.5 for f in m.MEASURED} | {'roll': -3.21, 'roll_period': float('nan')}
    values |= {'utc_seconds': 1767225600, 'utc_milliseconds': 250, 'age': 12}
    asyncio.run(device.update(values, {'valid': True, 'heel_alarm': True}))
    answer = ask(device, 4, *words(0, m.INPUT_COUNT))
    read = struct.unpack(f'>{m.INPUT_COUNT}H', answer[2:])

    def at(name, count=1):
        start = m.INPUT_ADDRESS[name]
        return read[start : start + count]

    assert at('map_version') == (m.MAP_VERSION,)
    assert at('status') == (1 | 1 << m.DISCRETE.index('heel_alarm'),)
    assert at('sequence') == at('sequence_copy') == (1,)
    assert struct.unpack('>I', struct.pack('>2H', *at('utc_seconds', 2))) == (1767225600,)
    assert at('roll') == (0x10000 - 321,)
    assert at('roll_period') == (m.UNKNOWN_UINT16,)
    assert struct.unpack('>f', struct.pack('>2H', *at('roll_float', 2)))[0] == pytest.approx(-3.21)
    assert at('check_uint32', 2) == (0x1234, 0x5678)
    assert struct.unpack('>f', struct.pack('>2H', *at('check_float32', 2))) == (1234.5,)
    assert ask(device, 2, 0, 0, 0, 16) == bytes([2, 2, 1, 2])


def test_the_block_fits_one_read():
    assert m.INPUT_COUNT <= 125


@settings(max_examples=300, deadline=None)
@given(st.binary(min_size=1, max_size=253))
def test_no_pdu_raises_and_none_changes_a_locked_device(pdu):
    device, ship, _ = make()
    answer = asyncio.run(device.respond(pdu, 'fuzz'))
    assert answer[0] & 0x7F == pdu[0] & 0x7F
    assert ship.commands == []
    if not device.unlocked:
        assert device.settings == {s.name: s.default for s in m.SETTINGS}


def test_the_readme_holds_the_map_of_the_code():
    readme = (Path(__file__).parents[1] / 'README.md').read_text()
    assert f'<!-- modbus-map -->\n{m.map_markdown()}\n<!-- end -->' in readme


@pytest.mark.parametrize('heading', [0.0, 359.994, 359.996, 359.99999999, 360.0])
def test_a_heading_is_never_360(heading):
    field, single = (next(f for f in m.INPUT_FIELDS if f.name == n) for n in ('heading', 'heading_float'))
    assert m.encode_field(field, heading)[0] in (0, 35999)
    assert 0.0 <= struct.unpack('>f', struct.pack('>2H', *m.encode_field(single, heading)))[0] < 360.0


@pytest.mark.parametrize('value', [1e39, -1e300, float('inf'), float('nan')])
def test_what_no_float32_holds_is_unknown(value):
    single = next(f for f in m.INPUT_FIELDS if f.name == 'roll_float')
    read = struct.unpack('>f', struct.pack('>2H', *m.encode_field(single, value)))[0]
    assert read != read


def test_alarms_and_roll_that_nobody_tells_are_said_to_be_unknown():
    device, _, _ = make()
    times = {'utc_seconds': 0.0, 'utc_milliseconds': 0.0, 'age': 0.0}
    asyncio.run(device.update(times, {'valid': True, 'alarms_unknown': True, 'roll_unknown': True}))
    assert ask(device, 2, *words(16, 2)) == bytes([2, 1, 3])
    assert ask(device, 4, *words(m.INPUT_ADDRESS['status'], 1)) == bytes([4, 2, 0, 1])
    assert ask(device, 4, *words(m.INPUT_ADDRESS['status_more'], 1)) == bytes([4, 2, 0, 3])


def test_a_hysteresis_that_no_alarm_could_end_with_is_refused():
    device, _, _ = make()
    unlock(device)
    hysteresis = m.FIRST_SETTING + [s.name for s in m.SETTINGS].index('hysteresis')
    assert ask(device, 6, *words(hysteresis, 80)) == bytes([0x86, 3])
    assert ask(device, 6, *words(hysteresis, 79))[0] == 6
    # Nor may a threshold come down upon the hysteresis.
    assert ask(device, 6, *words(m.FIRST_SETTING + 3, 79)) == bytes([0x86, 3])
