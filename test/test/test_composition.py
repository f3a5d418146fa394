# SPDX-License-Identifier: Apache-2.0
"""Nodes composed in one process say what they say as processes of their own."""

import subprocess

import pytest
from workspace_harness.replay import Estimator, cut, differences, live, offline_all
from workspace_harness.system import SYSTEMS

from node_core.testing import Process, executable, probe

ESTIMATORS = [
    Estimator('imu_kalman', 'angle_estimator', 'angle'),
    Estimator('imu_kalman', 'attitude_estimator', 'attitude', {'settled_output': True}),
]


def test_one_process_equals_the_offline_runner_to_the_last_bit(bags, tmp_path):
    bag = cut(bags / 'imu_hand_held.mcap', 4.0, tmp_path / 'in.mcap')
    live(bag, ESTIMATORS, tmp_path / 'composed.mcap', composed=True)
    results = offline_all(bag, ESTIMATORS, tmp_path)
    assert all(sum(r.outputs.values()) > 0 for r in results.values())
    assert differences(tmp_path / 'composed.mcap', tmp_path, ESTIMATORS) == []


@pytest.mark.parametrize('system', sorted(SYSTEMS))
def test_a_system_runs_in_one_process_and_ends_cleanly(system):
    with probe() as p, Process.node('workspace_harness', 'system', system) as process:
        p.until(lambda: set(SYSTEMS[system]) <= set(p.node.get_node_names()), 'all nodes', process=process)
        said = p.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
        p.until(lambda: said, 'diagnostics', process=process)
        assert process.stop() == 0
        assert 'Traceback' not in process.output


@pytest.mark.parametrize(
    ('words', 'named'),
    [
        ((), 'PACKAGE/NODE'),
        (('imu_kalman',), "'imu_kalman' is no PACKAGE/NODE"),
        (('imu_kalman/nope',), "package 'imu_kalman' has no node 'nope'"),
        (('ins_gps/input_doctor',), "'ins_gps/input_doctor' cannot be composed"),
    ],
)
def test_what_cannot_be_composed_is_named(words, named):
    done = subprocess.run(
        [executable('node_core', 'compose'), *words], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2
    assert named in done.stderr
    assert 'Traceback' not in done.stderr
