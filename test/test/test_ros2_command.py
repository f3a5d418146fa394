# SPDX-License-Identifier: Apache-2.0
"""The `ros2 …` lines of the documents work, on a real Jazzy and with the stand-in alike."""

import subprocess
import sys
from pathlib import Path

import pytest
from workspace_harness.make_bags import root

from node_core.testing import Process, probe


def ros2(*words, timeout=60.0):
    done = subprocess.run(['ros2', *words], capture_output=True, text=True, timeout=timeout, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture
def estimator():
    with (
        probe() as p,
        Process(['ros2', 'run', 'imu_kalman', 'attitude_estimator', '-p', 'lag_window:=0']) as process,
    ):
        p.wait_for_publisher('/imu/data', process)
        yield process


def test_executables_of_a_package_are_listed():
    code, out, _ = ros2('pkg', 'executables', 'imu_kalman')
    assert code == 0
    assert 'imu_kalman attitude_estimator' in out.splitlines()


_LATE_CTRL_C = """
import sys
from rclpy.impl.implementation_singleton import rclpy_implementation
from ros2_standin import __main__, topics

def verb(node, arguments):
    if arguments.verb == 'list':
        raise RuntimeError('of another kind')
    node.context.shutdown()  # as the signal's handler does, once rclpy has looked whether to go on
    rclpy_implementation.WaitSet(0, 0, 0, 0, 0, 0, node.context.handle)

topics.topic_hz = topics.topic_list = verb
sys.exit(__main__.main())
"""


def test_ctrl_c_between_two_waits_is_clean_and_other_errors_are_not_hidden():
    def stand_in(*words):
        return subprocess.run(
            [sys.executable, '-c', _LATE_CTRL_C, *words],
            cwd=root() / 'tools',
            capture_output=True,
            text=True,
            timeout=60.0,
        )

    ended = stand_in('topic', 'hz', 'imu/data')
    assert (ended.returncode, ended.stderr) == (0, '')
    failed = stand_in('topic', 'list')
    assert failed.returncode == 1
    assert 'of another kind' in failed.stderr


def test_an_unknown_package_is_an_error():
    code, _, error = ros2('run', 'no_such_package', 'node')
    assert code != 0
    assert 'no_such_package' in error


def test_what_is_not_there_is_said_in_the_words_of_ros2():
    for words in (('run', 'no_such_package', 'node'), ('pkg', 'executables', 'no_such_package')):
        code, out, error = ros2(*words)
        assert (code, out, error.strip()) == (1, '', "Package 'no_such_package' not found")
    code, out, error = ros2('run', 'imu_kalman', 'no_such_node')
    assert (code, out, error.strip()) == (1, '', 'No executable found')


def test_a_missing_parameter_file_is_one_line():
    code, out, error = ros2('run', 'imu_kalman', 'attitude_estimator', '--params-file', 'gone.yaml')
    assert (code, out) == (2, '')
    assert error == "attitude_estimator: parameter file 'gone.yaml' cannot be read; expected a YAML file\n"


def test_ctrl_c_while_the_graph_is_being_discovered_is_clean():
    with Process(['ros2', 'topic', 'list']) as process:
        # Discovery begins when the middleware is loaded and its socket is open.
        maps = Path(f'/proc/{process.pid}/maps')
        while process.running and 'libfastrtps' not in maps.read_text():
            pass
        process.stop()
        assert 'Traceback' not in process.output


def test_a_bad_parameter_names_itself_and_the_range():
    code, out, error = ros2('run', 'imu_kalman', 'attitude_estimator', '-p', 'accel_noise:=-1')
    assert code == 2
    assert 'accel_noise' in error + out
    assert '…' in error + out


def test_a_running_node_can_be_looked_into_and_changed(estimator):
    process = estimator
    assert '/attitude_estimator' in ros2('node', 'list')[1].split()
    assert '/imu/data' in ros2('topic', 'list')[1].split()
    assert 'lag_window' in ros2('param', 'list', '/attitude_estimator')[1]
    code, out, _ = ros2('param', 'get', '/attitude_estimator', 'lag_window')
    assert (code, out.strip()) == (0, 'Double value is: 0.0')
    code, out, error = ros2('param', 'get', '/attitude_estimator', 'no_such_parameter')
    assert 'Parameter not set' in out + error
    code, out, error = ros2('param', 'set', '/attitude_estimator', 'accel_noise', '-5.0')
    assert 'ailed' in out + error
    described = ros2('param', 'describe', '/attitude_estimator', 'motion_memory', 'accel_noise')[1]
    assert 'Min value: 0.05' in described
    assert 'e+308' not in described
    code, out, _ = ros2('topic', 'echo', '--once', '/diagnostics')
    assert code == 0
    assert 'attitude_estimator' in out
    services = ros2('service', 'list')[1].split()
    assert '/attitude_estimator/reset' in services
    assert not [name for name in services if '_ros2cli' in name]
    code, out, _ = ros2('service', 'call', '/attitude_estimator/reset', 'std_srvs/srv/Trigger')
    assert code == 0
    assert 'success=True' in out
    assert process.stop() == 0
