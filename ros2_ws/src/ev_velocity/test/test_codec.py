# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from bag_tools.bag import zeroed
from ev_velocity import codec
from ev_velocity.can_frames import Acceleration, Gear, Pedals, Speed, Wheels
from ev_velocity.driver_codec import SPEED_SIGMA, TOPICS, encode_gps, encode_reading
from ev_velocity.gps_stream import GpsSpeed
from ev_velocity.phases import Phase
from ev_velocity.samples import (
    AccelerationEstimate,
    ConstantsEstimate,
    GearSample,
    PedalSample,
    RoadEstimate,
    SlipEstimate,
    SpeedEstimate,
    WheelRateSample,
)
from node_core.driver import EstimatorDriver
from node_core.message_types import message_class
from node_core.messages import set_floats, set_stamp, stamp_of
from node_core.ports import BadMessage

STAMP = 1_767_225_600_123_456_789


def ros(kind):
    return message_class(kind)()


MAKERS = pytest.mark.parametrize('make', [zeroed, ros], ids=['rosbags', 'rclpy'])


def joints(make, names, field, values):
    message = make(codec.JOINTS)
    set_stamp(message.header, STAMP)
    message.name = list(names)
    set_floats(message, field, values)
    return message


@MAKERS
def test_inputs_are_read_by_field_name(make):
    imu = make(codec.IMU)
    set_stamp(imu.header, STAMP)
    imu.linear_acceleration.x = 1.25
    assert codec.decode_force(imu) == (STAMP, 1.25)
    gps = make(codec.TWIST)
    set_stamp(gps.header, STAMP)
    gps.twist.twist.linear.x, gps.twist.twist.linear.y = 3.0, -4.0
    gps.twist.covariance[0] = 0.04
    assert codec.decode_gps(gps) == (STAMP, 5.0, 0.04)
    assert codec.decode_encoder(joints(make, ['encoder'], 'position', [7.5])) == (STAMP, 7.5)
    pedals = joints(make, ['brake', 'accelerator'], 'position', [0.0, 0.3])
    assert codec.decode_pedals(pedals) == PedalSample(STAMP, 0.3, 0.0)
    assert codec.decode_gear(joints(make, ['gear'], 'position', [-1.0])) == GearSample(STAMP, -1)
    wheels = joints(make, ['wheel_a', 'wheel_b', 'motor'], 'velocity', [30.0, math.nan, 99.0])
    assert codec.decode_wheels(wheels) == WheelRateSample(STAMP, (30.0,))


@MAKERS
def test_what_no_estimator_can_use_is_refused_with_its_reason(make):
    imu = make(codec.IMU)
    with pytest.raises(BadMessage, match='zero stamp'):
        codec.decode_force(imu)
    set_stamp(imu.header, STAMP)
    imu.linear_acceleration.x = math.nan
    with pytest.raises(BadMessage, match='not finite'):
        codec.decode_force(imu)
    imu.linear_acceleration.x = 0.0
    imu.linear_acceleration_covariance[0] = -1.0
    with pytest.raises(BadMessage, match='no specific force'):
        codec.decode_force(imu)
    gps = make(codec.TWIST)
    set_stamp(gps.header, STAMP)
    gps.twist.twist.linear.x = math.nan
    with pytest.raises(BadMessage, match='speed not finite'):
        codec.decode_wheel_speed(gps)
    gps.twist.twist.linear.x = 0.0
    gps.twist.covariance[0] = math.nan
    with pytest.raises(BadMessage, match='variance'):
        codec.decode_gps(gps)
    with pytest.raises(BadMessage, match="no 'encoder'"):
        codec.decode_encoder(joints(make, ['other'], 'position', [1.0]))
    with pytest.raises(BadMessage, match='2 names but 1 values'):
        codec.decode_pedals(joints(make, ['brake', 'accelerator'], 'position', [0.0]))
    with pytest.raises(BadMessage, match="'brake' not finite"):
        codec.decode_pedals(joints(make, ['brake', 'accelerator'], 'position', [math.nan, 0.0]))
    with pytest.raises(BadMessage, match='1 names but 2 values'):
        codec.decode_wheels(joints(make, ['wheel_a'], 'velocity', [1.0, 2.0]))
    with pytest.raises(BadMessage, match='gear 3'):
        codec.decode_gear(joints(make, ['gear'], 'position', [3.0]))
    with pytest.raises(BadMessage, match='no finite wheel rate'):
        codec.decode_wheels(joints(make, ['wheel_a'], 'velocity', [math.nan]))


@MAKERS
def test_a_negative_variance_says_unknown(make):
    wheel = make(codec.TWIST)
    set_stamp(wheel.header, STAMP)
    wheel.twist.twist.linear.x = 3.0
    wheel.twist.covariance[0] = -1.0
    assert codec.decode_wheel_speed(wheel) == (STAMP, 3.0, 0.0)


@MAKERS
def test_readings_of_the_drivers_come_back_through_the_estimators_decoders(make):
    def encoded(reading, radius=0.3):
        message = make(TOPICS[type(reading)][1])
        encode_reading(reading, message, STAMP, radius)
        return message

    wheels = encoded(Wheels(0, ('wheel_a', 'wheel_b'), (3.0, math.nan)))
    assert codec.decode_wheels(wheels) == (STAMP, (pytest.approx(10.0),))
    assert codec.decode_pedals(encoded(Pedals(0, 0.25, 0.5))) == (STAMP, 0.25, 0.5)
    assert codec.decode_gear(encoded(Gear(0, -1))) == (STAMP, -1)
    assert codec.decode_wheel_speed(encoded(Speed(0, 9.0))) == (STAMP, 9.0, pytest.approx(SPEED_SIGMA**2))
    imu = encoded(Acceleration(0, -1.5))
    assert codec.decode_force(imu) == (STAMP, -1.5)
    assert (imu.orientation_covariance[0], imu.angular_velocity_covariance[0]) == (-1.0, -1.0)
    gps = make(codec.TWIST)
    encode_gps(GpsSpeed(5.0, 3.0, -4.0, 0.2, 0), gps, STAMP, 'gps')
    assert codec.decode_gps(gps) == (STAMP, 5.0, pytest.approx(0.04))
    assert gps.twist.covariance[7] == pytest.approx(0.04)
    assert gps.header.frame_id == 'gps'


@MAKERS
def test_estimates_fill_their_messages_and_every_covariance(make):
    def encoded(estimate):
        output = codec.VELOCITY_PORTS.outputs[type(estimate)]
        message = make(output.type)
        output.encode(estimate, message)
        assert stamp_of(message) == STAMP
        return message

    twist = encoded(SpeedEstimate(STAMP, 8.5, 0.01)).twist
    assert twist.twist.linear.x == 8.5
    diagonal = np.array(twist.covariance).reshape(6, 6)
    np.testing.assert_array_equal(diagonal, np.diag([0.01] + [codec.UNKNOWN] * 5))
    accel = encoded(AccelerationEstimate(STAMP, -2.0, 0.02)).accel
    assert accel.accel.linear.x == -2.0
    assert accel.covariance[0] == 0.02
    odometry = encoded(RoadEstimate(STAMP, 120.0, 0.5, 8.5, 0.01))
    assert odometry.pose.pose.position.x == 120.0
    assert odometry.pose.covariance[0] == 0.5
    assert odometry.twist.covariance[0] == 0.01
    slip = encoded(SlipEstimate(STAMP, 0.4, Phase.BRAKING, True))
    assert list(slip.name) == ['slip_ratio', 'phase', 'slipping']
    assert list(slip.position) == [0.4, 2.0, 1.0]
    learned = encoded(ConstantsEstimate(STAMP, tuple(range(7)), tuple(range(7, 14))))
    assert list(learned.name)[-2:] == ['wheel_delay', 'speed_delay']
    assert list(learned.position) == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert list(learned.effort) == [7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0]


@pytest.mark.parametrize('name', codec.ESTIMATORS)
def test_every_port_reaches_a_handler_and_bad_messages_are_counted(name):
    ports = codec.ESTIMATORS[name]
    driver = EstimatorDriver(ports, ports.params())
    for port in ports.inputs:
        assert driver.feed(port, zeroed(port.type)) == []
    assert sum(entry.rejected.total() for entry in driver.tally.sensors.values()) == len(ports.inputs)


@pytest.mark.parametrize('ahead', [0, 5])
@pytest.mark.parametrize(
    ('name', 'topic'), [('velocity_estimator', 'vehicle/velocity'), ('fusion_estimator', 'fusion/velocity')]
)
def test_no_output_is_lost_when_another_sensor_runs_ahead(name, topic, ahead):
    ports = codec.ESTIMATORS[name]
    driver = EstimatorDriver(ports, ports.params())
    imu, gps = zeroed(codec.IMU), zeroed(codec.TWIST)
    gps.twist.twist.linear.x = 5.0
    stamps = []
    for i in range(1, 200):
        if i % 10 == 0:
            set_stamp(gps.header, STAMP + (i + ahead) * 2_000_000)
            driver.feed(ports.inputs[1], gps)
        set_stamp(imu.header, STAMP + i * 2_000_000)
        stamps += [e.stamp for out, e in driver.feed(ports.inputs[0], imu) if out.topic == topic]
    assert sorted(set(stamps) & {STAMP + i * 2_000_000 for i in range(1, 200)}) == [
        STAMP + i * 2_000_000 for i in range(1, 200)
    ]
