# SPDX-License-Identifier: Apache-2.0
"""The nodes start as processes, say what they should over DDS and end with code 0 on Ctrl-C."""

import os
import signal
import socket
import struct
import subprocess
import sys

import pytest

NODES = (
    'attitude_estimator',
    'roll_analysis',
    'alarm_monitor',
    'modbus_bridge',
    'nmea_bridge',
    'display',
    'ship_simulator',
    'hmc5883l_driver',
)


def start(node, *arguments, domain):
    code = f'from ship_inclinometer.nodes.{node} import main; main()'
    argv = [sys.executable, '-c', code, *arguments]
    environment = os.environ | {'ROS_DOMAIN_ID': str(domain), 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}
    return subprocess.Popen(argv, env=environment, stderr=subprocess.PIPE, text=True)


def free_port():
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def read_inputs(port):
    with socket.create_connection(('127.0.0.1', port), timeout=5.0) as connection:
        connection.sendall(struct.pack('>HHHBBHH', 1, 0, 6, 1, 4, 0, 10))
        answer = b''
        while len(answer) < 29:
            answer += connection.recv(64)
    return struct.unpack('>10H', answer[9:])


def test_a_simulated_ship_reaches_the_modbus_registers(tmp_path):
    domain, port = 1 + os.getpid() % 100, free_port()
    log = ('-p', f'event_log:={tmp_path}/events.db')
    settings = ('-p', f'settings_file:={tmp_path}/settings.json')
    nodes = [
        start('attitude_estimator', '--ros-args', '-p', 'align_time:=3.0', domain=domain),
        start('roll_analysis', domain=domain),
        start('alarm_monitor', '--ros-args', *log, domain=domain),
        start('modbus_bridge', '--ros-args', *log, *settings, '-p', f'tcp_port:={port}', domain=domain),
        start('ship_simulator', '--ros-args', '-p', 'gyro_bias:=0.0', '-p', 'duration:=120.0', domain=domain),
    ]
    try:
        deadline = 1500
        words = None
        for _ in range(deadline):
            try:
                words = read_inputs(port)
            except OSError:
                words = None
            if words and words[7] != 0x8000:
                break
            assert all(node.poll() is None for node in nodes)
            signal.sigtimedwait([], 0.2)
        assert words is not None
        assert words[7] != 0x8000, 'no roll after the waiting time'
        assert abs(struct.unpack('>h', struct.pack('>H', words[7]))[0]) < 4000
    finally:
        for node in nodes:
            node.send_signal(signal.SIGINT)
        codes = [node.wait(timeout=30) for node in nodes]
    assert codes == [0] * len(nodes)
    from ship_inclinometer.event_log import EventLog

    kinds = [(event.kind, event.who) for event in EventLog(tmp_path / 'events.db').events()]
    for who in ('alarm_monitor', 'modbus_bridge'):
        assert ('start', who) in kinds
        assert ('stop', who) in kinds


@pytest.mark.parametrize('node', NODES)
def test_an_unknown_parameter_ends_a_node_with_one_line_and_code_2(node):
    process = start(node, '--ros-args', '-p', 'no_such_thing:=1', domain=1 + os.getpid() % 100)
    _, error = process.communicate(timeout=90)
    assert process.returncode == 2
    assert error.count('\n') == 1
    assert 'no_such_thing' in error
