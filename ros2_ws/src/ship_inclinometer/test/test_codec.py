# SPDX-License-Identifier: Apache-2.0
import math
from pathlib import Path

import numpy as np
import pytest

from bag_tools.bag import BagReader, zeroed
from kalman_core.parameters import default_yaml
from node_core.driver import EstimatorDriver
from node_core.message_types import message_class
from node_core.ports import BadMessage
from ship_inclinometer import codec
from ship_inclinometer.bridge_params import AlarmParams, DisplayParams, ModbusParams, NmeaParams
from ship_inclinometer.fixtures import FIXTURES
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.roll_analysis import RollCycle, RollState
from ship_inclinometer.roll_params import RollParams
from ship_inclinometer.samples import Angles, Attitude, Validity

STAMP = 1_767_225_600_123_456_789
MAKERS = (zeroed, lambda name: message_class(name)())
CONFIG = Path(__file__).parents[1] / 'config'


@pytest.mark.parametrize('make', MAKERS, ids=('rosbags', 'rclpy'))
def test_estimates_survive_a_message(make):
    q = np.array([0.5, -0.5, 0.5, 0.5])
    covariance = np.diag([1.0, 2.0, 3.0])
    attitude = Attitude(STAMP, 'imu', q, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), covariance, 0)
    message = make(codec.IMU)
    codec.encode_attitude(attitude, message)
    back = codec.decode_attitude(message)
    assert back.stamp == STAMP
    np.testing.assert_array_equal(back.q, q)
    np.testing.assert_array_equal(back.covariance, covariance)
    np.testing.assert_array_equal(back.rate, attitude.rate)

    angles = Angles(STAMP, 'imu', (0.1, 0.2, 0.3), (0.0,) * 3, (0.0,) * 3, 0)
    message = make(codec.VECTOR)
    codec.encode_angles(angles, message)
    assert codec.decode_angles(message) == angles

    validity = Validity(STAMP, 1, 'turn without speed', True, (0.01, 0.02, 0.03))
    message = make(codec.VALUES)
    codec.encode_validity(validity, message)
    assert codec.decode_validity(message) == validity

    state = RollState(STAMP, 0, 0.1, 12.0, 0.1, 0.2, 0.3, 0.4, STAMP - 10**9, 3.0, 0.0, math.nan, False, True)
    message = make(codec.VALUES)
    codec.encode_roll(state, message)
    numbers = codec.decode_numbers(message)
    assert numbers['roll_period'] == 12.0
    assert numbers['peak_age'] == 1.0
    assert math.isnan(numbers['spectral_period'])


@pytest.mark.parametrize('make', MAKERS, ids=('rosbags', 'rclpy'))
def test_bad_messages_are_named(make):
    imu = make(codec.IMU)
    with pytest.raises(BadMessage, match='zero stamp'):
        codec.decode_imu(imu)
    imu.header.stamp.sec = 5
    imu.linear_acceleration.y = math.nan
    with pytest.raises(BadMessage, match='specific force'):
        codec.decode_imu(imu)
    imu.linear_acceleration.y = 0.0
    imu.angular_velocity_covariance[0] = -1.0
    with pytest.raises(BadMessage, match='not measured'):
        codec.decode_imu(imu)
    field = make(codec.FIELD)
    field.header.stamp.sec = 5
    field.magnetic_field.x = math.inf
    with pytest.raises(BadMessage, match='magnetic field'):
        codec.decode_mag(field)
    twist = make(codec.TWIST)
    twist.header.stamp.sec = 5
    twist.twist.covariance[0] = math.nan
    with pytest.raises(BadMessage, match='covariance'):
        codec.decode_gnss(twist)


@pytest.mark.parametrize(
    ('name', 'node', 'cls'),
    [
        ('attitude_estimator', 'attitude_estimator', AttitudeParams),
        ('roll_analysis', 'roll_analysis', RollParams),
        ('alarm_monitor', 'alarm_monitor', AlarmParams),
        ('modbus_bridge', 'modbus_bridge', ModbusParams),
        ('nmea_bridge', 'nmea_bridge', NmeaParams),
        ('display', 'display', DisplayParams),
    ],
)
def test_the_default_files_are_those_of_the_code(name, node, cls):
    assert (CONFIG / f'{name}.yaml').read_text() == default_yaml(cls, node)


@pytest.mark.parametrize('name', list(FIXTURES))
def test_a_fixture_is_small_and_gives_a_valid_attitude_near_its_truth(name, tmp_path):
    path = tmp_path / name
    FIXTURES[name](path)
    assert sum(f.stat().st_size for f in path.rglob('*')) < 1.5e6
    changes = {'antenna_lever_arm': (10.0, 3.0, 10.0), 'gnss_delay': 0.2} if 'gnss' in name else {}
    driver = EstimatorDriver(codec.ATTITUDE_PORTS, AttitudeParams(**changes))
    ports = {f'/{p.topic}': p for p in codec.ATTITUDE_PORTS.inputs}
    truth, estimates = {}, {}
    with BagReader(path) as bag:
        start = bag.start
        for topic, stamp, data in bag.messages(set(bag.topics)):
            message = bag.decode(data, bag.topics[topic].type)
            if topic == '/truth/orientation':
                q = message.quaternion
                truth[stamp] = np.array([q.w, q.x, q.y, q.z])
            elif topic in ports:
                for _, estimate in driver.feed(ports[topic], message):
                    if isinstance(estimate, Attitude):
                        estimates[estimate.stamp] = estimate.q
    errors = []
    for stamp, q in truth.items():
        if stamp in estimates and stamp - start > 60 * 10**9:
            up = [2 * (v[1] * v[3] - v[0] * v[2]) for v in (q, estimates[stamp])]
            side = [2 * (v[2] * v[3] + v[0] * v[1]) for v in (q, estimates[stamp])]
            errors.append(math.hypot(up[0] - up[1], side[0] - side[1]))
    assert len(errors) > 300
    assert math.degrees(math.sqrt(np.mean(np.square(errors)))) < 0.4


def test_what_is_no_estimate_is_refused_by_name():
    imu = zeroed(codec.IMU)
    imu.header.stamp.sec = 5
    imu.orientation.w = 0.5
    with pytest.raises(BadMessage, match='quaternion norm'):
        codec.decode_attitude(imu)
    imu.orientation.w = 1.0
    imu.orientation_covariance[4] = math.nan
    with pytest.raises(BadMessage, match='covariance'):
        codec.decode_attitude(imu)
    twist = zeroed(codec.TWIST)
    twist.header.stamp.sec = 5
    twist.twist.twist.linear.x = math.nan
    with pytest.raises(BadMessage, match='speed'):
        codec.decode_log(twist)
    values = zeroed(codec.VALUES)
    values.header.stamp.sec = 5
    with pytest.raises(BadMessage, match='not a validity'):
        codec.decode_validity(values)
    values.name, values.position = ['validity'], [math.inf]
    with pytest.raises(BadMessage, match='not a validity'):
        codec.decode_validity(values)
    values.position = []
    with pytest.raises(BadMessage, match='differ in number'):
        codec.decode_numbers(values)


def test_a_cycle_is_told_by_names():
    message = zeroed(codec.VALUES)
    codec.encode_cycle(RollCycle(STAMP, 7.0, -1, 0.3, 11.0, 0.2), message)
    assert list(codec.decode_numbers(message).values()) == pytest.approx([0.2, -1.0, 0.3, 11.0])
