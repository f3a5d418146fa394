# SPDX-License-Identifier: Apache-2.0
"""Satellite clocks of other bands, by hand from the interface documents and against an exact simulator.

With the broadcast clock Δt of a pair, OS SIS ICD 5.1.5: Δt(E1) = Δt − BGD, Δt(E5) = Δt − (f1/f5)² BGD, each
with the BGD of that pair; IS-GPS-200 20.3.3.3.3.2: L1 Δt − TGD, L2 Δt − (f1/f2)² TGD; IS-GPS-705
20.3.3.3.1.2.1: L5 Δt − TGD + ISC.
"""

import math

import numpy as np
import pytest

from ins_gps.broadcast import BroadcastStore
from ins_gps.constants import GALILEO, GPS, SPEED_OF_LIGHT
from ins_gps.observations import EpochBuilder
from ins_gps.orbit import COLUMN, ephemeris_row, range_and_rate
from ins_gps.recordings import gnss_epochs
from ins_gps.rinex import RawEpoch, read_navigation

TOE, CLOCK = 1_400_000_400.0, 1e-4
BGD_5A, BGD_5B, TGD = -5e-9, -7e-9, 6e-9  # s
# Squared ratios of 1575.42 MHz to 1227.60, 1176.45 and 1207.14 MHz, from 154 to 120, 115 and 118.
GAMMA_2, GAMMA_5, GAMMA_7 = (154 / 120) ** 2, (154 / 115) ** 2, (154 / 118) ** 2


def clock_of(band, **fields):
    """Return the clock (s) that an epoch gets at a time at which there is nothing of drift or relativity."""
    row = ephemeris_row(satellite=11, toe=TOE, toc=TOE, af0=CLOCK, sqrt_a=5440.6, inclination=0.96, **fields)
    raw = np.array([[fields['system'], 11.0, band, 2.4e7, math.nan, math.nan, 45.0, 0.0]])
    epoch = EpochBuilder(row[None]).build(RawEpoch(round(TOE * 1e9), raw))
    return epoch.rows[0, 15]


@pytest.mark.parametrize(
    ('band', 'expected'),
    [(1, CLOCK - BGD_5A), (5, CLOCK - GAMMA_5 * BGD_5A)],
)
def test_the_clock_of_fnav_goes_with_the_delay_of_e5a(band, expected):
    fields = {'group_delay': BGD_5A, 'delay_5': BGD_5A, 'delay_7': BGD_5B}
    assert clock_of(band, system=GALILEO, **fields) == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize(
    ('band', 'expected'),
    [(1, CLOCK - BGD_5B), (7, CLOCK - GAMMA_7 * BGD_5B)],
)
def test_the_clock_of_inav_goes_with_the_delay_of_e5b(band, expected):
    fields = {'group_delay': BGD_5B, 'delay_5': BGD_5A, 'delay_7': BGD_5B}
    assert clock_of(band, system=GALILEO, **fields) == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize(('band', 'gamma', 'delay'), [(5, GAMMA_5, BGD_5A), (7, GAMMA_7, BGD_5B)])
def test_the_other_band_lags_e1_alike_whichever_clock_was_broadcast(band, gamma, delay):
    both = {'delay_5': BGD_5A, 'delay_7': BGD_5B}
    for own in (BGD_5A, BGD_5B):
        lag = clock_of(1, system=GALILEO, group_delay=own, **both)
        lag -= clock_of(band, system=GALILEO, group_delay=own, **both)
        assert lag == pytest.approx((gamma - 1.0) * delay, abs=1e-14)


def test_a_delay_that_was_not_broadcast_is_that_of_the_pair():
    lag = clock_of(1, system=GALILEO, group_delay=BGD_5A) - clock_of(7, system=GALILEO, group_delay=BGD_5A)
    assert lag == pytest.approx((GAMMA_7 - 1.0) * BGD_5A, abs=1e-14)


@pytest.mark.parametrize(('band', 'factor'), [(1, 1.0), (2, GAMMA_2), (5, 1.0)])
def test_the_delay_of_gps_is_of_l1_and_l2_and_says_nothing_of_l5(band, factor):
    assert clock_of(band, system=GPS, group_delay=TGD) == pytest.approx(CLOCK - factor * TGD, abs=1e-14)


# RINEX 3.04, table A8; the last number but one of its sixth line is BGD(E1,E5a), the last BGD(E1,E5b).
NAVIGATION = """\
     3.04           N: GNSS NAV DATA    E: GALILEO          RINEX VERSION / TYPE
                                                            END OF HEADER
E12 2010 03 17 01 40 00 -.160416600000D-03 -.139266369515D-11  .000000000000D+00
      .110000000000D+02 -.165625000000D+02  .269368367330D-08  .298738110535D+00
     -.884756445885D-06  .217000000000D-03  .118000000000D-04  .544060000000D+04
      .265200000000D+06  .000000000000D+00  .234000000000D+01  .000000000000D+00
      .960000000000D+00  .140000000000D+03  .500000000000D+00 -.550000000000D-08
      .100000000000D-09  .{source}000000000D+03  .157600000000D+04
      .312000000000D+01  .000000000000D+00 -.558793544769D-08 {e5b}
      .406800000000D+06
"""


@pytest.mark.parametrize(
    ('source', 'e5b', 'own', 'delay_7'),
    [
        ('258', '-.651925802231D-08', -5.58793544769e-9, -6.51925802231e-9),
        ('517', '-.651925802231D-08', -6.51925802231e-9, -6.51925802231e-9),
        ('258', ' .000000000000D+00', -5.58793544769e-9, -5.58793544769e-9),
        ('517', ' .000000000000D+00', 0.0, 0.0),
    ],
)
def test_both_delays_of_a_navigation_file_are_read(tmp_path, source, e5b, own, delay_7):
    path = tmp_path / 'x.rnx'
    path.write_text(NAVIGATION.format(source=source, e5b=e5b))
    (row,) = read_navigation(path).ephemerides
    assert row[COLUMN['group_delay']] == own
    assert row[COLUMN['delay_5']] == -5.58793544769e-9
    assert row[COLUMN['delay_7']] == delay_7


def inav_pages(word):
    """Return the eight words of the page pair that carries the 128 bits of an I/NAV word."""
    even = word >> 16 << 14  # even, nominal, 112 bits of the word, tail
    odd = 0b10 << 30 | (word & 0xFFFF) << 14
    return [
        even >> 96 & 0xFFFFFFFF,
        even >> 64 & 0xFFFFFFFF,
        even >> 32 & 0xFFFFFFFF,
        even & 0xFFFFFFFF,
        odd,
    ] + [0] * 3


def inav_word(number, *cells):
    """Return 128 bits with (start, length, value) as in the tables of OS SIS ICD 4.3.5."""
    word = number << 122
    for start, length, value in cells:
        word |= (value & ((1 << length) - 1)) << (128 - start - length)
    return word


def test_both_delays_of_the_inav_message_are_read():
    store = BroadcastStore()
    words = [
        inav_word(1, (94, 32, round(5440.6 * 2**19))),
        inav_word(2),
        inav_word(3),
        inav_word(4),
        inav_word(5, (47, 10, -21), (57, 10, 30)),
    ]
    for word in words:
        assert store.add_inav(11, inav_pages(word))
    store.update(TOE)
    (row,) = store.ephemerides
    assert row[COLUMN['delay_5']] == -21 * 2.0**-32
    assert row[COLUMN['delay_7']] == row[COLUMN['group_delay']] == 30 * 2.0**-32


def test_all_bands_of_the_simulator_agree_to_millimetres(recordings):
    """Spirent: F/NAV clocks with both BGDs, no ISC, exact positions; E5b was 0.1 m and L5 2.7 m off."""
    folder = recordings / 'spirent_iono_none'
    navigation = (folder / 'RINEX_GN_Spirent.23N', folder / 'RINEX_EN_Spirent.23L')
    epochs = gnss_epochs(
        folder / 'Rover-dynamic_MO_Spirent.obs', navigation, bands=(1, 2, 5, 7), atmosphere=False
    )
    truth = np.loadtxt(folder / 'Rover-dynamic_PVA_Spirent.csv', delimiter=',', skiprows=1)[::10, 4:7]
    seen = set()
    for k in range(0, 600, 50):
        rows = epochs[k].rows[np.isfinite(epochs[k].rows[:, [3, 9]]).all(axis=1)]
        ranges = np.array([range_and_rate(row[9:15], truth[k], np.zeros(3), np.empty(3))[0] for row in rows])
        residuals = rows[:, 3] + SPEED_OF_LIGHT * rows[:, 15] - ranges
        assert np.abs(residuals - np.median(residuals)).max() < 0.003
        seen |= {(row[0], row[2]) for row in rows}
    assert seen == {(0.0, 1.0), (0.0, 2.0), (0.0, 5.0), (1.0, 1.0), (1.0, 5.0), (1.0, 7.0)}
