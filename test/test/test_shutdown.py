# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any time leaves no process and no shared-memory file, and exit code 0."""

from pathlib import Path

import pytest

from node_core.testing import Process, probe


def shared_memory():
    """Files of the middleware; liblttng keeps one of its own per user, made once and reused."""
    return {p.name for p in Path('/dev/shm').glob('*') if not p.name.startswith('lttng-ust-wait')}


@pytest.mark.parametrize(
    ('package', 'node'),
    [
        ('imu_kalman', 'angle_estimator'),
        ('imu_kalman', 'attitude_estimator'),
        ('imu_kalman', 'imu_simulator'),
    ],
)
def test_ctrl_c_ends_a_node_with_exit_code_0(package, node):
    before = shared_memory()
    with probe() as p, Process.node(package, node) as process:
        p.until(lambda: node in p.node.get_node_names(), f'node {node}', process=process)
        assert process.stop() == 0
        assert 'Traceback' not in process.output
    assert shared_memory() <= before


def test_ctrl_c_while_the_node_starts_is_clean(tmp_path):
    with Process.node('imu_kalman', 'attitude_estimator') as process:
        # Python is up and the imports of the node have begun once the mapping of numpy appears.
        maps = Path(f'/proc/{process.pid}/maps')
        while process.running and 'numpy' not in maps.read_text():
            pass
        assert process.stop() == 0
        assert 'Traceback' not in process.output


def test_ctrl_c_stops_the_player_and_leaves_a_whole_recording(bags, tmp_path):
    from bag_tools.bag import BagReader

    bag = bags / 'imu_hand_held.mcap'
    out = tmp_path / 'out.mcap'
    with probe() as p, Process.node('bag_tools', 'play', str(bag), '--wait-for', '/recorder') as player:
        with Process.node('bag_tools', 'record', str(out), '/imu/data_raw') as recorder:
            received = p.collect('sensor_msgs/msg/Imu', '/imu/data_raw')
            p.until(lambda: len(received) > 20, 'messages', process=player)
            assert player.stop() == 0
            assert recorder.stop() == 0
        with BagReader(out) as reader:
            assert reader.topics['/imu/data_raw'].count > 0
    assert not list(tmp_path.glob('.*partial'))
