# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from ins_gps.dgps import DgpsBase
from ins_gps.doctor import check_gnss, check_imu, check_time, time_offset
from ins_gps.fixtures import FIXTURES
from ins_gps.observations import EpochBuilder
from ins_gps.params import BaseParams
from ins_gps.rinex import RinexError, read_navigation, read_observations
from ins_gps.samples import OBS, GnssEpoch, PositionSample
from ins_gps.simulation import STANDALONE, Scenario
from ins_gps.simulation_gnss import simulate
from kalman_core.earth import ecef_from_geodetic
from kalman_core.parameters import ParameterError

BASE = Scenario(trajectory='s_turns', duration=60.0, imu_rate=20.0)


def _degrees(origin):
    return (float(np.degrees(origin[0])), float(np.degrees(origin[1])), origin[2])


def _base_epochs(seed):
    scenario = replace(BASE, budget=replace(STANDALONE, white=False), duration=20.0, trajectory='constant')
    run = simulate(scenario, seed)
    return run, [GnssEpoch(e.stamp, e.rows) for e in run.epochs]


def test_corrections_cancel_what_base_and_rover_share():
    run, epochs = _base_epochs(1)
    base = DgpsBase(BaseParams(position=_degrees(BASE.origin), elevation_mask=0.0, position_limit=500.0))
    first = base.on_gnss(epochs[0])
    rows = epochs[0].rows
    site = BASE.origin
    from ins_gps.orbit import range_and_rate

    left = []
    for row, correction in zip(rows, first.rows[:, 2]):
        distance = range_and_rate(row[9:15], ecef_from_geodetic(*site), np.zeros(3), np.empty(3))[0]
        left.append(row[3] + 299_792_458.0 * row[15] + correction - distance)
    assert np.ptp(left) < 1e-6
    assert len(run.epochs) > 10


def test_a_wrong_base_position_is_detected_and_nothing_is_sent():
    _, epochs = _base_epochs(2)
    lat, lon, height = _degrees(BASE.origin)
    base = DgpsBase(BaseParams(position=(lat + 0.002, lon, height), elevation_mask=0.0))
    # A rover that stands: every epoch as seen at the start.
    still = [GnssEpoch(e.stamp, epochs[0].rows) for e in epochs]
    answers = [base.on_gnss(e) for e in still]
    assert answers[-1] is None
    assert base.diagnostics()['level'] == b'\x02'
    assert base.wrong_position == pytest.approx(222.0, rel=0.15)
    assert base.tally.sensor('base/observations').rejected['wrong base position'] > 5


def test_doctor_names_a_time_offset():
    run = simulate(replace(BASE, duration=120.0), 4)
    stamps = run.stamps[::20] + 1_000_000_000
    velocity = run.truth[::20, 3:6]
    offset, correlation = time_offset(run.stamps[1:], run.rate, stamps, velocity)
    assert offset == pytest.approx(1.0, abs=0.1)
    assert correlation > 0.9
    assert any(
        f.level == 'error' and 'late' in f.text
        for f in check_time(run.stamps[1:], run.rate, stamps, velocity)
    )
    fine = check_time(run.stamps[1:], run.rate, run.stamps[::20], velocity)
    assert all(f.level == 'info' for f in fine)


@pytest.mark.parametrize(
    ('rate', 'force', 'words'),
    [
        (1.0, 1.0 / 9.81, 'looks like g'),
        (57.3 * 300.0, 1.0, '°/s'),
        (0.05, 0.05, 'increments'),
        (1.0, -1.0, 'turned or its sign is inverted'),
        (1.0, 3.0, 'expected about 9.81'),
    ],
)
def test_doctor_names_wrong_units_and_axes(rate, force, words):
    run = simulate(replace(BASE, duration=30.0), 5)
    texts = [
        f.text for f in check_imu(run.stamps[1:], rate * run.rate, force * run.force) if f.level == 'error'
    ]
    assert any(words in text for text in texts)
    assert not [f for f in check_imu(run.stamps[1:], run.rate, run.force) if f.level != 'info']


def test_doctor_names_missing_ephemerides_and_few_satellites():
    run = simulate(replace(BASE, duration=10.0), 6)
    epochs = [GnssEpoch(e.stamp, e.rows.copy()) for e in run.epochs]
    for epoch in epochs:
        epoch.rows[1:, 9:17] = np.nan
    texts = ' '.join(f.text for f in check_gnss(epochs))
    assert 'no ephemeris for G02' in texts
    assert '5 are needed' in texts


def test_observation_files_of_both_versions_are_read(recordings):
    old = read_observations(recordings / 'rtklib_geonet_2005' / '07590920.05o')
    assert old.version == pytest.approx(2.1)
    first = old.epochs[0].rows
    assert first[0, :5].tolist() == [0.0, 3.0, 1.0, 24767686.375, 55923622.160]
    new = read_observations(recordings / 'gnss_imu_walk_60s' / 'walk_60s.obs', (1, 5))
    assert len(new.epochs) == 241
    assert new.epochs[0].rows[0, 3] == 20576396.770


def test_observations_agree_with_georinex(recordings):
    import warnings

    import georinex

    path = recordings / 'rtklib_geonet_2005' / '07590920.05o'
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        data = georinex.load(path)
    own = read_observations(path)
    for epoch, when in zip(own.epochs[:20], data['time'].values[:20]):
        there = data.sel(time=when)
        for row in epoch.rows:
            assert float(there['C1'].sel(sv=f'G{int(row[1]):02d}')) == row[3]
            assert float(there['L1'].sel(sv=f'G{int(row[1]):02d}')) == row[4]


def test_a_rinex_2_base_fixes_where_its_header_says(recordings):
    folder = recordings / 'rtklib_geonet_2005'
    navigation = read_navigation(folder / '07590920.05n')
    own = read_observations(folder / '07590920.05o')
    builder = EpochBuilder(navigation.ephemerides, navigation.klobuchar)
    for raw in own.epochs[:5]:
        builder.build(raw)
    assert np.linalg.norm(builder.position - own.position) < 60.0


def test_locks_grow_at_any_interval_and_start_anew_after_a_missed_epoch(recordings):
    folder = recordings / 'matrtklib_static'
    navigation = read_navigation(folder / 'base.nav')
    raws = read_observations(folder / 'rover.obs', (1,)).epochs[:40:2]
    builder = EpochBuilder(navigation.ephemerides, navigation.klobuchar, atmosphere=False)
    locks = [builder.build(raw).rows[:, OBS['lock_time']].max() for raw in raws]
    np.testing.assert_allclose(locks, 2.0 * np.arange(20))
    builder = EpochBuilder(navigation.ephemerides, navigation.klobuchar, atmosphere=False)
    for raw in [*raws[:10], *raws[11:12]]:
        last = builder.build(raw)
    assert last.rows[:, OBS['lock_time']].max() == 0.0


def test_a_bad_file_is_named(tmp_path):
    path = tmp_path / 'x.obs'
    path.write_text('not rinex\n')
    with pytest.raises(RinexError, match=r'x\.obs: expected a RINEX header'):
        read_observations(path)
    with pytest.raises(RinexError, match='no such file'):
        read_navigation(tmp_path / 'missing.nav')


def test_fixtures_are_small_and_deterministic(tmp_path):
    from bag_tools.bag import BagReader

    counts = []
    for attempt in ('a', 'b'):
        target = tmp_path / attempt
        FIXTURES['gnss_faults'](target)
        size = sum(p.stat().st_size for p in target.rglob('*') if p.is_file())
        assert size < 2_000_000
        with BagReader(target) as bag:
            counts.append({name: topic.count for name, topic in bag.topics.items()})
    assert counts[0] == counts[1]
    assert counts[0]['/gnss/observations'] == 121


def test_the_doctor_examines_a_bag(tmp_path):
    from ins_gps.examination import examine
    from ins_gps.fixtures import write_run

    shifted = simulate(replace(BASE, duration=60.0, gnss_offset=1.0), 4)
    write_run(tmp_path / 'bag', shifted)
    findings = examine(tmp_path / 'bag', '/imu/data_raw', '/gnss/observations')
    assert [f.check for f in findings if f.level == 'error'] == ['time']
    assert any('late' in f.text for f in findings)


def test_a_base_takes_its_position_from_a_topic_when_asked_to():
    _, epochs = _base_epochs(3)
    with pytest.raises(ParameterError, match="'position' is 0, 0, 0"):
        DgpsBase(BaseParams())
    base = DgpsBase(BaseParams(position_source='topic', elevation_mask=0.0, position_limit=500.0))
    assert base.on_gnss(epochs[0]) is None
    assert base.diagnostics()['message'] == 'waits for a position on base/position'
    base.on_position(PositionSample(epochs[0].stamp, np.array(BASE.origin), np.eye(3)))
    told = DgpsBase(BaseParams(position=_degrees(BASE.origin), elevation_mask=0.0, position_limit=500.0))
    for epoch in epochs[1:]:
        # The position is sent again and again: only one that moved starts the smoothing anew.
        base.on_position(PositionSample(epoch.stamp, np.array(BASE.origin), np.eye(3)))
        np.testing.assert_allclose(base.on_gnss(epoch).rows, told.on_gnss(epoch).rows, atol=1e-6)


@pytest.mark.parametrize('ahead', [11.0, 604_800.0])
def test_a_base_outlives_a_stamp_ahead_and_a_bag_that_starts_again(ahead):
    _, epochs = _base_epochs(3)
    base = DgpsBase(BaseParams(position=_degrees(BASE.origin), elevation_mask=0.0, position_limit=500.0))
    early = epochs[:5]
    early += [epochs[5]._replace(stamp=epochs[5].stamp + round((ahead + 20.0) * 1e9))]
    assert all(base.on_gnss(e) is not None for e in early)
    assert [base.on_gnss(e) is not None for e in epochs[6:20]] == [False] * 9 + [True] * 5
    assert [base.on_gnss(e) is not None for e in epochs] == [False] * 9 + [True] * (len(epochs) - 9)
    assert len(base.tally.restarts) == 2
    # The position is still the parameter's.
    np.testing.assert_allclose(base.position, ecef_from_geodetic(*BASE.origin))


def test_epochs_out_of_order_do_not_start_a_base_anew():
    _, epochs = _base_epochs(3)
    base = DgpsBase(BaseParams(position=_degrees(BASE.origin), elevation_mask=0.0, position_limit=500.0))
    for epoch in epochs:
        assert base.on_gnss(epoch) is not None
        assert base.on_gnss(epochs[0]) is None
    assert all(base.on_gnss(epochs[3]) is None for _ in range(30))
    assert not base.tally.restarts


def test_an_epoch_with_fewer_satellites_than_it_says_is_read(tmp_path):
    head = [f'{"3.04":>9}{"":11}{"OBSERVATION DATA":<20}{"M":<20}RINEX VERSION / TYPE']
    head += [f'{"G    2 C1C L1C":<60}SYS / # / OBS TYPES', f'{"":60}END OF HEADER']
    epochs = []
    for second, count, satellites in ((0, 2, (5, 7)), (1, 2, (7,)), (2, 1, (5,))):
        epochs.append(f'> 2023 01 08 10 05 {second:2d}.0000000  0{count:3d}')
        epochs += [f'G{s:02d}{2.2e7:14.3f}  {1.1e8:14.3f}  ' for s in satellites]
    path = tmp_path / 'cut.obs'
    path.write_text('\n'.join([*head, *epochs, '']))
    assert [len(epoch.rows) for epoch in read_observations(path).epochs] == [2, 1, 1]


def test_doctor_names_what_is_wrong_with_the_stamps_and_values_of_an_imu():
    run = simulate(replace(BASE, duration=30.0), 5)

    def said(stamps, rate=run.rate, force=run.force):
        return {f.check: f.text for f in check_imu(stamps, rate, force) if f.level != 'info'}

    stamps = run.stamps[1:]
    assert 'only 3 IMU samples' in said(stamps[:3], run.rate[:3], run.force[:3])['imu']
    assert 'do not increase' in said(np.full_like(stamps, 7))['imu stamps']
    back = stamps.copy()
    back[50] = back[40]
    assert '1 IMU stamps repeat or go back' in said(back)['imu stamps']
    late = stamps.copy()
    late[100:] += 2 * 10**9
    assert '1 gaps in the IMU, the longest 2.0' in said(late)['imu gaps']
    broken = run.rate.copy()
    broken[7, 1] = np.nan
    assert '1 IMU samples are not finite' in said(stamps, rate=broken)['imu values']


def test_doctor_tells_clocks_apart_and_says_when_it_cannot():
    run = simulate(replace(BASE, duration=120.0), 4)
    imu, gnss, velocity = run.stamps[1:], run.stamps[::20], run.truth[::20, 3:6]

    def text(shift=0, turned=run.rate, speed=velocity):
        return ' '.join(f.text for f in check_time(imu, turned, gnss + shift, speed))

    assert 'do not overlap' in text(10**12)
    assert '18 s' in ' '.join(
        f.text for f in check_time(imu[:100], run.rate[:100], imu[::20][:9] + 18 * 10**9, velocity[:9])
    )
    assert 'too few turns' in text(speed=np.tile([10.0, 0.0, 0.0], (len(velocity), 1)))
    noise = np.random.default_rng(1).standard_normal(run.rate.shape)
    assert 'do not match' in text(turned=noise)


def test_doctor_names_what_a_receiver_does_not_deliver():
    run = simulate(replace(BASE, duration=10.0), 6)
    assert 'only 1 GNSS epochs' in check_gnss(run.epochs[:1])[0].text
    epochs = [GnssEpoch(e.stamp, e.rows.copy()) for e in run.epochs]
    for epoch in epochs:
        epoch.rows[:, 4:6] = np.nan
    found = {f.check: f.level for f in check_gnss(epochs)}
    assert found['carrier'] == 'warning'
    assert found['doppler'] == 'info'


HEADER = """     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE
G    1 C1C                                                  SYS / # / OBS TYPES
                                                            END OF HEADER
"""


@pytest.mark.parametrize(
    ('text', 'word'),
    [
        ('', 'expected a RINEX header'),
        (HEADER.replace('OBSERVATION', 'NAVIGATION '), r'line 1: expected a RINEX 2-4 observation file'),
        (HEADER.replace('3.04', '1.00'), r'line 1: expected a RINEX 2-4'),
        (HEADER.split('\n', 1)[1], 'expected a RINEX header'),
        (HEADER + 'G01  20000000.000\n', 'line 4: expected an epoch record'),
        (HEADER + '> 2024 01 01 00 00  x.0000000  0  1\nG01  20000000.000\n', 'malformed'),
    ],
)
def test_what_is_no_observation_file_is_named(tmp_path, text, word):
    path = tmp_path / 'x.obs'
    path.write_text(text)
    with pytest.raises(RinexError, match=word):
        read_observations(path)


def test_an_observation_file_cut_off_within_an_epoch_keeps_those_before(tmp_path):
    path = tmp_path / 'x.obs'
    epoch = '> 2024 01 01 00 00  {}.0000000  0  2\nG01  20000000.000\nG02  21000000.000\n'
    event = '> 2024 01 01 00 00  3.0000000  4  1\n  a comment                          COMMENT\n'
    path.write_text(HEADER + epoch.format(1) + event + epoch.format(2).rsplit('G02', 1)[0])
    assert [len(e.rows) for e in read_observations(path).epochs] == [2]


def test_an_absent_or_foreign_navigation_file_is_named(tmp_path):
    with pytest.raises(RinexError, match=r'gone\.nav: no such file'):
        read_navigation(tmp_path / 'gone.nav')
    (tmp_path / 'x.nav').write_text('nonsense\n')
    with pytest.raises(RinexError, match=r'x\.nav'):
        read_navigation(tmp_path / 'x.nav')
