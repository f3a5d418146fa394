# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes."""

import calendar
import math
import socket
import sys
import threading
from pathlib import Path

import can
import pytest

from ev_velocity.can_frames import CarOnCan
from ev_velocity.params import FusionParams, VelocityParams
from ev_velocity.sim_params import CanParams, GpsParams, SimulatorParams
from kalman_core.parameters import default_yaml
from node_core.messages import stamp_of
from node_core.testing import Process, probe, ros_arguments

TWIST = 'geometry_msgs/msg/TwistWithCovarianceStamped'
JOINTS = 'sensor_msgs/msg/JointState'
CONFIG = Path(__file__).parents[1] / 'config'
START = 1_767_225_600.0  # s
LONG = 600  # s: discovery on a loaded machine


def start(node, **params):
    code = f'from ev_velocity.nodes.{node} import main; main()'
    return Process([sys.executable, '-c', code, *ros_arguments(params)])


def nmea(body):
    checksum = 0
    for character in body:
        checksum ^= ord(character)
    return f'${body}*{checksum:02X}\r\n'.encode()


@pytest.fixture
def graph():
    with probe() as p:
        yield p


@pytest.mark.parametrize(
    ('node', 'cls'),
    [
        ('velocity_estimator', VelocityParams),
        ('fusion_estimator', FusionParams),
        ('vehicle_simulator', SimulatorParams),
        ('can_driver', CanParams),
        ('gps_driver', GpsParams),
    ],
)
def test_the_default_parameter_file_is_current(node, cls):
    assert (CONFIG / f'{node}.yaml').read_text() == default_yaml(cls, node)


def test_simulator_and_both_estimators_work_together_and_end_cleanly(graph):
    joint = graph.collect(TWIST, 'vehicle/velocity')
    fused = graph.collect(TWIST, 'fusion/velocity')
    slip = graph.collect(JOINTS, 'vehicle/slip')
    truth = graph.collect('geometry_msgs/msg/TwistStamped', 'truth/velocity')
    with (
        start('velocity_estimator') as velocity,
        start('fusion_estimator') as fusion,
        start('vehicle_simulator', scenario='good_road_10hz', seed=2, duration=30.0) as simulator,
    ):
        graph.until(
            lambda: len(joint) > 1500 and len(fused) > 1500 and len(slip) > 20,
            'estimates',
            timeout=60.0,
            process=simulator,
        )
        for process in (simulator, fusion, velocity):
            assert process.stop() == 0, process.output
    true = {stamp_of(m): m.twist.linear.x for m in truth}
    late = [m for m in joint if stamp_of(m) in true][-200:]
    assert len(late) > 100
    assert max(abs(m.twist.twist.linear.x - true[stamp_of(m)]) for m in late) < 0.3
    assert all(m.twist.covariance[0] > 0.0 and m.twist.covariance[7] > 0.0 for m in late)


def test_a_can_log_is_replayed_with_its_recorded_stamps(graph, tmp_path):
    path = tmp_path / 'drive.log'
    car = CarOnCan('virtual', 'test_nodes')
    with can.Logger(str(path)) as writer:
        for i in range(300):
            for message in car.frames(5.0, 0.2, 0.0):
                message.timestamp, message.channel = START + 0.02 * i, 0
                writer.on_message_received(message)
    car.close()
    wheels = graph.collect(JOINTS, 'wheel/states')
    speeds = graph.collect(TWIST, 'vehicle/speed')
    replay = {'replay_rate': 0.0, 'wait_for_subscribers': LONG, 'queue_depth': 1000}
    with start('can_driver', interface='log', channel=path, **replay) as process:
        graph.until_over(process)
        assert process.wait() == 0, process.output
    recorded = [round((START + 0.02 * i) * 1e6) * 1000 for i in range(300)]
    for messages in (wheels, speeds):
        # Two subscriptions may be found one after the other; from then on nothing is lost.
        assert [stamp_of(m) for m in messages] == recorded[-len(messages) :] != []
    assert list(wheels[-1].name) == ['wheel_1', 'wheel_2', 'wheel_3', 'wheel_4']
    assert list(wheels[-1].velocity) == pytest.approx([5.0 / 0.285] * 4, rel=0.01)
    assert speeds[-1].twist.twist.linear.x == pytest.approx(5.0, abs=0.01)


def test_a_bus_that_is_not_there_is_named(graph):
    diagnostics = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    with start('can_driver', interface='socketcan', channel='nocan7') as process:

        def named():
            return any('nocan7' in s.message and s.level == b'\x02' for d in diagnostics for s in d.status)

        graph.until(named, 'an error that names the bus', process=process)
        assert process.stop() == 0, process.output
        warnings = [line for line in process.output.splitlines() if 'WARN' in line and 'nocan7' in line]
        assert len(warnings) == 1, process.output


def test_gps_speeds_come_from_a_server_and_its_loss_is_named(graph):
    line = nmea('GPRMC,083559.50,A,4717.11437,N,00833.91522,E,10.0,90.0,091202,,,A')
    speeds = graph.collect(TWIST, 'gps/speed')
    diagnostics = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    enough = threading.Event()
    with socket.create_server(('127.0.0.1', 0)) as server:

        def serve():
            connection, _ = server.accept()
            with connection:
                while not enough.wait(0.02):
                    connection.sendall(line)

        thread = threading.Thread(target=serve)
        thread.start()
        source = f'tcp://127.0.0.1:{server.getsockname()[1]}'
        with start('gps_driver', source=source) as process:
            graph.until(lambda: len(speeds) > 10, 'speeds', process=process)
            enough.set()
            thread.join()
            server.close()

            def lost():
                return any(
                    s.level == b'\x02' and 'tcp://' in s.message for d in diagnostics for s in d.status
                )

            graph.until(lost, 'an error that names the source', process=process)
            assert process.stop() == 0, process.output
            assert f'{source}: closed by the server' in process.output
    linear = speeds[-1].twist.twist.linear
    assert math.hypot(linear.x, linear.y) == pytest.approx(10.0 * 1852.0 / 3600.0)
    assert speeds[-1].twist.covariance[0] == pytest.approx(0.01)


def test_a_recorded_drive_of_a_receiver_is_played_by_its_own_times(graph, tmp_path):
    path = tmp_path / 'drive.nmea'
    lines = [nmea(f'GPRMC,0835{i:02d}.00,A,4717.1,N,00833.9,E,{i}.0,90.0,091202,,,A') for i in range(60)]
    path.write_bytes(b''.join(lines))
    speeds = graph.collect(TWIST, 'gps/speed')
    with start('gps_driver', source=path, replay_rate=100.0, wait_for_subscribers=LONG) as process:
        graph.until_over(process)
        assert process.wait() == 0, process.output
    first = calendar.timegm((2002, 12, 9, 8, 35, 0))
    assert [stamp_of(m) for m in speeds] == [(first + i) * 10**9 for i in range(60)]
    assert speeds[-1].twist.twist.linear.x == pytest.approx(59.0 * 1852.0 / 3600.0)


@pytest.mark.parametrize(
    ('node', 'params', 'words'),
    [
        ('can_driver', {'interface': 'log', 'channel': '/nowhere/drive.log'}, '/nowhere/drive.log'),
        ('can_driver', {'dbc': '/nowhere/car.dbc'}, 'no such DBC'),
        ('gps_driver', {'source': 'tcp://nowhere'}, 'expected tcp://HOST:PORT'),
        ('gps_driver', {'source': '/nowhere/drive.nmea'}, "'source': /nowhere/drive.nmea"),
        ('vehicle_simulator', {'scenario': 'moon'}, 'plant_oil_patch'),
        ('velocity_estimator', {'gate': -1.0}, 'gate'),
    ],
)
def test_a_bad_parameter_is_one_line_and_exit_code_2(node, params, words):
    with start(node, **params) as process:
        assert process.wait() == 2
        lines = [line for line in process.output.splitlines() if line.strip()]
        assert len(lines) == 1
        assert words in lines[0]


def test_what_was_learned_outlives_the_node(graph, tmp_path):
    path = tmp_path / 'wheels.json'
    velocity = graph.collect(TWIST, 'vehicle/velocity')
    with (
        start('velocity_estimator', calibration_file=path) as process,
        start('vehicle_simulator', scenario='good_road_10hz', seed=2) as simulator,
    ):
        # GPS beside wheels above 4 m/s for some seconds tells the scale.
        graph.until(
            lambda: sum(m.twist.twist.linear.x > 4.0 for m in velocity[-3000:]) > 1000,
            'a drive',
            timeout=60.0,
            process=simulator,
        )
        simulator.stop()
        assert process.stop() == 0, process.output
    assert '"scale_sigma"' in path.read_text()
