# SPDX-License-Identifier: Apache-2.0
"""The `ros2 …` lines of the documents work, on a real Jazzy and with the stand-in alike."""

import subprocess

import pytest

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


def test_an_unknown_package_is_an_error():
    code, _, error = ros2('run', 'no_such_package', 'node')
    assert code != 0
    assert 'no_such_package' in error


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
    code, out, error = ros2('param', 'set', '/attitude_estimator', 'accel_noise', '-5.0')
    assert 'ailed' in out + error
    code, out, _ = ros2('topic', 'echo', '--once', '/diagnostics')
    assert code == 0
    assert 'attitude_estimator' in out
    code, out, _ = ros2('service', 'call', '/attitude_estimator/reset', 'std_srvs/srv/Trigger')
    assert code == 0
    assert 'success=True' in out
    assert process.stop() == 0
