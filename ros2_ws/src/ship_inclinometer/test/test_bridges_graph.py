# SPDX-License-Identifier: Apache-2.0
"""The bridges as processes: a node that falls silent, a cable that is pulled out."""

import json
import math
import shutil
import socket
import struct
import time
import urllib.request

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from serial_cable import Cable

from node_core.message_types import message_class
from node_core.node import reliable
from node_core.testing import Process, probe
from ship_inclinometer import modbus_map as m
from ship_inclinometer.codec import (
    IMU,
    ROLL_NAMES,
    VALUES,
    VECTOR,
    encode_angles,
    encode_attitude,
    encode_numbers,
    encode_validity,
)
from ship_inclinometer.roll_analysis import NO_ROLL
from ship_inclinometer.samples import VALID, Angles, Attitude, Validity

ROLLING = dict.fromkeys(ROLL_NAMES, 0.1) | {'status': 0.0, 'roll_period': 12.0, 'peak_age': 60.0}


def free_port():
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        return listener.getsockname()[1]


class Talkers:
    """What an attitude estimator, a roll analysis and an alarm monitor would say."""

    def __init__(self, p, listeners, attitude='imu/data'):
        self.p = p
        self.silent = set()
        self.rolling = ROLLING
        kind = IMU if attitude == 'imu/data' else VECTOR
        kinds = {attitude: kind, 'ship/validity': VALUES, 'ship/roll': VALUES, 'ship/alarms': VALUES}
        self.messages = {t: message_class(kind)() for t, kind in kinds.items()}
        matches = {t: listeners for t in kinds if t != 'ship/alarms' or attitude == 'imu/data'}
        # Latched suits every subscriber.
        qos = reliable(10, latched=True)
        self.topics = {t: p.publisher(kinds[t], t, match=n, qos=qos) for t, n in matches.items()}

    def talk(self):
        now, messages, zeros = time.time_ns(), self.messages, (0.0,) * 3
        if 'imu/data' in messages:
            attitude = Attitude(now, '', (1.0, 0.0, 0.0, 0.0), zeros, zeros, 1e-6 * np.eye(3), VALID)
            encode_attitude(attitude, messages['imu/data'])
        else:
            encode_angles(Angles(now, '', zeros, zeros, zeros, VALID), messages['ship/attitude'])
        encode_validity(Validity(now, VALID, '', True, (0.001,) * 3), messages['ship/validity'])
        encode_numbers(messages['ship/roll'], now, self.rolling)
        encode_numbers(messages['ship/alarms'], now, {'heel_alarm': 1.0, 'alarm_active': 1.0})
        for topic, publisher in self.topics.items():
            if topic not in self.silent:
                publisher.publish(messages[topic])

    def until(self, condition, what, process):
        def talking():
            self.talk()
            return condition()

        return self.p.until(talking, what, process=process)


def read(port, function, address, count):
    with socket.create_connection(('127.0.0.1', port), timeout=30.0) as connection:
        connection.sendall(struct.pack('>HHHBBHH', 1, 0, 6, 1, function, address, count))
        head = connection.recv(9, socket.MSG_WAITALL)
        return connection.recv(head[8], socket.MSG_WAITALL)


def registers(port):
    words = struct.unpack(f'>{m.INPUT_COUNT}H', read(port, 4, 0, m.INPUT_COUNT))
    bits = int.from_bytes(read(port, 2, 0, len(m.DISCRETE)), 'little')
    told = {name: words[address] for name, address in m.INPUT_ADDRESS.items()}
    return told | {f'bit {name}': bits >> i & 1 for i, name in enumerate(m.DISCRETE)}


def test_what_a_silent_node_said_last_leaves_registers_and_display(tmp_path):
    page, port = free_port(), free_port()
    log = {'event_log': str(tmp_path / 'events.db')}
    modbus = {**log, 'tcp_port': port, 'settings_file': str(tmp_path / 'settings.json')}

    def state():
        with urllib.request.urlopen(f'http://127.0.0.1:{page}/state', timeout=30.0) as reply:
            return json.load(reply)

    with (
        Process.node('ship_inclinometer', 'display', params={**log, 'port': page}) as display,
        Process.node('ship_inclinometer', 'modbus_bridge', params=modbus) as bridge,
        probe() as p,
    ):
        talkers = Talkers(p, 2)

        def all_known():
            told, shown = registers(port), state()
            unknown = told['bit roll_unknown'] or told['bit alarms_unknown'] or not told['bit valid']
            return shown['roll_known'] and shown['alarms_known'] and not unknown and told

        told = talkers.until(all_known, 'attitude, roll and alarms', bridge)
        assert told['roll_period'] == 1200
        assert told['bit heel_alarm'] == 1
        shown = state()
        assert shown['period'] == 12.0
        assert shown['alarms']['heel_alarm'] == 1.0

        talkers.silent = {'ship/roll', 'ship/alarms'}
        talkers.until(lambda: not state()['roll_known'] and not state()['alarms_known'], 'silence', display)
        talkers.until(
            lambda: registers(port)['bit roll_unknown'] and registers(port)['bit alarms_unknown'],
            'silence in the registers',
            bridge,
        )
        told, shown = registers(port), state()
        assert (told['roll_period'], told['amplitude_port']) == (m.UNKNOWN_UINT16, m.UNKNOWN_UINT16)
        assert (told['bit heel_alarm'], told['bit rolling']) == (0, 0)
        assert told['status_more'] == 3
        assert [shown[n] for n in ('period', 'amplitude_port', 'peak_starboard')] == [None] * 3
        assert shown['alarms'] == {}

        talkers.silent = set()
        talkers.until(all_known, 'both again', bridge)
        talkers.silent = {'imu/data'}
        talkers.until(lambda: state()['validity'] == 2, 'no attitude', display)
        assert [state()[n] for n in ('roll', 'pitch', 'heading', 'sigma')] == [None] * 4
        assert (display.stop(), bridge.stop()) == (0, 0)


def test_the_alarm_monitor_says_what_it_cannot_judge_and_the_roll_alarm_ends_with_the_rolling(tmp_path):
    log = tmp_path / 'log' / 'events.db'
    limits = {'event_log': str(log), 'roll_alarm': 5.0, 'alarm_delay': 0.2}
    with Process.node('ship_inclinometer', 'alarm_monitor', params=limits) as monitor, probe() as p:
        diagnostics = p.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
        alarms = p.collect('sensor_msgs/msg/JointState', 'ship/alarms')
        talkers = Talkers(p, 1, 'ship/attitude')

        def said(level, text):
            statuses = [s for array in diagnostics for s in array.status if s.name == 'alarm_monitor']
            diagnostics.clear()
            return any(s.level == level and text in s.message for s in statuses)

        def active(name):
            return bool(alarms) and dict(zip(alarms[-1].name, alarms[-1].position))[name] == 1.0

        assert p.set_parameter('alarm_monitor', 'hysteresis', 6.0).successful is False
        talkers.until(lambda: said(DiagnosticStatus.OK, 'ok'), 'all is well', monitor)
        talkers.until(lambda: active('roll_alarm'), 'the roll alarm', monitor)
        talkers.rolling = dict.fromkeys(ROLL_NAMES, math.nan) | {'status': float(NO_ROLL)}
        talkers.until(lambda: not active('roll_alarm'), 'its end', monitor)
        talkers.silent = {'ship/roll'}
        talkers.until(lambda: said(DiagnosticStatus.WARN, 'no roll analysis'), 'no roll', monitor)
        talkers.until(lambda: active('sensor_alarm'), 'the alarm for it', monitor)
        # A log that cannot be written, and an alarm all the same.
        talkers.silent = {'ship/roll', 'ship/attitude'}
        shutil.rmtree(log.parent)
        p.call('std_srvs/srv/Trigger', 'alarm_monitor/silence')
        talkers.until(lambda: said(DiagnosticStatus.ERROR, 'events.db'), 'the log', monitor)
        assert active('sensor_alarm')


def test_nmea_goes_on_over_a_cable_while_the_network_is_out_and_after_the_cable_was(tmp_path):
    cable = Cable(tmp_path)
    nowhere = {'udp_host': 'no-such-host.invalid', 'serial': cable.link, 'baudrate': 4800}
    with (
        Process.node('ship_inclinometer', 'nmea_bridge', params=nowhere) as bridge,
        probe() as p,
    ):
        diagnostics = p.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')

        def said(name, level, text):
            statuses = [s for array in diagnostics for s in array.status if s.name.endswith(name)]
            diagnostics.clear()
            return any(s.level == level and text in s.message for s in statuses)

        p.until(lambda: b'$IIHRM' in cable.read(), 'sentences', process=bridge)
        p.until(lambda: said('UDP', DiagnosticStatus.ERROR, 'no-such-host'), 'no network', process=bridge)
        # Drained, so that the line carries on: 4800 baud do not hold ten rounds a second.
        p.until(
            lambda: cable.read() and said('serial line', DiagnosticStatus.WARN, 'too slow'),
            'a slow line',
            process=bridge,
        )
        cable.unplug()
        p.until(lambda: said('serial line', DiagnosticStatus.ERROR, 'tty'), 'no cable', process=bridge)
        cable.plug()
        p.until(lambda: b'$IIHRM' in cable.read(), 'sentences again', process=bridge)
        assert bridge.stop() == 0
    cable.unplug()


def test_the_magnetometer_is_read_at_its_rate():
    with (
        Process.node('ship_inclinometer', 'hmc5883l_driver', params={'bus': 'fake', 'rate': 20.0}) as driver,
        probe() as p,
    ):
        readings = p.collect('sensor_msgs/msg/MagneticField', 'imu/mag')
        p.until(lambda: len(readings) > 40, 'readings', process=driver)
        stamps = [r.header.stamp.sec + 1e-9 * r.header.stamp.nanosec for r in readings[-40:]]
        # A machine that is busy may be late, but never early.
        assert (stamps[-1] - stamps[0]) / 39 > 0.95 / 20.0
        assert driver.stop() == 0
