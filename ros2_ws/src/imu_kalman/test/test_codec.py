# SPDX-License-Identifier: Apache-2.0
"""Messages of rclpy and rosbags decode and encode alike; the port tables drive whole estimators."""

import math

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from imu_kalman.codec import ANGLE_PORTS, ATTITUDE_PORTS, decode_imu, decode_mag, encode_attitude, encode_bias
from imu_kalman.params import AttitudeParams, TwoStateParams
from imu_kalman.samples import Attitude, GyroBias
from node_core.driver import EstimatorDriver
from node_core.ports import BadMessage

STORE = get_typestore(Stores.ROS2_JAZZY)


def from_rosbags(name):
    types = STORE.types
    vector = types['geometry_msgs/msg/Vector3']
    stamp = types['builtin_interfaces/msg/Time'](sec=3, nanosec=4)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='imu_link')
    nine = np.zeros(9)
    if name == 'sensor_msgs/msg/Imu':
        return types[name](
            header=header,
            orientation=types['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=nine.copy(),
            angular_velocity=vector(x=0.1, y=0.2, z=0.3),
            angular_velocity_covariance=nine.copy(),
            linear_acceleration=vector(x=1.0, y=2.0, z=9.0),
            linear_acceleration_covariance=nine.copy(),
        )
    return types['sensor_msgs/msg/MagneticField'](
        header=header, magnetic_field=vector(x=1e-6, y=2e-5, z=-4e-5), magnetic_field_covariance=nine.copy()
    )


def from_rclpy(name):
    messages = pytest.importorskip('sensor_msgs.msg')
    message = getattr(messages, name.rsplit('/', 1)[1])()
    message.header.stamp.sec, message.header.stamp.nanosec = 3, 4
    message.header.frame_id = 'imu_link'
    if name == 'sensor_msgs/msg/Imu':
        rate, force = message.angular_velocity, message.linear_acceleration
        rate.x, rate.y, rate.z = 0.1, 0.2, 0.3
        force.x, force.y, force.z = 1.0, 2.0, 9.0
    else:
        field = message.magnetic_field
        field.x, field.y, field.z = 1e-6, 2e-5, -4e-5
    return message


makers = pytest.mark.parametrize('make', [from_rosbags, from_rclpy])


@makers
def test_samples_are_read_by_field_name(make):
    imu = decode_imu(make('sensor_msgs/msg/Imu'))
    assert imu == (3_000_000_004, (0.1, 0.2, 0.3), (1.0, 2.0, 9.0), 'imu_link', 0.0)
    mag = decode_mag(make('sensor_msgs/msg/MagneticField'))
    assert mag == (3_000_000_004, (1e-6, 2e-5, -4e-5), 'imu_link')


@makers
@pytest.mark.parametrize(
    ('part', 'reason'),
    [('angular_velocity', 'no angular velocity'), ('linear_acceleration', 'no specific force')],
)
def test_what_is_marked_as_not_measured_is_refused(make, part, reason):
    message = make('sensor_msgs/msg/Imu')
    getattr(message, f'{part}_covariance')[0] = -1.0
    with pytest.raises(BadMessage, match=reason):
        decode_imu(message)


@makers
def test_the_variance_of_the_rate_is_read(make):
    message = make('sensor_msgs/msg/Imu')
    message.angular_velocity_covariance[0] = 0.04
    assert decode_imu(message).gyr_var == 0.04


@makers
@pytest.mark.parametrize(
    ('part', 'reason'),
    [
        ('angular_velocity', 'angular velocity not finite'),
        ('linear_acceleration', 'specific force not finite'),
    ],
)
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_what_is_not_finite_is_refused_with_its_reason(make, part, reason, value):
    message = make('sensor_msgs/msg/Imu')
    getattr(message, part).y = value
    with pytest.raises(BadMessage, match=reason):
        decode_imu(message)


@makers
def test_a_zero_stamp_is_refused(make):
    for name, decode in (('sensor_msgs/msg/Imu', decode_imu), ('sensor_msgs/msg/MagneticField', decode_mag)):
        message = make(name)
        message.header.stamp.sec = message.header.stamp.nanosec = 0
        with pytest.raises(BadMessage, match='zero stamp'):
            decode(message)


@makers
def test_an_attitude_fills_every_field_with_the_quaternion_reordered(make):
    message = make('sensor_msgs/msg/Imu')
    values = np.arange(37.0)
    encode_attitude(Attitude(7_000_000_009, 'body', values), message)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7, 9)
    assert message.header.frame_id == 'body'
    q = message.orientation
    assert (q.w, q.x, q.y, q.z) == (0.0, 1.0, 2.0, 3.0)
    rate, force = message.angular_velocity, message.linear_acceleration
    assert (rate.x, rate.y, rate.z, force.x, force.y, force.z) == (4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    np.testing.assert_array_equal(message.orientation_covariance, values[10:19])
    np.testing.assert_array_equal(message.angular_velocity_covariance, values[19:28])
    np.testing.assert_array_equal(message.linear_acceleration_covariance, values[28:37])


def test_a_bias_goes_into_the_angular_half_of_a_twist_with_its_covariance():
    message = pytest.importorskip('geometry_msgs.msg').TwistWithCovarianceStamped()
    encode_bias(GyroBias(1_000_000_002, 'imu', (0.1, 0.2, 0.3), np.diag([1.0, 2.0, 3.0])), message)
    angular = message.twist.twist.angular
    assert (angular.x, angular.y, angular.z) == (0.1, 0.2, 0.3)
    assert message.twist.covariance.reshape(6, 6).diagonal().tolist() == [0, 0, 0, 1, 2, 3]


@pytest.mark.parametrize('ports', [ANGLE_PORTS, ATTITUDE_PORTS])
def test_the_port_table_drives_the_estimator_and_bad_messages_are_counted(ports):
    driver = EstimatorDriver(ports, ports.params())
    port = next(p for p in ports.inputs if p.topic == 'imu/data_raw')
    message = from_rosbags('sensor_msgs/msg/Imu')
    topics = {output.topic for output, _ in driver.feed(port, message)}
    assert 'imu/data' in topics
    assert topics <= {output.topic for output in ports.outputs.values()}
    message.angular_velocity.x = math.nan
    assert driver.feed(port, message) == []
    assert driver.tally.sensors['imu/data_raw'].rejected['angular velocity not finite'] == 1


@pytest.mark.parametrize(
    ('ports', 'params'), [(ANGLE_PORTS, TwoStateParams), (ATTITUDE_PORTS, AttitudeParams)]
)
def test_a_foreign_frame_is_rejected_where_a_frame_is_named(ports, params):
    driver = EstimatorDriver(ports, params(frame_id='other'))
    assert driver.feed(ports.inputs[0], from_rosbags('sensor_msgs/msg/Imu')) == []
    assert driver.tally.sensors['imu/data_raw'].rejected['foreign frame'] == 1
