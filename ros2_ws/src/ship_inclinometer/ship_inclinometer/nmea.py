# SPDX-License-Identifier: Apache-2.0
"""NMEA 0183 / IEC 61162-1 sentences: HRM, XDR, HDT, THS, ROT. Pure text.

HRM is IEC 61162-1:2016 edition 5: heel, period, amplitudes, status, peaks and the time of their reset.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

from ship_inclinometer.marine import Picture
from ship_inclinometer.samples import INVALID

# Heel (deg) of MSC.363(92): what may be further off is sent, but with status V.
_ACCURACY = 1.0


def checksum(body: str) -> str:
    """Return the two hexadecimal digits: XOR of all characters between $ and *."""
    value = 0
    for character in body.encode('ascii'):
        value ^= character
    return f'{value:02X}'


def sentence(talker: str, formatter: str, *fields: str) -> str:
    """Return a whole sentence with checksum and line end."""
    body = ','.join((talker + formatter, *fields))
    return f'${body}*{checksum(body)}\r\n'


def number(value: float, decimals: int = 1) -> str:
    """Return a number, or an empty field for one that is not known."""
    if not math.isfinite(value):
        return ''
    text = f'{value:.{decimals}f}'
    # No negative zero: a display would show heel to port on an even keel.
    return text.removeprefix('-') if float(text) == 0.0 else text


def hrm(talker: str, picture: Picture, now: int) -> str:
    """Return heel, roll period, amplitudes, status and peaks."""
    validity, _ = picture.shown_validity(now)
    valid = validity != INVALID
    names = ('roll_period', 'amplitude_port', 'amplitude_starboard')
    measured = [number(picture.number(n, now)) if valid else '' for n in names]
    reset = ['', '', '']
    peaks = [number(picture.number(n, now)) for n in ('peak_port', 'peak_starboard')]
    if picture.peak_reset > 0 and peaks[0]:
        moment = datetime.fromtimestamp(picture.peak_reset * 1e-9, UTC)
        reset = [f'{moment:%H%M%S}', f'{moment:%d}', f'{moment:%m}']
    heel = number(picture.roll) if valid else ''
    status = 'A' if valid and picture.sigma_roll <= _ACCURACY else 'V'
    return sentence(talker, 'HRM', heel, *measured, status, *peaks, *reset)


def xdr(talker: str, picture: Picture, now: int) -> str:
    """Return heel and trim as angular displacement transducers."""
    validity, _ = picture.shown_validity(now)
    valid = validity != INVALID
    fields = []
    for value, name in ((picture.roll, 'ROLL'), (picture.pitch, 'PITCH')):
        fields += ['A', number(value, 2) if valid else '', 'D', name]
    return sentence(talker, 'XDR', *fields)


def heading(talker: str, picture: Picture, now: int) -> list[str]:
    """Return THS always and HDT only while the heading is valid (it has no status field)."""
    validity, _ = picture.shown_validity(now)
    if validity == INVALID or not picture.heading_valid or not math.isfinite(picture.heading):
        return [sentence(talker, 'THS', '', 'V')]
    # 359.96 would print as 360.0, which is no heading.
    value = number(round(picture.heading, 1) % 360.0)
    return [sentence(talker, 'THS', value, 'A'), sentence(talker, 'HDT', value, 'T')]


def rot(talker: str, picture: Picture, now: int) -> str:
    """Return the rate of turn in degrees per minute, negative to port."""
    validity, _ = picture.shown_validity(now)
    if validity == INVALID or not math.isfinite(picture.turn_rate):
        return sentence(talker, 'ROT', '', 'V')
    return sentence(talker, 'ROT', number(picture.turn_rate), 'A')


def all_sentences(talker: str, picture: Picture, now: int, true_heading: bool) -> list[str]:
    """Return one round of sentences."""
    out = [hrm(talker, picture, now), xdr(talker, picture, now), rot(talker, picture, now)]
    return out + (heading(talker, picture, now) if true_heading else [])
