# SPDX-License-Identifier: Apache-2.0
import json

import pytest

from ship_inclinometer import modbus_map as m
from ship_inclinometer.modbus_device import settings_crc
from ship_inclinometer.settings_file import SettingsError, load_settings, save_settings

SETTINGS = {s.name: s.default for s in m.SETTINGS}
CRC = settings_crc(SETTINGS)


def test_what_is_saved_is_loaded(tmp_path):
    path = tmp_path / 'not_there_yet' / 'settings.json'
    assert load_settings(path) == ({}, 0)
    save_settings(path, SETTINGS, CRC)
    assert load_settings(path) == (SETTINGS, CRC)


def test_a_half_written_file_leaves_the_old_settings(tmp_path):
    path = tmp_path / 'settings.json'
    save_settings(path, SETTINGS, CRC)
    (tmp_path / '.settings.json.part').write_text('{"crc": 1, "sett')
    assert load_settings(path) == (SETTINGS, CRC)
    save_settings(path, SETTINGS | {'heel_warning': 11.0}, CRC)
    with pytest.raises(SettingsError, match='CRC'):
        load_settings(path)


@pytest.mark.parametrize(
    'text',
    [
        '',
        'nonsense',
        '[]',
        '{"settings": {}}',
        json.dumps({'crc': CRC, 'settings': 3}),
        json.dumps({'crc': CRC, 'settings': SETTINGS | {'heel_warning': 'x'}}),
        json.dumps({'crc': CRC, 'settings': SETTINGS | {'heel_warning': 1e9}}),
    ],
)
def test_what_is_no_settings_file_is_named(tmp_path, text):
    path = tmp_path / 'settings.json'
    path.write_text(text)
    with pytest.raises(SettingsError, match=r'settings\.json: not a settings file'):
        load_settings(path)
