# SPDX-License-Identifier: Apache-2.0
"""Order, pace and selection of the player, and when the recorder stops; no graph here."""

import math

import pytest
from bag_samples import IMU, SECOND, imu, write_sensors

from bag_tools import record
from bag_tools.bag import BagError, BagReader, BagWriter, jazzy, zeroed
from bag_tools.play import Pace, Playlist, clock_ticks, options_from


@pytest.fixture
def reader(tmp_path):
    write_sensors(tmp_path / 'bag', seconds=2.0)
    with BagReader(tmp_path / 'bag') as opened:
        yield opened


def playlist(reader, *argv):
    return Playlist(reader, options_from([str(reader.path), *argv]))


def test_everything_is_played_in_order_of_bag_time(reader):
    played = [(t, s) for t, s, _ in playlist(reader)]
    assert len(played) == reader.count
    assert [s for _, s in played] == sorted(s for _, s in played)
    assert played[:4] == [(t, SECOND) for t in ('/note', '/imu/data_raw', '/imu/mag', '/aux')]


def test_start_duration_and_topics_select(reader):
    stamps = [
        s for _, s, _ in playlist(reader, '--start', '0.5', '--duration', '0.2', '--topics', 'imu/data_raw')
    ]
    assert stamps == [SECOND + k * 10_000_000 for k in range(50, 70)]
    assert set(playlist(reader, '--exclude', '/note', 'aux').topics) == {'/imu/data_raw', '/imu/mag'}


def test_latched_messages_before_the_start_are_played_first(reader):
    assert playlist(reader).latched() == []
    ((topic, stamp, _),) = playlist(reader, '--start', '1').latched()
    assert (topic, stamp) == ('/note', SECOND)


def test_remaps_rename(reader):
    topics = playlist(reader, '--remap', 'imu/data_raw:=port/imu', '/note:=/memo').topics
    assert topics['/imu/data_raw'] == '/port/imu'
    assert topics['/note'] == '/memo'


@pytest.mark.parametrize(
    ('argv', 'words'),
    [
        (['--start', '5'], 'nothing to play; the bag has'),
        (['--topics', 'gps'], "no topic 'gps'"),
        (['--exclude', 'gps'], "no topic 'gps'"),
        (['--topics', 'aux', '--exclude', 'aux'], 'exclude each other'),
        (['--remap', 'a=b'], "--remap 'a=b' is malformed"),
        (['--depth', '0'], 'allowed: >= 1'),
    ],
)
def test_selections_that_cannot_work_are_named(reader, argv, words):
    with pytest.raises(BagError, match=words.replace('(', r'\(')):
        playlist(reader, *argv)


@pytest.mark.parametrize(
    'argv', ['--rate 0', '--rate nan', '--start -1', '--start inf', '--duration 0', '--clock -2']
)
def test_bad_numbers_exit_with_2(argv):
    with pytest.raises(SystemExit) as error:
        options_from(['bag', *argv.split()])
    assert error.value.code == 2


def test_pace_follows_the_rate_and_restarts_after_a_pause():
    pace = Pace(2.0)
    assert pace.due(SECOND) == -math.inf
    pace.restart(100.0, SECOND)
    assert pace.due(3 * SECOND) == pytest.approx(101.0)
    pace.restart(500.0, 3 * SECOND)
    assert pace.due(4 * SECOND) == pytest.approx(500.5)
    fast = Pace(math.inf)
    fast.restart(0.0, 0)
    assert fast.due(10**18) == -math.inf


def test_clock_ticks_are_even_in_bag_time():
    assert clock_ticks(None, SECOND, 10.0) == [SECOND]
    assert clock_ticks(SECOND, SECOND + 250_000_000, 10.0) == [SECOND + 100_000_000, SECOND + 200_000_000]
    assert clock_ticks(SECOND, SECOND + 1, 10.0) == []
    assert clock_ticks(SECOND, SECOND + 1, 0.0) == [SECOND + 1]
    assert clock_ticks(SECOND, SECOND, 0.0) == []


def test_header_stamps_are_read_from_the_bytes_in_either_byte_order():
    message = imu(7 * SECOND + 42, (1.0, 2.0, 3.0))
    for little in (True, False):
        data = bytes(jazzy().serialize_cdr(message, IMU, little_endian=little))
        assert record.header_stamp(data, 5) == 7 * SECOND + 42
    message.header.stamp.sec = -1
    assert record.header_stamp(bytes(jazzy().serialize_cdr(message, IMU)), 5) == 5


def test_only_types_with_a_header_have_a_header_stamp():
    assert record.has_header(IMU, jazzy())
    assert not record.has_header('std_msgs/msg/String', jazzy())


def test_recording_stops_by_count_idleness_or_duration():
    def rule(**options):
        return record.StopRule(record.RecordOptions('bag', **options), 10.0)

    by_count = rule(count=2)
    for now, done in ((11.0, False), (12.0, True)):
        by_count.received(now)
        assert by_count.done(now) is done
    idle = rule(idle=3.0)
    assert not idle.done(1e6)  # idleness counts from the first message
    idle.received(20.0)
    assert not idle.done(22.9)
    assert idle.done(23.0)
    assert rule(duration=5.0).done(15.0)
    assert not rule().done(1e9)


@pytest.mark.parametrize(
    ('argv', 'words'),
    [
        ([], 'name the topics to record, or give --all'),
        (['imu', '--all'], 'not both'),
        (['--all', '--lockstep'], '--lockstep needs the topics by name'),
        (['imu', '--idle', '0'], '--idle is 0, allowed: > 0'),
        (['imu', '--count', '0'], '--count is 0, allowed: >= 1'),
    ],
)
def test_bad_recordings_are_named(argv, words):
    with pytest.raises(BagError, match=words):
        record.options_from(['bag', *argv])


def test_a_bag_without_messages_cannot_be_played(tmp_path):
    with BagWriter(tmp_path / 'empty') as bag:
        bag.add('note', 'std_msgs/msg/String')
    with BagReader(tmp_path / 'empty') as opened, pytest.raises(BagError, match='nothing to play'):
        playlist(opened)


def test_one_message_can_be_played(tmp_path):
    with BagWriter(tmp_path / 'one') as bag:
        bag.add('note', 'std_msgs/msg/String')
        bag.write('/note', SECOND, zeroed('std_msgs/msg/String'))
    with BagReader(tmp_path / 'one') as opened:
        assert [(t, s) for t, s, _ in playlist(opened)] == [('/note', SECOND)]


def test_the_wait_for_topics_is_none_of_the_duration():
    rule = record.StopRule(record.RecordOptions('bag', duration=5.0), 0.0)
    rule.begin(8.0)
    assert not rule.done(12.9)
    assert rule.done(13.0)
