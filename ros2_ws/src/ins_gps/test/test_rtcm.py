# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rtcm_encoder import (
    MS,
    Bits,
    ephemeris_1019,
    ephemeris_galileo,
    msm,
    station,
    wrapped_phase,
)

from ins_gps.channels import wavelength
from ins_gps.constants import GPS_EPOCH_UNIX, WEEK
from ins_gps.observations import EpochBuilder
from ins_gps.orbit import COLUMN, EPHEMERIS_FIELDS
from ins_gps.rinex import read_navigation, read_observations
from ins_gps.rtcm import RtcmDecoder
from ins_gps.rtcm_messages import lock_coarse, lock_fine
from ins_gps.samples import OBS, GnssEpoch, ReceiverFix
from kalman_core.earth import ecef_from_geodetic

NANOSECONDS = 1_000_000_000
EVERYTHING = (1, 2, 5, 7)
# Half of the last place of range (m), phase (m), rate (m/s) and C/N0 (dB-Hz) of each kind of MSM.
COARSE = (MS * 2.0**-25, MS * 2.0**-30, 0.5e-4, 0.5)
FINE = (MS * 2.0**-30, MS * 2.0**-32, 0.5e-4, 0.5 / 16)
HALF_PLACES = {4: COARSE, 5: COARSE, 6: FINE, 7: FINE}

ORBIT = dict.fromkeys(EPHEMERIS_FIELDS, 0.0) | {
    'satellite': 7, 'sqrt_a': 5153.6, 'eccentricity': 0.01, 'inclination': 0.96, 'week_second': 345_600.0,
    'toc': 345_600.0, 'issue': 33, 'af0': 1e-4, 'mean_anomaly': 0.3, 'ascending_node': 1.0, 'perigee': -0.5,
}  # fmt: skip
WEEK_NUMBER = 2301
EPHEMERIS = ephemeris_1019(ORBIT, WEEK_NUMBER)
TOW = 345_700_000  # ms
CELL = {'satellite': 7, 'code': '1C', 'range': 2.2e7, 'phase': 2.2e7 + 31.0, 'rate': -345.6789, 'cn0': 44.0}


def decode(*messages, bands=EVERYTHING, **options):
    """Return the decoder and the epochs of a stream, the last one included."""
    decoder = RtcmDecoder(bands, **options)
    out = [*decoder.feed(b''.join(messages)), *decoder.rest()]
    return decoder, [sample for sample in out if isinstance(sample, GnssEpoch)]


def rows_of(*messages):
    _, (epoch,) = decode(EPHEMERIS, *messages)
    return {tuple(row[:3].astype(int)): row for row in epoch.rows}


@pytest.mark.parametrize('kind', [4, 5, 6, 7])
def test_measurements_are_within_half_of_the_last_place(kind):
    row = rows_of(msm('G', kind, TOW, [CELL]))[0, 7, 1]
    length = wavelength(1)
    code, phase, rate, cn0 = HALF_PLACES[kind]
    assert abs(row[3] - CELL['range']) <= code * 1.001
    assert abs(row[4] * length - CELL['phase']) <= phase * 1.001
    assert abs(row[6] - CELL['cn0']) <= cn0
    if kind in (5, 7):
        # A satellite that comes nearer has a positive Doppler shift.
        assert abs(row[5] * length - 345.6789) <= rate * 1.001
    else:
        assert np.isnan(row[5])


def test_time_is_that_of_the_ephemerides_week():
    _, (epoch,) = decode(EPHEMERIS, msm('G', 7, TOW, [CELL]), utc=False)
    assert epoch.stamp == (WEEK_NUMBER * WEEK + 345_700 + GPS_EPOCH_UNIX) * NANOSECONDS
    _, (epoch,) = decode(EPHEMERIS, msm('G', 7, TOW + 1, [CELL]), leap=17)
    assert epoch.stamp == (WEEK_NUMBER * WEEK + 345_683 + GPS_EPOCH_UNIX) * NANOSECONDS + 1_000_000


def test_an_old_recording_is_dated_by_galileo_or_by_the_parameter():
    old, cell = 1800, msm('G', 7, TOW, [CELL])
    week = {}
    for name, messages, options in (
        ('pivot', (ephemeris_1019(ORBIT, old), cell), {}),
        ('parameter', (ephemeris_1019(ORBIT, old), cell), {'week': 1900}),
        ('galileo', (ephemeris_galileo(ORBIT, old, 1046), ephemeris_1019(ORBIT, old), cell), {}),
    ):
        _, (epoch,) = decode(*messages, utc=False, **options)
        week[name] = (epoch.stamp // NANOSECONDS - GPS_EPOCH_UNIX) // WEEK
    assert week == {'pivot': old + 1024, 'parameter': old, 'galileo': old}


def test_time_goes_on_over_the_end_of_a_week():
    orbit = ORBIT | {'week_second': 604_784.0, 'toc': 604_784.0}
    tows = [604_799_000, 604_799_500, 0, 500]
    _, epochs = decode(
        ephemeris_1019(orbit, WEEK_NUMBER), *(msm('G', 7, tow, [CELL]) for tow in tows), utc=False
    )
    seconds = [e.stamp / NANOSECONDS - GPS_EPOCH_UNIX - (WEEK_NUMBER + 1) * WEEK for e in epochs]
    assert seconds == [-1.0, -0.5, 0.0, 0.5]
    assert all(len(epoch.rows) == 1 for epoch in epochs)


def test_an_epoch_ends_with_the_multiple_message_bit():
    decoder = RtcmDecoder()
    list(decoder.feed(EPHEMERIS + ephemeris_galileo(ORBIT, WEEK_NUMBER, 1046)))
    galileo = CELL | {'code': '1X'}
    assert not list(decoder.feed(msm('G', 7, TOW, [CELL], more=True)))
    (epoch,) = decoder.feed(msm('E', 7, TOW, [galileo]))
    assert epoch.rows[:, 0].tolist() == [0.0, 1.0]
    # A constellation that is not read may say that the epoch is over.
    assert not list(decoder.feed(msm('G', 7, TOW + 1000, [CELL], more=True)))
    beidou = Bits().add(1127, 12).add(7, 12).add(TOW - 13_000, 30).add(0, 1).add(0, 114).frame()
    assert len(list(decoder.feed(beidou))) == 1
    # Where the last message was lost, the next epoch ends it.
    assert not list(decoder.feed(msm('G', 7, TOW + 2000, [CELL], more=True)))
    (late,) = decoder.feed(msm('G', 7, TOW + 3000, [CELL], more=True))
    (last,) = decoder.rest()
    assert last.stamp - late.stamp == NANOSECONDS
    assert decoder.accepted['epoch without a last message'] == 1


def test_what_is_not_available_is_nan():
    bare = [
        {'satellite': 7, 'code': '1C', 'range': 2.2e7},
        {'satellite': 7, 'code': '5Q', 'range': 2.2e7, 'phase': 2.2e7, 'cn0': 30.0},
    ]
    rows = rows_of(msm('G', 7, TOW, bare))
    assert np.isnan(rows[0, 7, 1][[4, 5, 6]]).all()
    assert np.isnan(rows[0, 7, 5][5])
    assert np.isfinite(rows[0, 7, 5][[3, 4, 6]]).all()
    nothing = {'satellite': 7, 'code': '1C'}
    _, (epoch,) = decode(EPHEMERIS, msm('G', 4, TOW, [nothing]))
    assert len(epoch.rows) == 0


def test_the_preferred_signal_of_a_band_is_taken_and_a_change_of_it_is_a_slip():
    both = [CELL | {'code': '1W', 'range': 2.2e7 + 20.0}, CELL]
    assert rows_of(msm('G', 7, TOW, both))[0, 7, 1][3] == pytest.approx(2.2e7, abs=0.01)
    lock = {'lock': 600}
    first = msm('G', 7, TOW, [cell | lock for cell in both])
    second = msm('G', 7, TOW + 1000, [both[0] | lock])
    _, epochs = decode(EPHEMERIS, first, second)
    assert [epoch.rows[0, OBS['slip']] for epoch in epochs] == [0.0, 1.0]


def test_lock_times_are_those_of_the_tables():
    # Rows of table 3.5-74 and 3.5-75: indicator and least lock time in ms.
    coarse = {0: 0, 1: 32, 2: 64, 8: 4096, 15: 524_288}
    fine = {0: 0, 63: 63, 64: 64, 95: 126, 96: 128, 127: 252, 128: 256, 160: 512, 255: 4032}
    fine |= {352: 32_768, 640: 16_777_216, 671: 33_030_144, 703: 66_060_288, 704: 67_108_864}
    assert {i: lock_coarse(i)[0] * 1e3 for i in coarse} == pytest.approx(coarse)
    assert {i: lock_fine(i)[0] * 1e3 for i in fine} == pytest.approx(fine)
    for bounds, last in ((lock_coarse, 15), (lock_fine, 704)):
        assert all(bounds(i)[1] == pytest.approx(bounds(i + 1)[0]) for i in range(last))
        assert bounds(last)[1] == math.inf


@pytest.mark.parametrize(
    ('kind', 'before', 'seconds', 'after', 'slip'),
    [
        (7, 320, 1, 321, 0),  # 16.384 s, steps of 0.512 s
        (7, 320, 1, 320, 1),  # had to grow by a step at least
        (7, 320, 3, 321, 1),
        (7, 320, 1, 319, 1),
        (7, 704, 1, 704, 0),
        (7, 320, 1, 0, 1),
        (7, 0, 1, 224, 0),  # 2.048 s
        (4, 10, 1, 10, 0),
        (4, 10, 1, 9, 1),
        (4, 5, 10, 6, 1),
        (4, 15, 1000, 15, 0),
    ],
)
def test_slips_follow_from_lock_times(kind, before, seconds, after, slip):
    first = msm('G', kind, TOW, [CELL | {'lock': before}])
    second = msm('G', kind, TOW + 1000 * seconds, [CELL | {'lock': after}])
    _, epochs = decode(EPHEMERIS, first, second)
    assert epochs[0].rows[0, OBS['slip']] == float(before == 0)
    assert epochs[1].rows[0, OBS['slip']] == slip
    least = (lock_fine if kind == 7 else lock_coarse)(after)[0]
    assert epochs[1].rows[0, OBS['lock_time']] >= least


def test_another_station_starts_locks_anew_and_is_said():
    messages = [msm('G', 7, TOW + 1000 * i, [CELL | {'lock': 600 - 100 * i}], station=i) for i in range(3)]
    decoder, epochs = decode(EPHEMERIS, *messages)
    assert [epoch.rows[0, OBS['slip']] for epoch in epochs] == [0.0, 0.0, 0.0]
    assert decoder.rejected['station changed'] == 2


def test_epochs_need_ephemerides_and_are_counted_without():
    decoder, epochs = decode(
        msm('G', 7, TOW, [CELL]), EPHEMERIS, msm('G', 7, TOW + 1000, [CELL, CELL | {'satellite': 9}])
    )
    (epoch,) = epochs
    assert len(epoch.rows) == 1
    assert decoder.rejected == {'epoch: week unknown, no ephemeris yet': 1}
    assert decoder.missing == ('G09',)
    assert decoder.left_out == {'without ephemeris': 1}


def test_time_that_repeats_or_goes_back_is_said():
    tows = (TOW, TOW, TOW + 1000, TOW - 5000, TOW - 4000)
    decoder, epochs = decode(EPHEMERIS, *(msm('G', 7, tow, [CELL]) for tow in tows))
    assert len(epochs) == 4
    assert decoder.rejected == {'epoch: repeated': 1, 'time went back': 1}


def test_one_stale_ephemeris_is_refused_and_a_leap_believed():
    stale = ephemeris_1019(ORBIT | {'satellite': 9}, WEEK_NUMBER - 3)
    decoder, epochs = decode(EPHEMERIS, msm('G', 7, TOW, [CELL]), stale, msm('G', 7, TOW + 1000, [CELL]))
    assert epochs[1].stamp - epochs[0].stamp == NANOSECONDS
    assert decoder.rejected == {'ephemeris of another week': 1}
    later = [ephemeris_1019(ORBIT | {'satellite': s}, WEEK_NUMBER + 9) for s in range(1, 9)]
    decoder, epochs = decode(EPHEMERIS, msm('G', 7, TOW, [CELL]), *later, msm('G', 7, TOW, [CELL]))
    assert epochs[1].stamp - epochs[0].stamp == 9 * WEEK * NANOSECONDS
    assert len(epochs[1].rows) == 1


def test_the_clock_of_inav_is_preferred():
    inav, fnav = ORBIT | {'af0': 1e-4}, ORBIT | {'af0': 2e-4}
    for order in ((1046, 1045), (1045, 1046), (1045, 1046, 1045)):
        messages = [ephemeris_galileo(fnav if n == 1045 else inav, WEEK_NUMBER, n) for n in order]
        decoder, _ = decode(*messages, msm('E', 7, TOW, [CELL | {'code': '1X'}]))
        assert decoder.ephemerides[-1, COLUMN['af0']] == pytest.approx(1e-4, rel=1e-6)
    decoder, _ = decode(ephemeris_galileo(fnav, WEEK_NUMBER, 1045), msm('E', 7, TOW, [CELL | {'code': '1X'}]))
    assert decoder.ephemerides[0, COLUMN['af0']] == pytest.approx(2e-4, rel=1e-6)


def test_health_takes_satellites_out():
    ill = ephemeris_1019(ORBIT | {'health': 1}, WEEK_NUMBER)
    decoder, (epoch,) = decode(ill, msm('G', 7, TOW, [CELL]))
    assert len(epoch.rows) == 0
    for number, health in (
        (1045, 1 << 3),
        (1045, 3 << 4),
        (1046, 1),
        (1046, 2 << 1),
        (1046, 1 << 6),
        (1046, 3 << 7),
    ):
        message = ephemeris_galileo(ORBIT | {'health': health}, WEEK_NUMBER, number)
        decoder, _ = decode(message, msm('E', 7, TOW, [CELL | {'code': '1X'}]))
        assert decoder.ephemerides[0, COLUMN['health']] == health


@pytest.mark.parametrize('height', [None, 1.5])
def test_the_base_is_where_1005_and_1006_say(height):
    geodetic = np.array([math.radians(21.0285), math.radians(105.8542), 12.345])
    decoder = RtcmDecoder(utc=False)
    message = station(ecef_from_geodetic(*geodetic), height)
    assert not list(decoder.feed(message))  # no time to stamp it with yet
    epoch, base = decoder.feed(EPHEMERIS + msm('G', 7, TOW, [CELL]))
    assert isinstance(base, ReceiverFix)
    assert base.stamp == epoch.stamp
    np.testing.assert_allclose(base.geodetic[:2], geodetic[:2], atol=2e-11)
    assert base.geodetic[2] == pytest.approx(12.345, abs=1e-4)
    assert (base.covariance_type, base.covariance[0, 0]) == (1, pytest.approx(0.05**2))
    (again,) = decoder.feed(message)
    assert again.stamp == epoch.stamp
    assert not list(decoder.feed(station((1.0, 2.0, 3.0))))
    assert decoder.rejected['1005: unreadable'] == 1


@pytest.mark.parametrize('piece', [1, 13, 10**6])
def test_damage_costs_only_the_damaged(piece):
    messages = [msm('G', 7, TOW + 1000 * i, [CELL]) for i in range(5)]
    broken = bytearray(messages[2])
    broken[30] ^= 4
    stream = b'$GNGGA,\xd3\xd3noise' + EPHEMERIS + messages[0] + b'\xd3\x03' + messages[1]
    stream += bytes(broken) + messages[3][:40] + b'\xb5\x62' + messages[3] + b'\xd3\x00\x00' + messages[4]
    decoder, out = RtcmDecoder(utc=False), []
    for start in range(0, len(stream), piece):
        out += decoder.feed(stream[start : start + piece])
    out += decoder.feed(bytes(1100))
    seconds = [round(e.stamp / NANOSECONDS - GPS_EPOCH_UNIX - WEEK_NUMBER * WEEK - TOW * 1e-3) for e in out]
    assert seconds == [0, 1, 3, 4]
    assert decoder.rejected['checksum'] >= 2


def test_messages_with_a_right_checksum_and_a_wrong_content_raise_nothing():
    rng = np.random.default_rng(5)
    decoder = RtcmDecoder(EVERYTHING)
    list(decoder.feed(EPHEMERIS))
    for number in (1005, 1006, 1019, 1045, 1046, 1074, 1075, 1076, 1077, 1094, 1097, 1127, 1029, 4095):
        for length in (0, 1, 6, 20, 60, 200):
            bits = Bits().add(number, 12)
            for byte in rng.bytes(length):
                bits.add(byte, 8)
            for sample in decoder.feed(bits.frame()):
                assert not np.isinf(getattr(sample, 'rows', np.zeros(1))).any()
    assert sum(count for reason, count in decoder.rejected.items() if 'unreadable' in reason) > 20
    _, epochs = decode(EPHEMERIS, Bits().add(1077, 12).add(7, 12).frame(), msm('G', 7, TOW, [CELL]))
    assert len(epochs) == 1


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=300))
def test_random_bytes_raise_nothing(data):
    decode(data, EPHEMERIS, data, msm('G', 7, TOW, [CELL]), data)


# The example of RTCM 10403.1, section 4.2: station 2003.
PRINTED_1005 = bytes.fromhex('D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98')


def test_the_printed_message_is_read_as_it_is_explained():
    position = (1114104.5999, -4850729.7108, 3975521.4643)
    assert station(position, identity=2003)[3:6] == PRINTED_1005[3:6]
    _, base = RtcmDecoder().feed(PRINTED_1005 + EPHEMERIS + msm('G', 7, TOW, [CELL]))
    np.testing.assert_allclose(ecef_from_geodetic(*base.geodetic), position, atol=1e-6)


def test_an_empty_message_keeps_the_connection_and_nothing_else():
    decoder, epochs = decode(EPHEMERIS, Bits().frame(), msm('G', 7, TOW, [CELL]), Bits().frame())
    assert len(epochs) == 1
    assert not decoder.rejected


def test_signals_and_satellites_that_are_not_known_cost_nobody_else():
    cells = [CELL | {'code': 'reserved'}, CELL | {'satellite': 40}, CELL]
    assert set(rows_of(msm('G', 7, TOW, cells))) == {(0, 7, 1)}
    galileo = [CELL | {'code': code} for code in ('1Z', '8Q', '1C')]
    _, (epoch,) = decode(ephemeris_galileo(ORBIT, WEEK_NUMBER, 1046), msm('E', 7, TOW, galileo))
    assert epoch.rows[:, :3].tolist() == [[1.0, 7.0, 1.0]]


def test_only_the_bands_asked_for_are_given():
    cells = [CELL, CELL | {'code': '2X'}, CELL | {'code': '5X'}]
    for bands in ((1,), (2, 5), EVERYTHING):
        _, (epoch,) = decode(EPHEMERIS, msm('G', 7, TOW, cells), bands=bands)
        assert {row[2] for row in epoch.rows} == set(bands) - {7}


def test_a_signal_of_which_nothing_was_measured_has_no_row():
    cells = [CELL, {'satellite': 7, 'code': '5Q'}]
    assert set(rows_of(msm('G', 7, TOW, cells))) == {(0, 7, 1)}


def test_a_time_that_no_week_has_is_refused():
    decoder, epochs = decode(EPHEMERIS, msm('G', 7, WEEK * 1000, [CELL]), msm('G', 7, TOW, [CELL]))
    assert len(epochs) == 1
    assert decoder.rejected['1077: unreadable'] == 1


def test_an_ephemeris_that_is_repeated_is_kept_once_and_one_of_no_orbit_never():
    unready = ephemeris_1019(ORBIT | {'satellite': 9, 'sqrt_a': 0.0}, WEEK_NUMBER)
    decoder, _ = decode(EPHEMERIS, msm('G', 7, TOW, [CELL]), EPHEMERIS, unready, EPHEMERIS)
    assert len(decoder.ephemerides) == 1
    assert decoder.rejected == {'ephemeris of no orbit': 1}


def test_a_good_ephemeris_takes_back_the_doubt_of_stale_ones():
    stale = [ephemeris_1019(ORBIT | {'satellite': s}, WEEK_NUMBER - 3) for s in range(10, 16)]
    messages = [m for one in stale for m in (one, ephemeris_1019(ORBIT | {'issue': 34}, WEEK_NUMBER))]
    decoder, epochs = decode(EPHEMERIS, msm('G', 7, TOW, [CELL]), *messages, msm('G', 7, TOW + 1000, [CELL]))
    assert epochs[1].stamp - epochs[0].stamp == NANOSECONDS
    assert decoder.rejected == {'ephemeris of another week': 6}


def test_reserved_lock_times_say_nothing():
    assert lock_fine(705) == lock_fine(1023) == (0.0, math.inf)


# --- a recorded receiver, sent as RTCM -----------------------------------------------------------------

LETTERS = 'GE'
CODES = {(0, 1): '1C', (0, 2): '2X', (0, 5): '5X', (1, 1): '1X', (1, 5): '5X', (1, 7): '7X'}


@pytest.fixture(scope='module')
def walk(recordings):
    folder = recordings / 'gnss_imu_walk_60s'
    if not folder.is_dir():
        pytest.skip(f'no recording at {folder}')
    rows = {}
    for row in read_navigation(folder / 'walk.nav').ephemerides:
        # The file has I/NAV and F/NAV of the same time; 1046 has the group delay of one, and no E5a health.
        if row[0] == 1.0:
            row[COLUMN['health']] = int(row[COLUMN['health']]) & ~0b111000
        rows.setdefault((row[0], row[1], row[COLUMN['toe']]), row)
    return read_observations(folder / 'walk_60s.obs', EVERYTHING), np.array(list(rows.values()))


def sent_ephemerides(ephemerides):
    """Return messages of the ephemerides, in order of their time."""
    out = []
    for row in ephemerides[np.argsort(ephemerides[:, COLUMN['toe']])]:
        fields = dict(zip(EPHEMERIS_FIELDS, row)) | {'accuracy': 0}
        week = int(row[COLUMN['toe']] // WEEK)
        fields |= {'satellite': int(row[1]), 'toc': row[COLUMN['toc']] % WEEK}
        if row[0] == 0.0:
            out.append(ephemeris_1019(fields, week))
        else:
            out.append(ephemeris_galileo(fields, week, 1046))
    return out


def sent_epoch(raw, kind, shifts):
    """Return the MSM of a RINEX epoch; `shifts` remembers the whole cycles that the phases were moved by."""
    tow = round(raw.time / 1e6) % (WEEK * 1000)
    systems = [s for s in (0, 1) if (raw.rows[:, 0] == s).any()]
    out = []
    for system in systems:
        cells = []
        for row in raw.rows[raw.rows[:, 0] == system]:
            length = wavelength(row[2])
            cell = {'satellite': int(row[1]), 'code': CODES[system, int(row[2])], 'lock': 10}
            cell['range'] = None if np.isnan(row[3]) else row[3]
            if np.isfinite(row[4]) and np.isfinite(row[3]):
                key = tuple(row[:3])
                if key not in shifts:
                    shifts[key] = wrapped_phase(row[4], length, row[3])[1]
                cell['phase'] = (row[4] - shifts[key]) * length
                if abs(cell['phase'] - row[3]) > 1000.0:
                    cell['phase'] = None
            cell['rate'] = None if np.isnan(row[5]) else -row[5] * length
            cell['cn0'] = None if np.isnan(row[6]) else row[6]
            cells.append(cell)
        out.append(msm(LETTERS[system], kind, tow, cells, more=system != systems[-1]))
    return b''.join(out)


@pytest.mark.parametrize('kind', [4, 5, 6, 7])
def test_a_recorded_epoch_is_the_same_through_rtcm_and_rinex(walk, kind):
    observations, ephemerides = walk
    builder = EpochBuilder(ephemerides)
    shifts = {}
    decoder = RtcmDecoder(EVERYTHING, utc=False)
    list(decoder.feed(b''.join(sent_ephemerides(ephemerides))))
    places = HALF_PLACES[kind]
    compared = dict.fromkeys(('range', 'phase', 'doppler', 'cn0', 'orbit'), 0)
    for raw in observations.epochs[:40]:
        theirs = {tuple(row[:3]): row for row in builder.build(raw).rows}
        (epoch,) = decoder.feed(sent_epoch(raw, kind, shifts))
        assert abs(epoch.stamp - raw.time - GPS_EPOCH_UNIX * NANOSECONDS) <= 500_000  # ms are sent
        for ours in epoch.rows:
            key = tuple(ours[:3])
            other, length = theirs[key], wavelength(ours[2])
            assert abs(ours[3] - other[3]) <= places[0] + 1e-7
            compared['range'] += 1
            if np.isfinite(ours[4]):
                assert abs((ours[4] + shifts[key] - other[4]) * length) <= places[1] + 1e-7
                compared['phase'] += 1
            if np.isfinite(ours[5]):
                assert abs(ours[5] - other[5]) * length <= places[2] + 1e-9
                compared['doppler'] += 1
            if np.isfinite(other[6]):
                assert abs(ours[6] - other[6]) <= places[3] + 1e-9
                compared['cn0'] += 1
            # 4 km/s times the 0.5 ms that the time is rounded by.
            np.testing.assert_allclose(ours[9:12], other[9:12], rtol=0.0, atol=2.1)
            np.testing.assert_allclose(ours[12:15], other[12:15], rtol=0.0, atol=1e-3)
            assert abs(ours[15] - other[15]) < 1e-12
            compared['orbit'] += 1
    assert compared['range'] == compared['orbit'] > 400
    assert compared['phase'] > 300
    assert compared['cn0'] > 400
    assert (compared['doppler'] > 400) == (kind in (5, 7))


def test_recorded_ephemerides_survive_to_the_digits_of_the_file(walk):
    _, ephemerides = walk
    decoder = RtcmDecoder(EVERYTHING)
    messages = sent_ephemerides(ephemerides)
    newest = float(ephemerides[:, COLUMN['toe']].max())
    list(decoder.feed(b''.join(messages) + msm('G', 7, int(newest % WEEK) * 1000, [CELL])))
    theirs = {(r[0], r[1], r[COLUMN['toe']]): r for r in ephemerides}
    assert len(decoder.ephemerides) >= 10
    kept = np.arange(len(EPHEMERIS_FIELDS)) != COLUMN['accuracy']
    for row in decoder.ephemerides:
        other = theirs[row[0], row[1], row[COLUMN['toe']]]
        np.testing.assert_allclose(row[kept], other[kept], rtol=2e-11, atol=0.0)


def test_rtklib_reads_the_same_from_the_same_bytes(walk):
    """Signs, units and wavelengths: an independent decoder in the benchmark environment."""
    rtk = pytest.importorskip('pyrtklib', reason='pyrtklib lives in the benchmark environment')
    observations, ephemerides = walk
    shifts = {}
    stream = [sent_epoch(raw, 7, shifts) for raw in observations.epochs[:5]]
    decoder = RtcmDecoder((1,), utc=False)
    list(decoder.feed(b''.join(sent_ephemerides(ephemerides))))
    other = rtk.rtcm_t()
    rtk.init_rtcm(other)
    first = observations.epochs[0].time / NANOSECONDS
    other.time = rtk.gpst2time(int(first // WEEK), first % WEEK)
    compared = 0
    for data in stream:
        (epoch,) = decoder.feed(data)
        ours = {(LETTERS[int(r[0])], int(r[1])): r for r in epoch.rows}
        assert 1 in [rtk.input_rtcm3(other, byte) for byte in data]
        for i in range(other.obs.n):
            obs = other.obs.data[i]
            number = rtk.Arr1Dint(1)
            letter = {rtk.SYS_GPS: 'G', rtk.SYS_GAL: 'E'}.get(rtk.satsys(obs.sat, number))
            row = ours.get((letter, number[0]))
            if row is None or obs.P[0] == 0.0:
                continue
            assert row[3] == pytest.approx(obs.P[0], abs=1e-6)
            if np.isfinite(row[4]):
                assert row[4] == pytest.approx(obs.L[0], abs=1e-4)
            assert row[5] == pytest.approx(obs.D[0], abs=1e-3)
            assert row[6] == pytest.approx(obs.SNR[0] * rtk.SNR_UNIT, abs=0.01)
            compared += 1
    assert compared > 40
