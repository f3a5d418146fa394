# SPDX-License-Identifier: Apache-2.0
"""Observation files: the examples that the RINEX documents print, and what receivers write."""

import datetime

import numpy as np
import pytest

from ins_gps.orbit import COLUMN
from ins_gps.rinex import RinexError, gps_nanoseconds, read_navigation, read_observations

# RINEX 2.11, table A7, abridged: the file that its document prints, events and cycle slips included.
RINEX_2 = """\
     2.11           OBSERVATION DATA    M (MIXED)           RINEX VERSION / TYPE
BLANK OR G = GPS,  R = GLONASS,  E = GALILEO,  M = MIXED    COMMENT
  4375274.       587466.      4589095.                      APPROX POSITION XYZ
     1     2     6   G14   G15   G16   G17   G18   G19      WAVELENGTH FACT L1/2
     5    P1    L1    L2    P2    L5                        # / TYPES OF OBSERV
  2005     3    24    13    10   36.0000000                 TIME OF FIRST OBS
                                                            END OF HEADER
 05  3 24 13 10 36.0000000  0  4G12G09G06E11                         -.123456789
  23629347.915            .300 8         -.353    23629364.158
  20891534.648           -.120 9         -.358    20891541.292
  20607600.189           -.430 9          .394    20607605.848
                          .324 8                                          .178 7
 05  3 24 13 10 50.0000000  4  4
     1     2     2   G 9   G12                              WAVELENGTH FACT L1/2
  *** WAVELENGTH FACTOR CHANGED FOR 2 SATELLITES ***        COMMENT
      NOW 8 SATELLITES HAVE WL FACT 1 AND 2!                COMMENT
                                                            COMMENT
 05  3 24 13 10 54.0000000  0  6G12G09G06R21R22E11                   -.123456789
  23619095.450      -53875.632 8    -41981.375    23619112.008
  20886075.667      -28688.027 9    -22354.535    20886082.101
  20611072.689       18247.789 9     14219.770    20611078.410
  21345678.576       12345.567 5
  22123456.789       23456.789 5
                     65432.123 5                                     48861.586 7
                            3  1
          --> THIS IS THE START OF A NEW SITE <--           COMMENT
 05  3 24 13 13  1.2345678  5  0
 05  3 24 13 14 12.0000000  0  4G16G12G09G06                         -.123456012
  21124965.133       89551.30216     69779.62654  21124972.2754
  23507272.372     -212616.150 7   -165674.789 5  23507288.421
  20828010.354     -333820.093 6   -260119.395 5  20828017.129
  20650944.902      227775.130 7    177487.651 4  20650950.363
 05  3 24 13 14 12.0000000  6  2G16G09
                 123456789.0      -9876543.5
                         0.0            -0.5
                            4  2
           ---> CYCLE SLIPS THAT HAVE BEEN APPLIED TO       COMMENT
                THE OBSERVATIONS                            COMMENT
 05  3 24 13 14 48.0000000  0  4G16G12G09G06                         -.123456234
  21128884.159      110143.144 7     85825.18545  21128890.7764
  23487131.045     -318463.297 7   -248152.72824  23487146.149
  20817844.743     -387242.571 6   -301747.22925  20817851.322
  20658519.895      267583.67817    208507.26234  20658525.869
"""

# RINEX 3.04, table A3, abridged.
RINEX_3 = """\
     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE
  4375274.       587466.      4589095.                      APPROX POSITION XYZ
G    5 C1C L1W L2W C1W S2W                                  SYS / # / OBS TYPES
R    2 C1C L1C                                              SYS / # / OBS TYPES
E    2 L1B L5I                                              SYS / # / OBS TYPES
S    2 C1C L1C                                              SYS / # / OBS TYPES
 18 R01  1 R02  2 R03  3 R04  4 R05  5 R06 -6 R07 -5 R08 -4 GLONASS SLOT / FRQ #
                                                            END OF HEADER
> 2006 03 24 13 10 36.0000000  0  5      -0.123456789012
G06  23629347.915            .300 8         -.353 4  23629347.158          24.158
G09  20891534.648           -.120 9         -.358 6  20891545.292          38.123
G12  20607600.189           -.430 9          .394 5  20607600.848          35.234
E11          .324 8          .178 7
S20  38137559.506      335849.135 9
> 2006 03 24 13 10 54.0000000  0  7      -0.123456789210
G06  23619095.450      -53875.632 8    -41981.375 4  23619095.008          25.234
G09  20886075.667      -28688.027 9    -22354.535 7  20886076.101          42.231
G12  20611072.689       18247.789 9     14219.770 6  20611072.410          36.765
R21  21345678.576       12345.567 5
R22  22123456.789       23456.789 5
E11     65432.123 5     48861.586 7
S20  38137559.506      335849.135 9
> 2006 03 24 13 11 12.0000000  2  2
      *** FROM NOW ON KINEMATIC DATA! ***                   COMMENT
      TWO COMMENT LINES FOLLOW DIRECTLY THE EVENT RECORD    COMMENT
"""


def observed(tmp_path, text, bands=(1, 2, 5, 7)):
    path = tmp_path / 'x.obs'
    path.write_text(text)
    return read_observations(path, bands)


def seconds(epochs):
    """Return the times of epochs in seconds after the first."""
    return [(epoch.time - epochs[0].time) / 1e9 for epoch in epochs]


def test_the_example_of_rinex_2_is_read_as_it_is_explained(tmp_path):
    file = observed(tmp_path, RINEX_2)
    assert file.position.tolist() == [4375274.0, 587466.0, 4589095.0]
    assert seconds(file.epochs) == [0.0, 18.0, 216.0, 252.0]
    assert file.epochs[0].time == gps_nanoseconds(datetime.datetime(2005, 3, 24, 13, 10), 36.0)
    first, second, lost, last = ({tuple(r[:3].astype(int)): r for r in e.rows} for e in file.epochs)
    assert first[0, 12, 1][3:5].tolist() == [23629347.915, 0.300]
    assert first[0, 6, 2][3:5].tolist() == [20607605.848, 0.394]
    assert np.isnan(first[1, 11, 1][3])
    assert first[1, 11, 1][4] == 0.324
    # GLONASS is left out, and its lines with it.
    assert {key[:2] for key in second} == {(0, 12), (0, 9), (0, 6), (1, 11)}
    assert second[1, 11, 1][4] == 65432.123
    # "89551.30216": loss of lock 1, strength 6; "69779.62654": bit 2 says antispoofing, not a slip.
    assert lost[0, 16, 1][7] == 1.0
    assert lost[0, 16, 2][7] == 5.0
    assert last[0, 6, 1][4:8:3].tolist() == [267583.678, 1.0]
    assert last[0, 9, 2][3] == 20817851.322


def test_the_example_of_rinex_3_is_read_as_it_is_explained(tmp_path):
    file = observed(tmp_path, RINEX_3)
    assert seconds(file.epochs) == [0.0, 18.0]
    # Codes without the phase of the same signal, as the header has them; Galileo has phases alone.
    assert [row[:4].tolist() for row in file.epochs[1].rows] == [
        [0.0, 6.0, 1.0, 23619095.450],
        [0.0, 9.0, 1.0, 20886075.667],
        [0.0, 12.0, 1.0, 20611072.689],
    ]


def test_slips_of_satellites_with_two_lines_each_do_not_end_the_reading(tmp_path):
    head = RINEX_2.splitlines()[0] + '\n'
    head += f'{"     6    C1    L1    L2    P2    D1    S1":<60}# / TYPES OF OBSERV\n{"":60}END OF HEADER\n'
    names = ''.join(f'G{k:02d}' for k in range(1, 14))
    satellites = f'{names[:36]}\n{"":32}{names[36:]}\n'

    def records(flag, second):
        lines = f'{2.2e7:14.3f}  {1.1e8:14.3f}  {0.0:14.3f}  {2.2e7:14.3f}  {-1234.5:14.3f}\n{45.0:14.3f}\n'
        return f' 05  3 24 13 10 {second:2d}.0000000  {flag} 13{satellites}' + 13 * lines

    file = observed(tmp_path, head + records(0, 36) + records(6, 36) + records(0, 37), (1,))
    assert seconds(file.epochs) == [0.0, 1.0]
    assert [epoch.rows[12, 1] for epoch in file.epochs] == [13.0, 13.0]
    assert file.epochs[1].rows[0, 5:7].tolist() == [-1234.5, 45.0]


@pytest.mark.parametrize('text', [RINEX_2, RINEX_3])
def test_the_way_lines_end_makes_no_difference(tmp_path, text):
    plain = observed(tmp_path, text)
    for variant in (
        text.replace('\n', '\r\n'),
        text + '\n   \n\x1a',
        '\n'.join(line.ljust(80) for line in text.splitlines()),
        '\n'.join(line.rstrip() for line in text.splitlines()),
    ):
        other = observed(tmp_path, variant)
        assert seconds(other.epochs) == seconds(plain.epochs)
        for ours, theirs in zip(other.epochs, plain.epochs, strict=True):
            np.testing.assert_array_equal(ours.rows, theirs.rows)


def test_only_the_bands_asked_for_are_given(tmp_path):
    assert {row[2] for e in observed(tmp_path, RINEX_2, (2,)).epochs for row in e.rows} == {2.0}
    assert {row[2] for e in observed(tmp_path, RINEX_2, (1,)).epochs for row in e.rows} == {1.0}


def test_a_file_of_rinex_2_cut_off_within_an_epoch_keeps_those_before(tmp_path):
    lines = RINEX_2.splitlines()
    assert seconds(observed(tmp_path, '\n'.join(lines[:-1])).epochs) == [0.0, 18.0, 216.0]


def test_years_of_two_digits_are_of_the_time_of_gps(tmp_path):
    old = RINEX_2.replace(' 05  3 24', ' 99  3 24')
    first = observed(tmp_path, old).epochs[0].time
    assert first == gps_nanoseconds(datetime.datetime(1999, 3, 24, 13, 10), 36.0)


def test_a_folder_is_no_observation_file(tmp_path):
    with pytest.raises(RinexError, match='cannot be read'):
        read_observations(tmp_path)


def test_an_observation_file_in_place_of_a_navigation_file_is_named(tmp_path):
    path = tmp_path / 'x.obs'
    path.write_text(RINEX_3)
    with pytest.raises(RinexError, match='navigation file'):
        read_navigation(path)


# RINEX 3.04, table A8: an ephemeris of GPS and one of Galileo; the header has ionospheric terms of GPS.
NAVIGATION = """\
     3.04           N: GNSS NAV DATA    M: MIXED            RINEX VERSION / TYPE
GPSA   1.0245E-08  2.2352E-08 -5.9605E-08 -1.1921E-07       IONOSPHERIC CORR
GPSB   9.6256E+04  1.3107E+05 -6.5536E+04 -5.8982E+05       IONOSPHERIC CORR
                                                            END OF HEADER
G06 1999 09 02 17 51 44 -.839701388031D-03 -.165982783074D-10  .000000000000D+00
      .910000000000D+02  .934062500000D+02  .116040547840D-08  .162092304801D+00
      .484101474285D-05  .626740418375D-02  .652112066746D-05  .515365489006D+04
      .409904000000D+06 -.242143869400D-07  .329237003460D+00 -.596046447754D-07
      .111541663136D+01  .326593750000D+03  .206958726335D+01 -.638312302555D-08
      .307155651409D-09  .000000000000D+00  .100000000000D+01  .000000000000D+00
      .000000000000D+00  .000000000000D+00  .000000000000D+00  .910000000000D+02
      .406800000000D+06  .000000000000D+00
E12 2010 03 17 01 40 00 -.160416600000D-03 -.139266369515D-11  .000000000000D+00
      .110000000000D+02 -.165625000000D+02  .269368367330D-08  .298738110535D+00
     -.884756445885D-06  .217000000000D-03  .118000000000D-04  .544060000000D+04
      .265200000000D+06  .000000000000D+00  .234000000000D+01  .000000000000D+00
      .960000000000D+00  .140000000000D+03  .500000000000D+00 -.550000000000D-08
      .100000000000D-09  .258000000000D+03  .157600000000D+04
      .312000000000D+01  .000000000000D+00 -.558793544769D-08 -.651925802231D-08
      .406800000000D+06
R01 2010 03 17 01 45 00 -.160416600000D-03  .000000000000D+00  .264600000000D+06
      .110000000000D+05 -.165625000000D+01  .000000000000D+00  .000000000000D+00
      .110000000000D+05 -.165625000000D+01  .000000000000D+00  .100000000000D+01
      .110000000000D+05 -.165625000000D+01  .000000000000D+00  .000000000000D+00
"""


def test_navigation_data_of_several_systems_are_read_with_their_delays(tmp_path):
    path = tmp_path / 'x.rnx'
    path.write_text(NAVIGATION)
    file = read_navigation(path)
    gps, galileo = file.ephemerides[np.argsort(file.ephemerides[:, 0])]
    assert gps[:2].tolist() == [0.0, 6.0]
    assert gps[COLUMN['week_second']] == 409_904.0
    # Both times are that of the day, although the file counts its week from 1999 on.
    assert gps[COLUMN['toe']] == gps[COLUMN['toc']]
    assert gps[COLUMN['toe']] * 1e9 == gps_nanoseconds(datetime.datetime(1999, 9, 2, 17, 51), 44.0)
    assert galileo[:2].tolist() == [1.0, 12.0]
    # Data source 258: the clock is that of E5a, so the delay is BGD E5a/E1, the first of the two.
    assert galileo[COLUMN['group_delay']] == -5.58793544769e-9
    assert galileo[COLUMN['accuracy']] == 3.12
    np.testing.assert_allclose(file.klobuchar[[0, 4]], [1.0245e-8, 9.6256e4])


def test_navigation_data_without_ionosphere_or_of_another_system_give_what_they_have(tmp_path):
    lines = NAVIGATION.splitlines(keepends=True)
    path = tmp_path / 'x.rnx'
    path.write_text(''.join([lines[0], *lines[3:12]]))
    assert np.isnan(read_navigation(path).klobuchar).all()
    path.write_text(''.join([lines[0], lines[3], *lines[-4:]]))
    assert read_navigation(path).ephemerides.shape[0] == 0


# RINEX 2.11, table A11.
GLONASS = """\
     2.01           GLONASS NAV DATA                        RINEX VERSION / TYPE
                                                            END OF HEADER
 3 98  2 15  0 15  0.0 0.163525342941D-03 0.363797880709D-11 0.108000000000D+05
    0.106275903320D+05-0.348924636841D+00 0.931322574615D-09 0.000000000000D+00
   -0.944422070313D+04 0.288163375854D+01 0.931322574615D-09 0.210000000000D+02
    0.212257280273D+05 0.144599342346D+01-0.186264514923D-08 0.300000000000D+01
"""


def test_a_file_of_glonass_alone_has_no_ephemerides(tmp_path):
    path = tmp_path / 'x.98g'
    path.write_text(GLONASS)
    assert read_navigation(path).ephemerides.shape[0] == 0
