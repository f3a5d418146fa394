# SPDX-License-Identifier: Apache-2.0
"""Settings on the medium: written whole or not at all, read only with the right CRC."""

from __future__ import annotations

import json
import os
from pathlib import Path

from ship_inclinometer import modbus_map as m
from ship_inclinometer.modbus_device import settings_crc


class SettingsError(ValueError):
    """A settings file cannot be used; the message says which and why."""


def save_settings(path: Path, settings: dict[str, float], crc: int) -> None:
    """Write `settings` so that a power cut leaves the old file or the new one; raise OSError on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f'.{path.name}.part')
    with partial.open('w', encoding='utf-8') as file:
        json.dump({'crc': crc, 'settings': settings}, file, indent=2)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load_settings(path: Path) -> tuple[dict[str, float], int]:
    """Return settings and CRC of `path`, ({}, 0) when there is none; raise SettingsError when damaged."""
    if not path.exists():
        return {}, 0
    try:
        document = json.loads(path.read_text(encoding='utf-8'))
        stored, crc = document['settings'], document['crc']
        settings = {s.name: float(stored.get(s.name, s.default)) for s in m.SETTINGS}
        for s in m.SETTINGS:
            m.word_to_setting(s, m.setting_to_word(s, settings[s.name]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SettingsError(f'{path}: not a settings file ({error})') from error
    if settings_crc(settings) != crc:
        raise SettingsError(f'{path}: its CRC does not fit its settings')
    return settings, crc
