# SPDX-License-Identifier: Apache-2.0
"""Player and recorder as processes in a live graph. Every wait is for a condition, nothing sleeps."""

import signal
import sys
from pathlib import Path

import pytest
from bag_samples import CHAIN, MIX, SECOND, write_sensors
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from bag_tools.bag import BagReader
from bag_tools.content import compare
from bag_tools.offline import offline
from node_core.testing import Process, probe, ros_arguments

NODE = Path(__file__).with_name('order_node.py')
IMU, MAG, STRING = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/MagneticField', 'std_msgs/msg/String'


def tool(name, bag, args, ros):
    module = f'bag_tools.nodes.{name}'
    return Process([sys.executable, '-m', module, str(bag), *map(str, args), *ros_arguments(**ros)])


def play(bag, *args, **ros):
    return tool('play', bag, args, ros)


def record(bag, *args, **ros):
    return tool('record', bag, args, ros)


def estimator(name, **params):
    return Process([sys.executable, str(NODE), name, *ros_arguments({'lockstep': True, **params})])


def ended(process, code=0):
    assert process.wait() == code, process.output
    return process.output


@pytest.fixture
def bag(tmp_path):
    return write_sensors(tmp_path / 'in.mcap', seconds=1.0)


def test_what_is_played_can_be_recorded_without_a_bit_lost(bag, tmp_path):
    with BagReader(bag) as reader:
        topics, count = sorted(reader.topics), reader.count
    out = tmp_path / 'out'
    with record(out, *topics, '--count', count, '--stamp', 'header', '--compression', 'zstd') as recorder:
        # The recorder subscribes once it sees the publishers: the player waits for all four topics.
        with play(bag, '--fast', '--wait-for', *topics) as player:
            assert f'played {count} messages' in ended(player)
        ended(recorder)
    assert all(r.equal for r in compare(bag, out))
    with BagReader(out) as reader:
        assert reader.topics['/note'].latched
        assert [s for _, s, _ in reader.messages(['/imu/mag'])][:2] == [SECOND, SECOND + 40_000_000]


@pytest.mark.parametrize('pace', [['--fast'], ['--rate', '5']], ids='-'.join)
def test_lock_step_gives_what_offline_gives_at_any_rate(bag, tmp_path, pace):
    with estimator('mix') as node, record(tmp_path / 'live', 'mixture', 'slow', '--lockstep') as recorder:
        with play(bag, *pace, '--lockstep', '--wait-for', '/mix', '/recorder') as player:
            ended(player)
        assert recorder.stop() == 0, recorder.output
        assert node.stop() == 0
    offline(MIX, {}, bag, tmp_path / 'offline')
    results = compare(tmp_path / 'live', tmp_path / 'offline')
    assert [(r.topic, r.count_a) for r in results] == [('/mixture', 125), ('/slow', 25)]
    assert all(r.equal for r in results), results


def test_lock_step_reaches_through_a_chain_of_nodes(bag, tmp_path):
    with estimator('mix') as first, estimator('chain') as second:
        with record(tmp_path / 'live', 'chained', 'chained_slow', '--lockstep') as recorder:
            nodes = ['/mix', '/chain', '/recorder']
            with play(bag, '--fast', '--lockstep', '--wait-for', *nodes) as player:
                ended(player)
            assert recorder.stop() == 0, recorder.output
        assert (first.stop(), second.stop()) == (0, 0)
    offline(MIX, {}, bag, tmp_path / 'first', copy=['aux'])
    offline(CHAIN, {}, tmp_path / 'first', tmp_path / 'offline')
    results = compare(tmp_path / 'live', tmp_path / 'offline')
    assert [(r.topic, r.count_a) for r in results] == [('/chained', 135), ('/chained_slow', 10)]
    assert all(r.equal for r in results), results


def test_a_node_that_hangs_is_named(bag):
    with probe() as p, estimator('mix') as node:
        arguments = ('--lockstep', '--loop', '--wait-for', '/mix', '--step-timeout', '2', '--rate', '0.5')
        with play(bag, *arguments) as player:
            received = p.collect('geometry_msgs/msg/Vector3Stamped', 'mixture')
            p.until(lambda: received, 'the first output', process=player)
            node.send(signal.SIGSTOP)
            output = ended(player, 2)
    assert "lock-step: node '/mix' has not processed a message of '/imu/" in output
    assert output.strip().count('\n') == 0


def test_remaps_clock_and_selection_reach_the_graph(bag):
    with probe() as p:
        renamed, clock = p.collect(IMU, 'port/imu'), p.collect('rosgraph_msgs/msg/Clock', '/clock')
        other = p.collect(MAG, 'imu/mag')
        args = ['--fast', '--clock', '10', '--topics', 'imu/data_raw', 'note', '-m', 'imu/data_raw:=port/imu']
        with play(bag, *args, remaps={'note': 'memo'}) as player:
            p.until(lambda: len(renamed) == 100, '100 messages', process=None)
            ended(player)
        ticks = [m.clock.sec * SECOND + m.clock.nanosec for m in clock]
        assert ticks
        assert all((t - SECOND) % 100_000_000 == 0 for t in ticks)
        assert ticks == sorted(ticks)
        stamps = [m.header.stamp.nanosec for m in renamed]
        assert stamps == sorted(stamps)
        assert other == []


def test_pause_step_and_resume(bag):
    with probe() as p:
        received = p.collect(IMU, 'imu/data_raw')
        with play(bag, '--fast', '--start-paused', '--topics', 'imu/data_raw') as player:
            assert p.call('std_srvs/srv/Trigger', '/player/step').success
            p.until(lambda: len(received) == 1, 'one message', process=player)
            assert p.call('std_srvs/srv/Trigger', '/player/step').success
            p.until(lambda: len(received) == 2, 'a second message', process=player)
            assert p.call('std_srvs/srv/Trigger', '/player/pause').success
            assert len(received) == 2
            assert p.call('std_srvs/srv/Trigger', '/player/resume').success
            p.until(lambda: len(received) == 100, 'all messages')
            ended(player)


def test_a_loop_goes_on_until_ctrl_c(bag):
    with probe() as p:
        received = p.collect(MAG, 'imu/mag')
        with play(bag, '--loop', '--rate', '20', '--topics', 'imu/mag') as player:
            p.until(lambda: len(received) > 60, 'two loops and more', process=player)
            assert player.stop() == 0, player.output
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in received]
    assert stamps[:25] == stamps[25:50]


def test_a_player_can_be_stopped_while_it_waits_or_pauses_or_steps(bag):
    with play(bag) as waiting, probe() as p:
        p.until(lambda: p.node.count_publishers('/imu/mag'), 'the player', process=waiting)
        waiting.send(signal.SIGINT)
        assert waiting.wait() == 0, waiting.output
        with play(bag, '--start-paused', '--no-wait') as paused:
            assert p.call('std_srvs/srv/Trigger', '/player/step').success
            paused.send(signal.SIGTERM)
            assert paused.wait() == 0, paused.output
        received = p.collect('geometry_msgs/msg/Vector3Stamped', 'mixture')
        with (
            estimator('mix') as node,
            play(bag, '--lockstep', '--loop', '--fast', '--wait-for', '/mix') as player,
        ):
            p.until(lambda: len(received) > 50, 'outputs', process=player)
            player.send(signal.SIGINT)
            assert player.wait() == 0, player.output
            assert node.stop() == 0


def test_ctrl_c_finishes_the_recording(bag, tmp_path):
    out = tmp_path / 'out.db3'
    with probe() as p, record(out, 'imu/data_raw', params={'use_sim_time': False}) as recorder:
        publisher = p.publisher(IMU, 'imu/data_raw', process=recorder)
        for _ in range(20):
            publisher.publish(Imu())
        assert publisher.wait_for_all_acked()
        assert recorder.stop() == 0, recorder.output
    with BagReader(out) as reader:
        assert reader.topics['/imu/data_raw'].count == 20
        assert reader.start > 1_600_000_000 * SECOND  # received now, by the system's clock


def test_simulated_time_stamps_the_recording(tmp_path):
    arguments = ('a', '--count', '20')
    with probe() as p, record(tmp_path / 'out', *arguments, params={'use_sim_time': True}) as recorder:
        note = p.publisher(STRING, 'a', process=recorder)
        clock = p.publisher('rosgraph_msgs/msg/Clock', '/clock', process=recorder)
        tick = Clock()
        tick.clock.sec = 77

        def said():
            # /clock is read as best effort: the first ticks may be lost.
            clock.publish(tick)
            note.publish(String(data='x'))
            return not recorder.running

        p.until(said, 'the end of the recording')
        ended(recorder)
    with BagReader(tmp_path / 'out') as reader:
        stamps = [s for _, s, _ in reader.messages()]
    assert set(stamps) <= {0, 77 * SECOND}
    assert stamps[-1] == 77 * SECOND


def test_all_topics_are_found_as_they_appear(tmp_path):
    out = tmp_path / 'out'
    with probe() as p, record(out, '--all') as recorder:
        for name in ('first', 'second'):
            publisher = p.publisher(STRING, name, process=recorder)
            publisher.publish(String(data=name))
            assert publisher.wait_for_all_acked()
        assert recorder.stop() == 0
    with BagReader(out) as reader:
        assert (reader.topics['/first'].count, reader.topics['/second'].count) == (1, 1)


def test_idleness_ends_the_recording(tmp_path):
    with probe() as p, record(tmp_path / 'out', 'a', '--idle', '0.3') as recorder:
        p.publisher(STRING, 'a', process=recorder).publish(String(data='x'))
        assert 'recorded 1 messages' in ended(recorder)


def test_a_killed_recorder_leaves_nothing_that_looks_whole(tmp_path):
    with probe() as p, record(tmp_path / 'out', 'imu/data_raw') as recorder:
        p.publisher(IMU, 'imu/data_raw', process=recorder).publish(Imu())
        recorder.send(signal.SIGKILL)
        recorder.wait()
    assert not (tmp_path / 'out').exists()
    assert [f.name.endswith('.partial') for f in tmp_path.iterdir()] == [True]


def test_nobody_listening_and_nobody_publishing_are_errors(bag, tmp_path):
    with play(bag, '--wait-timeout', '0.5') as player:
        assert 'no subscriber within 0.5 s: nobody subscribes to' in ended(player, 2)
    with play(bag, '--wait-timeout', '0.5', '--lockstep') as player:
        assert 'within 0.5 s' in ended(player, 2)
    with play(tmp_path / 'absent') as player:
        assert ended(player, 2).startswith('play: ')
    with record(tmp_path / 'out', 'nowhere', '--wait-timeout', '0.5') as recorder:
        assert "nobody publishes '/nowhere' within 0.5 s" in ended(recorder, 2)
    assert [f.name for f in tmp_path.iterdir()] == ['in.mcap']
