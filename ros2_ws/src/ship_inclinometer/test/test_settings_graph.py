# SPDX-License-Identifier: Apache-2.0
"""Settings come from parameters and from Modbus: neither may undo the other unasked."""

from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

from node_core.testing import Process, probe
from ship_inclinometer.event_log import EventLog


def told(path):
    log = EventLog(path)
    try:
        return [(e.who, e.text) for e in log.events() if e.kind in ('start', 'setting')]
    finally:
        log.close()


def test_a_bridge_without_settings_and_a_parameter_leave_each_others_settings_alone(tmp_path):
    path = tmp_path / 'events.db'
    alarms = {'event_log': str(path), 'heel_alarm': 12.0}
    bridge = {'event_log': str(path), 'tcp': False, 'settings_file': str(tmp_path / 'none.json')}
    with (
        probe() as p,
        Process.node('ship_inclinometer', 'alarm_monitor', params=alarms) as monitor,
        Process.node('ship_inclinometer', 'modbus_bridge', params=bridge) as modbus,
    ):
        p.until(lambda: ('modbus_bridge', 'started') in told(path), 'the bridge', process=modbus)
        p.wait_for_publisher('ship/alarms', monitor)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        settings = p.publisher('sensor_msgs/msg/JointState', 'ship/settings', qos=latched, process=monitor)
        message = JointState(name=['roll_alarm'], position=[9.0])
        message.header.stamp.sec = 1
        settings.publish(message)
        changed = ('modbus', 'roll_alarm 15 -> 9')
        p.until(lambda: changed in told(path), 'the setting', process=monitor)
        p.set_parameter('alarm_monitor', 'silence_time', 60.0)
        p.until(lambda: told(path)[-1][0] == 'parameter', 'the parameter', process=monitor)
        said = [entry for entry in told(path) if entry[1] != 'started']
    assert said[0] == changed
    assert [who for who, _ in said] == ['modbus', 'parameter']
    assert 'roll_alarm' not in said[1][1]
    assert 'heel_alarm' not in said[1][1]
