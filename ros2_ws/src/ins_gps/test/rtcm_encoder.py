# SPDX-License-Identifier: Apache-2.0
"""RTCM 3 messages bit by bit from the field tables of RTCM 10403.3, for the tests of the decoder."""

import math

from pyrtcm.rtcmhelpers import calc_crc24q

SPEED_OF_LIGHT = 299_792_458.0
MS = SPEED_OF_LIGHT * 1e-3  # m
NUMBERS = {'G': 1070, 'E': 1090}
# Table 3.5-91 and 3.5-99: position in the signal mask.
SIGNALS = {
    'G': {'1C': 2, '1P': 3, '1W': 4, '2W': 10, '2L': 16, '2X': 17, '5Q': 23, '5X': 24, 'reserved': 5},
    'E': {
        '1C': 2,
        '1B': 4,
        '1X': 5,
        '1Z': 6,
        '8Q': 19,
        '7I': 14,
        '7Q': 15,
        '7X': 16,
        '5I': 22,
        '5Q': 23,
        '5X': 24,
    },
}


class Bits:
    def __init__(self):
        self.value, self.size = 0, 0

    def add(self, value, width):
        value = round(value)
        assert -(1 << (width - 1)) <= value < (1 << width), (value, width)
        self.value = self.value << width | value & ((1 << width) - 1)
        self.size += width
        return self

    def frame(self):
        padding = -self.size % 8
        payload = (self.value << padding).to_bytes((self.size + padding) // 8, 'big')
        head = b'\xd3' + len(payload).to_bytes(2, 'big') + payload
        return head + calc_crc24q(head).to_bytes(3, 'big')


def msm(system, kind, tow, cells, more=False, station=7):
    """Return an MSM. `cells`: dicts of satellite, code ('1C'), range, phase (m), rate (m/s, of the range),
    cn0, lock (indicator), half; a missing value is sent as not available.
    """
    satellites = sorted({c['satellite'] for c in cells})
    signals = sorted({SIGNALS[system][c['code']] for c in cells})
    by_place = {(c['satellite'], SIGNALS[system][c['code']]): c for c in cells}
    places = [(s, g) for s in satellites for g in signals]
    bits = Bits().add(NUMBERS[system] + kind, 12).add(station, 12).add(tow, 30).add(more, 1)
    bits.add(0, 3 + 7 + 2 + 2 + 1 + 3)
    bits.add(sum(1 << (64 - s) for s in satellites), 64).add(sum(1 << (32 - g) for g in signals), 32)
    for place in places:
        bits.add(place in by_place, 1)
    order = [place for place in places if place in by_place]
    rough, rates = {}, {}
    for satellite in satellites:
        mine = [c for c in cells if c['satellite'] == satellite]
        value = next((c[n] for n in ('range', 'phase') for c in mine if c.get(n) is not None), None)
        rough[satellite] = None if value is None else round(value / MS * 1024)
        rate = next((c['rate'] for c in mine if c.get('rate') is not None), None)
        rates[satellite] = None if rate is None else round(rate)
    for satellite in satellites:
        bits.add(255 if rough[satellite] is None else rough[satellite] // 1024, 8)
    if kind in (5, 7):
        for _ in satellites:
            bits.add(0, 4)
    for satellite in satellites:
        bits.add(0 if rough[satellite] is None else rough[satellite] % 1024, 10)
    if kind in (5, 7):
        for satellite in satellites:
            bits.add(-8192 if rates[satellite] is None else rates[satellite], 14)
    fine = kind in (6, 7)
    widths = (20, 29, 24, 31) if fine else (15, 24, 22, 29)
    for name, width, power in (('range', *widths[:2]), ('phase', *widths[2:])):
        for satellite, signal in order:
            value = by_place[satellite, signal].get(name)
            if value is None:
                bits.add(-(1 << (width - 1)), width)
            else:
                bits.add((value / MS - rough[satellite] / 1024) * 2.0**power, width)
    for place in order:
        bits.add(by_place[place].get('lock', 10), 10 if fine else 4)
    for place in order:
        bits.add(by_place[place].get('half', False), 1)
    for place in order:
        bits.add((by_place[place].get('cn0') or 0.0) * (16 if fine else 1), 10 if fine else 6)
    if kind in (5, 7):
        for satellite, signal in order:
            rate = by_place[satellite, signal].get('rate')
            # A signal whose Doppler is far from that of the satellite's others cannot be sent.
            fits = rate is not None and abs(rate - rates[satellite]) < 1.638
            bits.add((rate - rates[satellite]) / 1e-4 if fits else -16384, 15)
    return bits.frame()


def wrapped_phase(cycles, wavelength, range_):
    """Return a phase (m) moved by whole cycles to within the reach of the fine field, and the cycles."""
    shift = round((cycles * wavelength - range_) / wavelength)
    return (cycles - shift) * wavelength, shift


def _scaled(row, names):
    return [(row[name] / scale, width) for name, width, scale in names]


PI = 3.1415926535898
_ANGLE = 2.0**-31 * PI


def ephemeris_1019(row, week):
    """`row`: dict of the fields of `ins_gps.orbit`, accuracy as index."""
    bits = (
        Bits().add(1019, 12).add(row['satellite'], 6).add(week % 1024, 10).add(row['accuracy'], 4).add(1, 2)
    )
    fields = (
        ('inclination_rate', 14, 2.0**-43 * PI), ('issue', 8, 1), ('toc', 16, 16), ('af2', 8, 2.0**-55),
        ('af1', 16, 2.0**-43), ('af0', 22, 2.0**-31), ('issue', 10, 1), ('crs', 16, 2.0**-5),
        ('delta_n', 16, 2.0**-43 * PI), ('mean_anomaly', 32, _ANGLE), ('cuc', 16, 2.0**-29),
        ('eccentricity', 32, 2.0**-33), ('cus', 16, 2.0**-29), ('sqrt_a', 32, 2.0**-19),
        ('week_second', 16, 16), ('cic', 16, 2.0**-29), ('ascending_node', 32, _ANGLE), ('cis', 16, 2.0**-29),
        ('inclination', 32, _ANGLE), ('crc', 16, 2.0**-5), ('perigee', 32, _ANGLE),
        ('node_rate', 24, 2.0**-43 * PI), ('group_delay', 8, 2.0**-31), ('health', 6, 1),
    )  # fmt: skip
    for value, width in _scaled(row, fields):
        bits.add(value, width)
    return bits.add(0, 1).add(0, 1).frame()


def ephemeris_galileo(row, week, number):
    """1045 (F/NAV) or 1046 (I/NAV); health: bits of RINEX."""
    bits = Bits().add(number, 12).add(row['satellite'], 6).add(week - 1024, 12).add(row['issue'], 10)
    bits.add(row['accuracy'], 8)
    fields = (
        ('inclination_rate', 14, 2.0**-43 * PI), ('toc', 14, 60), ('af2', 6, 2.0**-59), ('af1', 21, 2.0**-46),
        ('af0', 31, 2.0**-34), ('crs', 16, 2.0**-5), ('delta_n', 16, 2.0**-43 * PI),
        ('mean_anomaly', 32, _ANGLE), ('cuc', 16, 2.0**-29), ('eccentricity', 32, 2.0**-33),
        ('cus', 16, 2.0**-29), ('sqrt_a', 32, 2.0**-19), ('week_second', 14, 60), ('cic', 16, 2.0**-29),
        ('ascending_node', 32, _ANGLE), ('cis', 16, 2.0**-29), ('inclination', 32, _ANGLE),
        ('crc', 16, 2.0**-5), ('perigee', 32, _ANGLE), ('node_rate', 24, 2.0**-43 * PI),
    )  # fmt: skip
    for value, width in _scaled(row, fields):
        bits.add(value, width)
    delay, health = row['group_delay'] * 2.0**32, int(row['health'])
    if number == 1045:
        return bits.add(delay, 10).add(health >> 4 & 3, 2).add(health >> 3 & 1, 1).add(0, 7).frame()
    bits.add(row.get('delay_5', 0.0) * 2.0**32, 10).add(delay, 10).add(health >> 7 & 3, 2).add(
        health >> 6 & 1, 1
    )
    return bits.add(health >> 1 & 3, 2).add(health & 1, 1).add(0, 2).frame()


def station(position, height=None, identity=7):
    """1005, or 1006 with the height of the antenna above its mark."""
    bits = Bits().add(1005 if height is None else 1006, 12).add(identity, 12).add(0, 6 + 4)
    x, y, z = (math.floor(v * 1e4 + 0.5) for v in position)
    bits.add(x, 38).add(0, 2).add(y, 38).add(0, 2).add(z, 38)
    return (bits if height is None else bits.add(height * 1e4, 16)).frame()
