# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np
import pytest
from pyubx2 import GET, UBXMessage

from ins_gps.broadcast import BroadcastStore, galileo_accuracy, gps_accuracy
from ins_gps.constants import GPS_EPOCH_UNIX, WEEK
from ins_gps.observations import EpochBuilder
from ins_gps.orbit import COLUMN
from ins_gps.rinex import read_navigation, read_observations
from ins_gps.samples import OBS, GnssEpoch, ReceiverFix
from ins_gps.ublox import RawxReader, UbloxDecoder
from node_core.byte_frames import UBX, MessageCutter

NANOSECONDS = 1_000_000_000
EVERYTHING = (1, 2, 5, 7)
FINE = {'gnssId': 0, 'svId': 7, 'sigId': 0, 'prMes': 2.2e7, 'cpMes': 1.15e8, 'doMes': -1234.5, 'cno': 44}


def rawx(tow, *cells, week=2300, leap=18, status=1):
    """Return an RXM-RAWX frame made by pyubx2."""
    fields = {'rcvTow': tow, 'week': week, 'leapS': leap, 'numMeas': len(cells)}
    fields |= {'leapSec': status & 1, 'clkReset': status >> 1}
    for number, cell in enumerate(cells, 1):
        known = FINE | {'locktime': 64500, 'prValid': 1, 'cpValid': 1, 'halfCyc': 1, 'subHalfCyc': 0} | cell
        fields |= {f'{name}_{number:02d}': value for name, value in known.items()}
    return UBXMessage('RXM', 'RXM-RAWX', GET, **fields).serialize()


def pvt(**changes):
    """Return a NAV-PVT frame made by pyubx2."""
    fields = {'year': 2024, 'month': 2, 'day': 29, 'hour': 23, 'min': 59, 'second': 59, 'nano': -250_000_000}
    fields |= {'validDate': 1, 'validTime': 1, 'fixType': 3, 'gnssFixOk': 1, 'diffSoln': 0}
    fields |= {'lat': 21.0285, 'lon': 105.8542, 'height': 12_345, 'hAcc': 1500, 'vAcc': 2500}
    return UBXMessage('NAV', 'NAV-PVT', GET, **(fields | changes)).serialize()


def read(*frames):
    """Return the epochs of RXM-RAWX frames."""
    reader = RawxReader(EVERYTHING)
    return [reader.read(frame[6:-2]) for frame in frames]


def test_measurements_and_time_are_what_pyubx2_wrote():
    cells = [
        FINE,
        FINE | {'gnssId': 2, 'svId': 33, 'sigId': 5, 'prMes': 2.5e7, 'cno': 0},
        FINE | {'sigId': 7, 'prValid': 0},
        FINE | {'svId': 9, 'cpValid': 0},
        FINE | {'svId': 10, 'prValid': 0, 'cpValid': 0},
        FINE | {'gnssId': 6},  # GLONASS
        FINE | {'svId': 255},  # tracked but not identified
    ]
    (epoch,) = read(rawx(345_600.25, *cells))
    nan = np.nan
    doppler = float(np.float32(-1234.5))
    expected = [
        [0, 7, 1, 2.2e7, 1.15e8, doppler, 44, 0],
        [1, 33, 7, 2.5e7, 1.15e8, doppler, nan, 0],
        [0, 7, 5, nan, 1.15e8, doppler, 44, 0],
        [0, 9, 1, 2.2e7, nan, doppler, 44, 0],
    ]
    assert epoch.time == 2300 * WEEK * NANOSECONDS + 345_600_250_000_000
    np.testing.assert_array_equal(epoch.rows, expected)


@pytest.mark.parametrize(
    ('later', 'loss'),
    [
        ({'locktime': 6000}, 0),
        ({'locktime': 64500}, 0),
        ({'locktime': 400}, 1),  # lock began within the second between the epochs
        ({'locktime': 0}, 1),
        ({'locktime': 6000, 'halfCyc': 0}, 2),
        ({'locktime': 6000, 'subHalfCyc': 1}, 1),
    ],
)
def test_slips_follow_from_lock_time_and_half_cycles(later, loss):
    first, second = read(rawx(100.0, FINE | {'locktime': 5000}), rawx(101.0, FINE | later))
    assert first.rows[0, 7] == 0
    assert second.rows[0, 7] == loss


@pytest.mark.parametrize('code', [float('nan'), float('inf'), -1.0, 0.0, 1e300])
def test_a_range_that_cannot_be_is_not_measured(code):
    (epoch,) = read(rawx(1.0, {'prMes': code}))
    assert np.isnan(epoch.rows[0, 3])
    assert epoch.rows[0, 4] == 1.15e8


def test_a_lock_shorter_than_the_gap_is_a_slip_even_when_it_grew():
    first, second = read(rawx(100.0, {'locktime': 1000}), rawx(110.0, {'locktime': 5000}))
    assert (first.rows[0, 7], second.rows[0, 7]) == (0, 1)


def test_a_reset_of_the_receiver_clock_flags_every_phase():
    _, second = read(rawx(100.0, {}, {'svId': 9}), rawx(101.0, {}, {'svId': 9}, status=3))
    assert second.rows[:, 7].tolist() == [1, 1]


@pytest.mark.parametrize(
    ('payload', 'reason'),
    [
        (rawx(1.0, {}, week=0)[6:-2], 'time unknown'),
        (rawx(-1.0, {})[6:-2], 'time unknown'),
        (rawx(float('nan'), {})[6:-2], 'time unknown'),
        (rawx(1.0, {})[6:-3], 'length'),
        (b'', 'length'),
    ],
)
def test_an_epoch_that_cannot_be_read_says_why(payload, reason):
    assert RawxReader().read(payload) == reason


def test_random_bytes_raise_nothing_and_the_next_frames_are_read():
    rng = np.random.default_rng(3)
    decoder = UbloxDecoder()
    for kind in (b'\x01\x07', b'\x02\x13', b'\x02\x15'):
        for length in (0, 3, 8, 16, 48, 92):
            body = kind + length.to_bytes(2, 'little') + rng.bytes(length)
            first = second = 0
            for byte in body:
                first = (first + byte) & 255
                second = (second + first) & 255
            assert list(decoder.feed(b'\xb5\x62' + body + bytes((first, second)))) is not None
    list(decoder.feed(rng.bytes(50_000)))
    # A sync within the noise may wait for as many bytes as the longest frame has.
    out = list(decoder.feed(b''.join(pvt(second=i % 60) for i in range(120))))
    assert sum(isinstance(sample, ReceiverFix) for sample in out) > 20
    assert decoder.rejected['unreadable message'] > 0


def test_a_fix_has_its_time_place_and_covariance():
    (fix,) = UbloxDecoder().feed(pvt())
    assert fix.stamp == 1_709_251_198_750_000_000  # 2024-02-29T23:59:58.75Z
    np.testing.assert_allclose(np.degrees(fix.geodetic[:2]), (21.0285, 105.8542), atol=1e-9)
    assert fix.geodetic[2] == pytest.approx(12.345)
    np.testing.assert_allclose(np.diag(fix.covariance), (2.25, 2.25, 6.25))
    assert fix.status == 0
    (gps,) = UbloxDecoder(utc=False, leap=17).feed(pvt(diffSoln=1))
    assert gps.stamp - fix.stamp == 17 * NANOSECONDS
    assert gps.status == 2


def test_no_fix_is_said_and_a_fix_without_time_is_refused():
    decoder = UbloxDecoder()
    (none,) = decoder.feed(pvt(fixType=0, gnssFixOk=0))
    assert none.status == -1
    assert not list(decoder.feed(pvt(validTime=0)))
    assert not list(decoder.feed(pvt(month=13)))
    assert decoder.rejected == {'fix without time': 1, 'unreadable message': 1}


def test_satellites_without_ephemeris_are_left_out_and_counted():
    decoder = UbloxDecoder()
    (epoch,) = decoder.feed(rawx(10.0, {}, {'gnssId': 2, 'svId': 4}))
    assert isinstance(epoch, GnssEpoch)
    assert len(epoch.rows) == 0
    assert decoder.missing == ('E04', 'G07')
    assert decoder.left_out == {'without ephemeris': 2}
    list(decoder.feed(rawx(11.0, {'prValid': 0})))
    assert decoder.left_out['without code'] == 1


def test_stamps_are_utc_by_the_receivers_leap_seconds():
    (utc,) = UbloxDecoder().feed(rawx(10.0, {}, leap=20))
    (unknown,) = UbloxDecoder(leap=19).feed(rawx(10.0, {}, leap=20, status=0))
    (gps,) = UbloxDecoder(utc=False).feed(rawx(10.0, {}, leap=20))
    assert gps.stamp == (2300 * WEEK + 10 + GPS_EPOCH_UNIX) * NANOSECONDS
    assert gps.stamp - utc.stamp == 20 * NANOSECONDS
    assert gps.stamp - unknown.stamp == 19 * NANOSECONDS


def test_time_that_repeats_is_refused_and_time_that_goes_back_starts_anew():
    decoder = UbloxDecoder()
    stamps = [e.stamp for tow in (100.0, 100.0, 101.0, 50.0, 51.0) for e in decoder.feed(rawx(tow, {}))]
    assert np.diff(stamps).tolist() == [NANOSECONDS, -51 * NANOSECONDS, NANOSECONDS]
    assert decoder.rejected['epoch: repeated'] == 1
    assert decoder.rejected['time went back'] == 1


def test_words_that_are_no_navigation_message_are_refused():
    store = BroadcastStore()
    assert not store.add_lnav(1, [0] * 10)
    assert not store.add_lnav(1, [0x8B << 22] * 9)
    assert not store.add_inav(1, [0] * 8)
    store.update(1e9)
    assert len(store.ephemerides) == 0


def test_of_two_signals_of_a_band_the_one_with_a_code_is_taken_and_other_bands_are_left_out():
    pilot, data = {'sigId': 6, 'prMes': 2.1e7}, {'sigId': 7, 'prMes': 2.2e7}
    for cells, code in (((pilot, data), 2.1e7), ((pilot | {'prValid': 0}, data), 2.2e7)):
        (epoch,) = read(rawx(1.0, *cells))
        assert epoch.rows[:, 2:4].tolist() == [[5.0, code]]
    epoch = RawxReader((1,)).read(rawx(1.0, {}, data, {'sigId': 12})[6:-2])
    assert epoch.rows[:, 2].tolist() == [1.0]


def test_a_subframe_that_is_none_is_counted():
    words = {f'dwrd_{i:02d}': 0 for i in range(1, 11)}
    decoder = UbloxDecoder()
    for gnss, signal in ((0, 0), (2, 1), (6, 0), (0, 3)):
        fields = {'gnssId': gnss, 'svId': 7, 'sigId': signal, 'numWords': 10, 'version': 2} | words
        assert not list(decoder.feed(UBXMessage('RXM', 'RXM-SFRBX', GET, **fields).serialize()))
    # GLONASS and L2C carry no ephemeris that is used here.
    assert decoder.rejected == {'navigation message': 2}


@pytest.fixture(scope='module')
def spirent(recordings):
    folder = recordings / 'spirent_ubx'
    if not folder.is_dir():
        pytest.skip(f'no recording at {folder}')
    return folder


@pytest.fixture(scope='module')
def stream(spirent):
    return (spirent / 'f9p_static_15min.ubx').read_bytes()


@pytest.fixture(scope='module')
def reference(spirent):
    observations = read_observations(spirent / 'f9p_static_15min.obs', EVERYTHING)
    return {epoch.time: epoch.rows for epoch in observations.epochs}


def by_signal(rows):
    return {tuple(row[:3].astype(int)): row for row in rows}


def test_recorded_observations_are_those_of_the_rinex_file(stream, reference):
    reader = RawxReader(EVERYTHING)
    decoded = {}
    for frame in MessageCutter(Counter(), UBX).feed(stream):
        if frame[2:4] == b'\x02\x15':
            epoch = reader.read(frame[6:-2])
            if not isinstance(epoch, str) and len(epoch.rows):
                decoded[epoch.time] = epoch.rows
    times = np.array(sorted(decoded))
    compared = 0
    for time, rows in reference.items():
        nearest = times[np.argmin(abs(times - time))]
        assert abs(nearest - time) <= 51, 'epochs are printed to 100 ns'
        ours, theirs = by_signal(decoded[nearest]), by_signal(rows)
        assert set(theirs) <= set(ours)
        for key, row in theirs.items():
            measured = np.isfinite(row[3:7])
            error = abs(ours[key][3:7] - row[3:7])[measured]
            # Three decimals are printed, of C/N0 too; half of the last place and the rounding of a float64.
            assert (error <= 0.0005 + 1e-7).all(), (time, key, error)
            compared += int(measured.sum())
    assert compared > 50_000


@pytest.fixture(scope='module')
def decoded(stream):
    decoder = UbloxDecoder(EVERYTHING, utc=False)
    return decoder, [sample for sample in decoder.feed(stream) if isinstance(sample, GnssEpoch)]


def test_recorded_ephemerides_are_those_of_the_rinex_file(decoded, spirent):
    decoder, _ = decoded
    navigation = read_navigation(spirent / 'f9p_static_15min.nav')
    theirs = {(r[0], r[1], r[COLUMN['toe']]): r for r in navigation.ephemerides}
    ours = decoder.broadcast.ephemerides
    assert len(ours) >= 20
    for row in ours:
        other = theirs[row[0], row[1], row[COLUMN['toe']]]
        np.testing.assert_allclose(row, other, rtol=1e-11, atol=0.0)
    np.testing.assert_allclose(decoder.broadcast.klobuchar, navigation.klobuchar, rtol=2e-4)


def test_recorded_satellites_are_where_the_rinex_path_has_them(decoded, spirent):
    decoder, epochs = decoded
    navigation = read_navigation(spirent / 'f9p_static_15min.nav')
    observations = read_observations(spirent / 'f9p_static_15min.obs', EVERYTHING)
    # The file has issues that the stream brings too late or not at all.
    identity = [0, 1, COLUMN['toe']]
    received = {tuple(row) for row in decoder.broadcast.ephemerides[:, identity]}
    same = [row for row in navigation.ephemerides if tuple(row[identity]) in received]
    builder = EpochBuilder(np.array(same), navigation.klobuchar)
    ours = {round(epoch.stamp, -6): by_signal(epoch.rows) for epoch in epochs}
    compared = 0
    for raw in observations.epochs[-20:]:
        theirs = builder.build(raw)
        mine = ours[round(theirs.stamp, -6)]
        for key, row in by_signal(theirs.rows).items():
            if key in mine and np.isfinite(row[OBS['satellite_x']]):
                # 4 km/s times the 100 ns of a printed epoch, and the twelve digits of the printed elements.
                np.testing.assert_allclose(mine[key][9:12], row[9:12], rtol=0.0, atol=2e-3)
                np.testing.assert_allclose(mine[key][12:15], row[12:15], rtol=0.0, atol=1e-6)
                assert abs(mine[key][15] - row[15]) < 1e-14
                compared += 1
    assert compared > 300


def test_accuracies_are_those_of_the_interface_documents():
    # IS-GPS-200N 20.3.3.3.1.3 and OS SIS ICD table 91.
    assert [gps_accuracy(n) for n in (0, 1, 3, 6, 7, 14, 15)] == [2.0, 2.8, 5.7, 16.0, 32.0, 4096.0, 0.0]
    listed = {0: 0.0, 49: 0.49, 50: 0.5, 75: 1.0, 100: 2.0, 125: 6.0, 126: 0.0, 255: 0.0}
    assert {n: galileo_accuracy(n) for n in listed} == pytest.approx(listed)
