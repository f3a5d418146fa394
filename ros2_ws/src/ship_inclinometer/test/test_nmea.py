# SPDX-License-Identifier: Apache-2.0
import math

import pynmeagps
import pytest

from ship_inclinometer.marine import Picture
from ship_inclinometer.nmea import all_sentences, checksum, heading, hrm, rot, sentence, xdr
from ship_inclinometer.samples import INVALID, VALID, Angles, Validity

NOW = 1_767_225_600_000_000_000


def picture(roll=12.34, pitch=-2.0, yaw=90.0, rate=0.0, validity=VALID):
    p = Picture(validity=validity, reason='', heading_valid=True)
    angles = tuple(math.radians(a) for a in (roll, pitch, yaw))
    p.take_angles(Angles(NOW, '', angles, (0.0, 0.0, 0.0), (0.0, 0.0, math.radians(rate)), validity))
    rolling = {'roll_period': 11.62, 'amplitude_port': 0.1712, 'amplitude_starboard': 0.2284}
    p.take_roll(NOW, {**rolling, 'peak_port': 0.2443, 'peak_starboard': 0.2653, 'peak_age': 3600.0})
    return p


def test_the_checksum_is_that_of_the_standards_example():
    assert checksum('GPGLL,5057.970,N,00146.110,E,142451,A') == '27'


def test_hrm_holds_heel_period_amplitudes_status_peaks_and_reset():
    text = hrm('II', picture(), NOW)
    assert text.startswith('$IIHRM,12.3,11.6,9.8,13.1,A,14.0,15.2,230000,31,12*')
    assert text.endswith('\r\n')


def test_an_invalid_or_stale_attitude_gives_status_v_and_no_numbers():
    for text in (hrm('II', picture(validity=INVALID), NOW), hrm('II', picture(), NOW + 2 * 10**9)):
        assert text.startswith('$IIHRM,,,,,V,')
    assert rot('II', picture(validity=INVALID), NOW).startswith('$IIROT,,V*')
    assert heading('II', picture(validity=INVALID), NOW) == [sentence('II', 'THS', '', 'V')]


@pytest.mark.parametrize(
    ('yaw', 'shown'), [(90.0, 0.0), (0.0, 90.0), (-90.0, 180.0), (180.0, 270.0), (90.04, 0.0)]
)
def test_heading_counts_clockwise_from_north(yaw, shown):
    ths, hdt = heading('II', picture(yaw=yaw), NOW)
    assert pynmeagps.NMEAReader.parse(ths.encode()).headt == pytest.approx(shown)
    assert pynmeagps.NMEAReader.parse(hdt.encode()).headingT == pytest.approx(shown)


def test_heel_is_positive_to_starboard_and_trim_bow_up():
    assert xdr('II', picture(roll=5.0, pitch=-2.0), NOW).startswith('$IIXDR,A,5.00,D,ROLL,A,2.00,D,PITCH*')


def test_a_turn_to_starboard_is_a_positive_rate():
    message = pynmeagps.NMEAReader.parse(rot('II', picture(rate=-1.0), NOW).encode())
    assert message.rot == pytest.approx(60.0)


def test_every_sentence_has_a_valid_checksum_and_fits_82_characters():
    for text in all_sentences('II', picture(roll=-44.9, pitch=-12.0, yaw=-179.0, rate=-3.0), NOW, True):
        pynmeagps.NMEAReader.parse(text.encode(), validate=pynmeagps.VALCKSUM)
        assert len(text) <= 82


def test_a_heel_that_may_be_off_by_more_than_a_degree_is_sent_with_status_v():
    p = picture()
    p.sigma_roll = 1.2
    assert hrm('II', p, NOW).startswith('$IIHRM,12.3,11.6,9.8,13.1,V,')


def test_no_negative_zero():
    assert hrm('II', picture(roll=-0.01), NOW).startswith('$IIHRM,0.0,')


def test_offsets_shift_heel_amplitudes_and_peaks_alike():
    p = picture(roll=5.0)
    plain = {
        n: p.number(n, NOW) for n in ('amplitude_port', 'amplitude_starboard', 'peak_port', 'peak_starboard')
    }
    p.take_settings({'roll_offset': 1.5, 'pitch_offset': -0.5, 'heading_offset': -10.0})
    p.take_angles(
        Angles(NOW + 10**8, '', (math.radians(5.0), 0.0, math.radians(90.0)), *[(0.0,) * 3] * 2, VALID)
    )
    assert (p.roll, p.pitch, p.heading) == pytest.approx((6.5, -0.5, 350.0))
    for name, value in plain.items():
        assert p.number(name, NOW) == pytest.approx(value + (1.5 if 'starboard' in name else -1.5))


def test_the_display_filter_smooths_what_is_shown_and_nothing_else():
    p = Picture()
    p.take_settings({'display_filter': 2.0})
    for n in range(21):
        heel = 0.0 if n == 0 else 10.0
        angles = (math.radians(heel), 0.0, 0.0)
        p.take_angles(Angles(NOW + n * 10**8, '', angles, (0.0,) * 3, (0.0,) * 3, VALID))
    assert p.roll == pytest.approx(10.0)
    # One time constant after a step.
    assert p.shown_roll == pytest.approx(10.0 * (1.0 - math.exp(-1.0)))


def test_a_roll_analysis_that_falls_silent_leaves_its_fields_empty():
    p = picture()
    for seconds, shown in ((2, ',11.6,9.8,13.1,A,14.0,15.2,230000,31,12*'), (4, ',,,,A,,,,,*')):
        later = NOW + seconds * 10**9
        p.take_angles(Angles(later, '', (math.radians(12.34), 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, VALID))
        assert hrm('II', p, later).startswith(f'$IIHRM,12.3{shown}')


def test_an_attitude_out_of_the_future_is_as_stale_as_an_old_one():
    p = picture()
    for step, shown in ((0.5, VALID), (-0.5, VALID), (1.5, INVALID), (-1.5, INVALID), (-3600.0, INVALID)):
        assert p.shown_validity(NOW + round(step * 1e9))[0] == shown
    assert 'in the future' in p.shown_validity(NOW - 3600 * 10**9)[1]
    assert 'stale' in p.shown_validity(NOW + 3600 * 10**9)[1]
    assert p.number('roll_period', NOW - 3600 * 10**9) != p.number('roll_period', NOW)


@pytest.mark.parametrize('age', [math.nan, math.inf, -1.0, 1e30])
def test_an_unknown_age_of_the_peaks_is_no_time_of_reset(age):
    p = picture()
    p.take_roll(NOW, {**p.rolling, 'peak_age': age})
    assert ',,,*' in hrm('II', p, NOW)


@pytest.mark.parametrize('yaw', [90.0, 90.0 + 1e-15, 90.0 + 1e-13, 90.001, 90.04, 450.0])
def test_a_heading_is_never_360(yaw):
    p = picture(yaw=yaw)
    assert 0.0 <= p.heading < 360.0
    assert heading('II', p, NOW)[0].startswith('$IITHS,0.0,A')


def test_a_validity_that_is_none_counts_as_invalid():
    p = picture()
    p.take_validity(Validity(NOW, 7, '', True, (0.1, 0.1, 0.1)))
    assert p.shown_validity(NOW)[0] == INVALID


def test_alarms_of_a_monitor_that_fell_silent_are_unknown():
    p = picture()
    assert not p.alarms_known(NOW)
    p.take_alarms(NOW, {'heel_alarm': 1.0})
    assert p.shown_alarms(NOW + 2 * 10**9) == {'heel_alarm': 1.0}
    for later in (NOW + 4 * 10**9, NOW - 4 * 10**9):
        assert p.shown_alarms(later) == {}
