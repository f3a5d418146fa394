# SPDX-License-Identifier: Apache-2.0
"""The node base as a process: started, fed, broken, recovered, stopped."""

import signal
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from node_core.lockstep import QOS, TOPIC, parse
from node_core.testing import Process, probe

SCRIPT = Path(__file__).parent / 'echo_estimator.py'


def imu(seconds, rate):
    message = Imu()
    message.header.stamp.sec, fraction = divmod(round(seconds * 1e9), 10**9)
    message.header.stamp.nanosec = fraction
    message.angular_velocity.x = float(rate)
    return message


@pytest.fixture
def graph():
    with probe() as p, Process.script(SCRIPT) as process:
        yield p, process


def latest_status(arrays, name):
    for array in reversed(arrays):
        for status in array.status:
            if status.name == name:
                return status
    return None


def test_estimates_follow_measurements_and_ctrl_c_exits_with_zero(graph):
    p, process = graph
    received = p.collect('geometry_msgs/msg/Vector3Stamped', 'mean')
    publisher = p.publisher('sensor_msgs/msg/Imu', 'imu/data_raw', process=process)
    p.until(lambda: p.node.count_publishers('/mean'), 'the output', process=process)
    publisher.publish(imu(1.0, 2.0))
    publisher.publish(imu(2.0, 4.0))
    p.until(lambda: len(received) == 2, 'two estimates', process=process)
    assert [m.vector.x for m in received] == [1.0, 2.5]
    assert received[1].header.stamp.sec == 2
    assert process.stop() == 0


def test_sigterm_ends_the_node_cleanly_too(graph):
    p, process = graph
    p.wait_for_publisher('mean', process)
    process.send(signal.SIGTERM)
    assert process.wait() == 0


def test_diagnostics_name_stale_input_and_rejections_with_reason(graph):
    p, process = graph
    arrays = p.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    name = 'leak: imu/data_raw'
    p.until(lambda: latest_status(arrays, name), 'diagnostics', process=process)
    assert latest_status(arrays, name).level == DiagnosticStatus.ERROR
    assert latest_status(arrays, name).message == 'no message yet'

    publisher = p.publisher('sensor_msgs/msg/Imu', 'imu/data_raw', process=process)

    def rejected():
        publisher.publish(imu(1.0, float('nan')))
        status = latest_status(arrays, name)
        return status.level == DiagnosticStatus.WARN and status

    values = {v.key: v.value for v in p.until(rejected, 'a warning', process=process).values}
    assert int(values['rejected: rate not finite']) > 0
    assert values['accepted'] == '0'


def test_a_best_effort_driver_is_heard(graph):
    p, process = graph
    received = p.collect('geometry_msgs/msg/Vector3Stamped', 'mean')
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = p.publisher('sensor_msgs/msg/Imu', 'imu/data_raw', match=0, qos=qos)

    def heard():
        publisher.publish(imu(1.0, 1.0))
        return received

    p.until(heard, 'an estimate from best-effort input', process=process)


def test_reset_service_restarts_the_estimator(graph):
    p, process = graph
    received = p.collect('geometry_msgs/msg/Vector3Stamped', 'mean')
    publisher = p.publisher('sensor_msgs/msg/Imu', 'imu/data_raw', process=process)
    p.until(lambda: p.node.count_publishers('/mean'), 'the output', process=process)

    def answered():
        # What is sent before the node has matched this publisher is lost, and only the node knows when.
        publisher.publish(imu(1.0, 8.0))
        return received

    p.until(answered, 'an estimate', process=process)
    publisher.publish(imu(1.5, 8.0))
    p.until(lambda: received[-1].header.stamp.nanosec, 'the last of them', process=process)
    assert p.call('std_srvs/srv/Trigger', '/leak/reset').success
    publisher.publish(imu(2.0, 8.0))
    p.until(lambda: received[-1].header.stamp.sec == 2, 'another estimate', process=process)
    assert [m.vector.x for m in (received[0], received[-1])] == [4.0, 4.0]


def test_live_parameters_are_checked_against_their_range(graph):
    p, process = graph
    p.wait_for_publisher('mean', process)
    assert p.set_parameter('/leak', 'leak', 1).successful  # a whole number for a float
    refused = p.set_parameter('/leak', 'leak', 1.5)
    assert not refused.successful
    assert 'leak' in refused.reason
    assert not p.set_parameter('/leak', 'axis', 2).successful  # not live


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['-p', 'leak:=-1'], ("'leak'", '0 … 1')),
        (['-p', 'laek:=1.0'], ("'laek'", 'known: axis, leak')),
        (['--ros-args', '-p', 'axis:=7'], ("'axis'", '0 … 2')),
        (['-p', 'leak:=abc'], ("'leak'", 'float')),
        (['--params-file', '/does/not/exist.yaml'], ('/does/not/exist.yaml',)),
    ],
)
def test_bad_parameters_end_with_one_clear_line_and_exit_code_2(arguments, words):
    with Process.script(SCRIPT, *arguments) as process:
        assert process.wait() == 2
        assert all(word in process.output.splitlines()[-1] for word in words), process.output
        assert 'Traceback' not in process.output


def test_a_whole_number_in_yaml_is_taken_for_a_double(tmp_path):
    file = tmp_path / 'leak.yaml'
    file.write_text('leak:\n  ros__parameters:\n    leak: 1\n')
    with probe() as p, Process.script(SCRIPT, '--params-file', str(file)) as process:
        p.wait_for_publisher('mean', process)
        assert process.stop() == 0


def test_lockstep_acknowledges_after_processing():
    with probe() as p, Process.script(SCRIPT, params={'lockstep': True}) as process:
        lines = p.collect('std_msgs/msg/String', TOPIC, QOS)
        publisher = p.publisher('sensor_msgs/msg/Imu', 'imu/data_raw', process=process)
        p.until(lambda: p.node.count_publishers(TOPIC), 'the acknowledger', process=process)
        for i in range(3):
            publisher.publish(imu(1.0 + i, 1.0))
            p.until(lambda n=i: len(lines) == n + 1, 'progress', process=process)
        assert [parse(line.data) for line in lines] == [('/leak', '/imu/data_raw', n) for n in (1, 2, 3)]
