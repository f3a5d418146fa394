# SPDX-License-Identifier: Apache-2.0
import calendar
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ins_gps.nmea import KNOT, NmeaDecoder
from ins_gps.samples import ReceiverFix, VelocitySample

NANOSECONDS = 1_000_000_000
LAT, LON = 47.0 + 17.11399 / 60.0, -(8.0 + 33.91590 / 60.0)


def line(body):
    """Return a sentence with its checksum, made without the library that reads it."""
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f'${body}*{checksum:02X}\r\n'.encode()


def gga(time='092725.00', quality=1, hdop='1.01', height='499.6', separation='48.0', talker='GP'):
    place = '4717.11399,N,00833.91590,W' if quality else ',,,'
    return line(f'{talker}GGA,{time},{place},{quality},08,{hdop},{height},M,{separation},M,,')


def rmc(time='092725.00', date='290224', knots='10.0', course='60.0', status='A', talker='GP'):
    place = '4717.11399,N,00833.91590,W' if status == 'A' else ',,,'
    return line(f'{talker}RMC,{time},{status},{place},{knots},{course},{date},,,A')


def gst(time='092725.00', north='1.5', east='0.8', up='3.0', talker='GN'):
    return line(f'{talker}GST,{time},1.8,1.7,0.9,31.0,{north},{east},{up}')


GSA = line('GNGSA,A,3,01,02,03,04,,,,,,,,,2.0,1.2,1.6,1')
VTG = line('GPVTG,60.0,T,,M,10.0,N,18.52,K,A')


def decode(*sentences, **options):
    """Return decoder, fixes and velocities of a whole stream."""
    decoder = NmeaDecoder(4.0, 0.1, **options)
    out = [*decoder.feed(b''.join(sentences)), *decoder.rest()]
    fixes = [s for s in out if isinstance(s, ReceiverFix)]
    return decoder, fixes, [s for s in out if isinstance(s, VelocitySample)]


def utc(*when):
    return calendar.timegm(when) * NANOSECONDS


def test_position_height_and_time_of_an_epoch():
    _, (fix,), _ = decode(rmc(), gga())
    assert np.degrees(fix.geodetic[:2]) == pytest.approx((LAT, LON), abs=1e-9)
    assert fix.geodetic[2] == pytest.approx(547.6)  # above the ellipsoid
    assert fix.stamp == utc(2024, 2, 29, 9, 27, 25)
    assert fix.status == 0


def test_gps_time_on_request():
    _, (fix,), (velocity,) = decode(rmc(), gga(), utc=False, leap=18)
    assert fix.stamp == velocity.stamp == utc(2024, 2, 29, 9, 27, 43)


def test_the_covariance_is_that_of_gst():
    _, (fix,), _ = decode(rmc(), gga(), GSA, gst())
    assert fix.covariance.tolist() == pytest.approx(np.diag([0.64, 2.25, 9.0]))  # east, north, up
    assert fix.covariance_type == 2


@pytest.mark.parametrize(('quality', 'share'), [(1, 1.0), (2, 0.4), (4, 0.005), (5, 0.1)])
def test_without_gst_the_covariance_follows_from_dops_and_quality(quality, share):
    _, (fix,), _ = decode(rmc(), gga(quality=quality), GSA)
    east, north, up = np.sqrt(np.diag(fix.covariance))
    assert math.hypot(east, north) == pytest.approx(4.0 * share * 1.01)
    assert up == pytest.approx(4.0 * share * 1.6)
    assert fix.covariance_type == 1


def test_what_is_not_told_makes_the_covariance_larger_or_unknown():
    _, (plain,), _ = decode(rmc(), gga())
    assert plain.covariance[2, 2] == pytest.approx((4.0 * 2.0 * 1.01) ** 2)
    _, (mean_sea_level,), _ = decode(rmc(), gga(separation=''), gst())
    assert mean_sea_level.covariance[2, 2] == pytest.approx(9.0 + 31.0**2)
    for hdop in ('', '99.99', '0.0'):
        _, (unknown,), _ = decode(rmc(), gga(hdop=hdop))
        assert unknown.covariance_type == 0
    _, (zero,), _ = decode(rmc(), gga(), gst(north='0.0'))
    assert zero.covariance_type == 1


@pytest.mark.parametrize(
    ('quality', 'status'), [(0, -1), (1, 0), (2, 1), (3, 0), (4, 2), (5, 2), (6, -1), (8, -1)]
)
def test_fix_quality_becomes_status(quality, status):
    _, (fix,), _ = decode(rmc(), gga(quality=quality))
    assert fix.status == status
    assert (fix.covariance_type == 0) == (status < 0)


def test_rmc_alone_gives_a_position_without_height():
    _, (fix,), _ = decode(rmc())
    assert fix.status == 0
    assert np.isnan(fix.geodetic[2])
    assert fix.covariance_type == 0


def test_velocity_of_rmc_is_ned_and_its_vertical_part_not_known():
    _, _, (velocity,) = decode(gga(), rmc(knots='20.0', course='150.0'))
    expected = 20.0 * KNOT * np.array([math.cos(math.radians(150.0)), math.sin(math.radians(150.0)), 0.0])
    assert velocity.velocity == pytest.approx(expected)
    assert np.sqrt(np.diag(velocity.covariance)) == pytest.approx((0.1, 0.1, 100.0))


def test_vtg_serves_where_there_is_no_rmc():
    _, _, (velocity,) = decode(gga(), VTG, reference=lambda: utc(2024, 1, 1, 12, 0, 0))
    assert math.hypot(*velocity.velocity) == pytest.approx(10.0 * KNOT)


def test_standing_still_needs_no_course_driving_does():
    _, _, (velocity,) = decode(rmc(knots='0.4', course=''))
    assert velocity.velocity.tolist() == [0.0, 0.0, 0.0]
    assert velocity.covariance[0, 0] == pytest.approx(0.01 + (0.4 * KNOT) ** 2)
    decoder, _, velocities = decode(rmc(knots='10.0', course=''))
    assert not velocities
    assert decoder.rejected['no course'] == 1


def test_no_fix_is_said_and_gives_no_velocity():
    _, (fix,), velocities = decode(rmc(status='V'), gga(quality=0, height='', separation=''))
    assert fix.status == -1
    assert not velocities


def test_any_talker_counts():
    for talker in ('GP', 'GN', 'GA', 'GL', 'BD', 'II'):
        assert len(decode(rmc(talker=talker), gga(talker=talker))[1]) == 1


def test_the_date_goes_on_over_midnight():
    _, fixes, _ = decode(
        rmc('235958.00', '281224'), gga('235958.00'), gga('235959.50'), gga('000001.00'), gga('000002.00')
    )
    days = [utc(2024, 12, 28, 23, 59, 58), utc(2024, 12, 28, 23, 59, 59) + NANOSECONDS // 2]
    days += [utc(2024, 12, 29, 0, 0, 1), utc(2024, 12, 29, 0, 0, 2)]
    assert [fix.stamp for fix in fixes] == days


def test_the_date_comes_from_zda_too():
    _, fixes, _ = decode(line('GPZDA,092725.00,05,07,2031,00,00'), gga(), gga('092726.00'))
    assert [fix.stamp for fix in fixes] == [utc(2031, 7, 5, 9, 27, 25), utc(2031, 7, 5, 9, 27, 26)]


def test_without_a_date_a_reference_is_needed():
    decoder, fixes, _ = decode(gga(), gga('092726.00'))
    assert not fixes
    assert decoder.rejected == {'date unknown': 2}
    _, fixes, _ = decode(gga('235959.00'), reference=lambda: utc(2030, 1, 2, 0, 0, 3))
    assert [fix.stamp for fix in fixes] == [utc(2030, 1, 1, 23, 59, 59)]


def test_an_epoch_comes_with_its_last_sentence_and_not_with_the_next_epoch():
    decoder = NmeaDecoder(4.0, 0.1)

    def epoch(second):
        time = f'0927{second:02d}.00'
        return rmc(time) + gga(time) + GSA + gst(time)

    early = [len(list(decoder.feed(epoch(second)))) for second in range(5)]
    # The first is complete only when the second begins.
    assert early == [0, 4, 2, 2, 2]
    # A receiver that is told to leave out GST is a second late, then on time again.
    time = '092706.00'
    late = [
        len(list(decoder.feed(rmc(f'0927{s:02d}.00') + gga(f'0927{s:02d}.00') + GSA))) for s in range(6, 11)
    ]
    assert sum(late) == 10
    assert late[-2:] == [2, 2]
    assert not list(decoder.rest()), time


def test_damage_is_counted_and_the_next_epoch_read():
    broken = bytearray(gga('092726.00'))
    broken[20] ^= 1
    unreadable = line('GPGGA,092726.00,what,N,ever,W,1,08,1.0,1,M,1,M,,')
    stream = [
        rmc(),
        gga(),
        b'\xb5\x62noise$GPGGA,0927',
        bytes(broken),
        unreadable,
        rmc('092727.00'),
        gga('092727.00'),
    ]
    decoder, fixes, _ = decode(*stream)
    assert [fix.stamp for fix in fixes if np.isfinite(fix.geodetic[2])][-1] == utc(2024, 2, 29, 9, 27, 27)
    assert decoder.rejected['checksum'] == 1
    assert decoder.rejected['no message'] == 1


@pytest.mark.parametrize(
    'sentence',
    [
        'GPGGA,092725.00,9917.1,N,00833.9,W,1,08,1.0,10,M,1,M,,',
        'GPGGA,092725.00,,N,,W,1,08,1.0,10,M,1,M,,',
        'GPGGA,092725.00',
        'GPGGA,,4717.1,N,00833.9,W,1,08,1.0,10,M,1,M,,',
        'GPGGA,256199.00,4717.1,N,00833.9,W,1,08,1.0,10,M,1,M,,',
        'GPRMC,092725.00,A,4717.1,N,00833.9,W,1e9,0.0,290224,,,A',
        'GPRMC,092725.00,A,4717.1,N,00833.9,W,-3.0,0.0,290224,,,A',
    ],
)
def test_what_cannot_be_is_refused_with_a_reason(sentence):
    decoder, fixes, velocities = decode(line(sentence), reference=lambda: utc(2024, 2, 29, 9, 0, 0))
    assert not velocities
    assert sum(decoder.rejected.values()) >= 1
    assert all(np.isfinite(fix.geodetic[:2]).all() for fix in fixes if fix.status >= 0)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(['GGA', 'RMC', 'GST', 'VTG', 'GSA', 'ZDA']),
    st.lists(
        st.sampled_from(['', '092725.00', '4717.1', 'N', 'E', 'W', 'nan', '-1', '1', 'A', '999999999', '*']),
        max_size=18,
    ),
)
def test_no_sentence_raises_or_gives_a_number_that_is_none(kind, fields):
    _, fixes, velocities = decode(
        rmc(), line(f'GP{kind},' + ','.join(fields)), rmc('092726.00'), gga('092726.00')
    )
    assert len(fixes) >= 2
    assert all(np.isfinite(v.velocity).all() and np.isfinite(v.covariance).all() for v in velocities)
    assert all(np.isfinite(f.covariance).all() for f in fixes)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 50), min_size=1, max_size=30))
def test_pieces_of_any_size_give_the_same(sizes):
    data = b''.join(rmc(f'0927{s:02d}.00') + gga(f'0927{s:02d}.00') + GSA for s in range(5))
    decoder, out, at = NmeaDecoder(4.0, 0.1), [], 0
    for size in [*sizes, len(data)]:
        out += decoder.feed(data[at : at + size])
        at += size
    out += decoder.rest()
    whole = decode(data)
    assert [s.stamp for s in out if isinstance(s, ReceiverFix)] == [s.stamp for s in whole[1]]


# Sentences that manuals and the standard print, with the checksums printed there.
PRINTED = (
    b'$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n'
    b'$GPGSA,A,3,04,05,,09,12,,,24,,,,,2.5,1.3,2.1*39\r\n'
    b'$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n'
    b'$GPVTG,054.7,T,034.4,M,005.5,N,010.2,K*48\r\n'
)


def test_the_sentences_that_manuals_print_are_read_as_they_are_explained():
    decoder, (fix,), (velocity,) = decode(PRINTED)
    assert not decoder.rejected
    assert np.degrees(fix.geodetic[:2]) == pytest.approx((48.0 + 7.038 / 60.0, 11.0 + 31.0 / 60.0), abs=1e-9)
    assert fix.geodetic[2] == pytest.approx(545.4 + 46.9)
    assert fix.stamp == utc(1994, 3, 23, 12, 35, 19)
    assert math.sqrt(fix.covariance[2, 2]) == pytest.approx(4.0 * 2.1)
    assert math.hypot(*velocity.velocity) == pytest.approx(22.4 * KNOT)
    assert math.degrees(math.atan2(velocity.velocity[1], velocity.velocity[0])) == pytest.approx(84.4)


def test_the_time_that_a_manual_prints_dates_an_epoch():
    zda = b'$GPZDA,201530.00,04,07,2002,00,00*60\r\n'
    _, (fix,), _ = decode(zda, gga('201530.00'))
    assert fix.stamp == utc(2002, 7, 4, 20, 15, 30)


def test_sentences_of_the_maker_and_without_a_time_before_them_are_passed_over():
    decoder, fixes, velocities = decode(
        line('PUBX,00,081350.00,4717.113210,N,00833.915187,E'), line('PSRFRMC,1,2,3'), VTG, GSA
    )
    assert not fixes
    assert not velocities
    assert not decoder.rejected


def test_a_date_that_no_calendar_has_leaves_the_one_before():
    zda = line('GPZDA,092726.00,31,02,2031,00,00')
    decoder, fixes, _ = decode(rmc(), gga(), zda, gga('092726.00'))
    assert [fix.stamp for fix in fixes] == [utc(2024, 2, 29, 9, 27, 25), utc(2024, 2, 29, 9, 27, 26)]
    assert not decoder.rejected['date unknown']


def test_a_time_without_a_fix_gives_nothing_but_the_date():
    _, fixes, velocities = decode(line('GPZDA,092725.00,05,07,2031,00,00'), gst())
    assert not fixes
    assert not velocities


def test_time_that_goes_back_is_said():
    decoder, fixes, _ = decode(rmc(), gga(), rmc('092700.00'), gga('092700.00'))
    assert len(fixes) == 2
    assert decoder.rejected == {'time went back': 1}


def test_a_position_off_the_globe_is_refused_where_the_sentence_is_whole():
    for place in ('9100.0,N,00833.9,W', '4717.1,N,18100.0,E', ',N,00833.9,W'):
        decoder, fixes, _ = decode(rmc(), line(f'GPGGA,092725.00,{place},1,08,1.0,10,M,1,M,,'))
        assert not fixes
        assert decoder.rejected['position that cannot be'] == 1


@pytest.mark.parametrize(('mode', 'moves'), [('A', True), ('D', True), ('E', False), ('N', False)])
def test_vtg_counts_only_where_it_is_measured(mode, moves):
    _, _, velocities = decode(rmc()[:0], gga(), line(f'GPVTG,60.0,T,,M,10.0,N,18.52,K,{mode}'),
                              reference=lambda: utc(2024, 1, 1, 12, 0, 0))  # fmt: skip
    assert bool(velocities) == moves


def test_a_velocity_is_in_a_frame_that_is_east_north_up():
    from bag_tools.bag import zeroed
    from ins_gps.codec import TWIST, decode_velocity, encode_velocity

    _, _, (velocity,) = decode(gga(), rmc(knots='20.0', course='90.0'))
    message = zeroed(TWIST)
    encode_velocity(velocity, message)
    assert message.header.frame_id == 'map'
    assert message.twist.twist.linear.x == pytest.approx(20.0 * KNOT)
    np.testing.assert_allclose(decode_velocity(message).velocity, velocity.velocity, atol=1e-12)
