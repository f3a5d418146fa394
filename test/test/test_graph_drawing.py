# SPDX-License-Identifier: Apache-2.0
"""The drawing shows the whole graph: every node, topic, type and rate, loops included; nothing overlaps."""

import re

import pytest
from workspace_harness.graph import (
    NAMELESS,
    Graph,
    TopicEdge,
    Watch,
    replay_rates,
    seen_by,
    without_lockstep,
)
from workspace_harness.graph_svg import draw
from workspace_harness.replay import Estimator, cut, live
from workspace_harness.system import SYSTEMS

from bag_tools.bag import BagWriter, zeroed
from node_core.testing import Process, probe

IMU, JOINT = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/JointState'
LOOP = Graph(
    ('controller', 'filter', 'quad_simulator'),
    (
        TopicEdge('/imu/data', IMU, ('filter',), ('controller',), 200.0),
        TopicEdge('/imu/data_raw', IMU, ('quad_simulator',), ('filter',), 200.4),
        TopicEdge('/motors/command', JOINT, ('controller',), ('quad_simulator',)),
        TopicEdge('/slow', JOINT, ('filter',), (), 0.5),
    ),
)


def boxes(svg):
    found = re.findall(r'<rect class="g[nt]" x="(\S+)" y="(\S+)" width="(\S+)" height="(\S+)"', svg)
    return [tuple(map(float, box)) for box in found]


def test_every_name_type_and_rate_is_in_the_drawing():
    svg = draw(LOOP, 'a & b')
    for word in (
        'controller',
        'filter',
        'quad_simulator',
        'imu/data_raw',
        'Imu · 200 Hz',
        'JointState · silent',
    ):
        assert word in svg
    assert 'JointState · 0.5 Hz' in svg
    assert 'aria-label="a &amp; b"' in svg
    assert svg.count('class="ge"') == sum(len(t.publishers) + len(t.subscribers) for t in LOOP.topics)


def test_a_loop_begins_at_its_source():
    svg = draw(LOOP, '')
    left = {name: float(x) for x, name in re.findall(r'<text class="gx" x="(\S+)" [^>]*>([^<]+)<', svg)}
    assert left['quad_simulator'] < left['filter'] < left['controller'] < left['motors/command']


def test_boxes_do_not_overlap_and_lie_within_the_drawing():
    svg = draw(LOOP, '')
    width, height = map(float, re.search(r'viewBox="0 0 (\S+) (\S+)"', svg).groups())
    placed = boxes(svg)
    assert len(placed) == 7
    for i, (x, y, w, h) in enumerate(placed):
        assert x >= 0.0
        assert x + w <= width
        assert y + h <= height
        for u, v, other_w, other_h in placed[:i]:
            assert x + w <= u or u + other_w <= x or y + h <= v or v + other_h <= y


def test_what_lockstep_adds_is_left_out_and_nothing_else():
    edge = TopicEdge('/imu/data', IMU, ('filter',), ('player', 'recorder'))
    graph = without_lockstep(Graph(('filter', 'player', 'recorder'), (*LOOP.topics, edge)))
    assert graph.topics == (*LOOP.topics, TopicEdge('/imu/data', IMU, ('filter',), ('recorder',)))


def test_rates_are_per_second_of_the_played_bag(tmp_path):
    # Ten messages a second were played; the replay took a hundredth of the time.
    message = zeroed('std_msgs/msg/String')
    for name, step in (('played', 100_000_000), ('recorded', 1_000_000)):
        with BagWriter(tmp_path / f'{name}.mcap') as writer:
            writer.add(f'/{name}', 'std_msgs/msg/String')
            for i in range(101):
                writer.write(f'/{name}', 1 + i * step, message)
    rates = replay_rates(tmp_path / 'played.mcap', tmp_path / 'recorded.mcap')
    assert rates == {'/played': pytest.approx(10.1), '/recorded': pytest.approx(10.1)}


def test_what_is_drawn_is_what_runs():
    with probe() as p, Process.node('workspace_harness', 'system', 'imu_kalman') as process:
        watch = Watch(p)

        def connected():
            watch()
            ends = {t.name: (t.publishers, t.subscribers) for t in watch.graph.topics}
            return len(ends.get('/imu/data_raw', ((), ()))[1]) == 2

        p.until(connected, 'the graph of the system', process=process)
        assert set(SYSTEMS['imu_kalman']) <= set(watch.graph.nodes)
        topics = {t.name: t for t in watch.graph.topics}
        assert topics['/imu/data_raw'].publishers == ('imu_simulator',)
        assert topics['/imu/data_raw'].type == IMU
        assert '/diagnostics' not in topics
        rated = watch.graph.with_rates({'/imu/data_raw': 100.0})
        assert next(t.rate for t in rated.topics if t.name == '/imu/data_raw') == 100.0
        assert seen_by(p).nodes


def test_a_graph_is_whole_though_nodes_are_named_late_and_leave_early(monkeypatch):
    def edge(publishers, subscribers):
        return TopicEdge('/imu/data', IMU, publishers, subscribers)

    looks = [
        Graph(('player',), (edge(('player',), ()),)),
        Graph(('player',), (edge(('player',), (NAMELESS,)),)),
        Graph(('filter',), (edge((), ('filter',)),)),
    ]
    monkeypatch.setattr('workspace_harness.graph.seen_by', lambda _: looks.pop(0))
    with probe() as p:
        watch = Watch(p)
        assert [watch() for _ in range(3)] == [True, False, True]
    assert watch.graph == Graph(('filter', 'player'), (edge(('player',), ('filter',)),))


def test_the_player_of_a_short_replay_is_seen(bags, tmp_path):
    """It is over long before a node that has come late is known by name."""
    bag = cut(bags / 'imu_hand_held.mcap', 0.05, tmp_path / 'short.mcap')
    estimators = [Estimator('imu_kalman', 'attitude_estimator', 'attitude')]
    with probe('watch') as eye:
        watch = Watch(eye)
        live(bag, estimators, tmp_path / 'live.mcap', watch=watch)
    topics = {t.name: t for t in watch.graph.topics}
    assert topics['/imu/data_raw'].publishers == topics['/imu/mag'].publishers == ('player',)
    assert 'attitude_node' in topics['/imu/data_raw'].subscribers
