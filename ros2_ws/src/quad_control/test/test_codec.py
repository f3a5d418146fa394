# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from bag_tools.bag import zeroed
from node_core.messages import set_floats
from node_core.ports import BadMessage
from quad_control import codec
from quad_control.controller import AttitudeController
from quad_control.craft import MOTORS
from quad_control.samples import (
    ArmingState,
    Attitude,
    BatterySample,
    ControlReport,
    Event,
    ImuSample,
    MotorCommand,
    RangeSample,
    RawAngle,
    Setpoint,
    SettledAttitude,
    Truth,
)

STAMP = 12_000_000_345
ATTITUDE = Attitude(
    STAMP, (0.8, 0.6, 0.0, 0.0), (0.1, 0.2, 0.3), (0.0, 1.0, 9.8), (1e-4, 2e-4, 3e-4), (4e-4,) * 3, 'imu_link'
)


def live(type_name):
    from node_core.message_types import message_class

    return message_class(type_name)()


@pytest.fixture(params=['rosbags', 'rclpy'])
def made(request):
    return zeroed if request.param == 'rosbags' else live


@pytest.mark.parametrize(
    ('kind', 'encode', 'decode', 'sample'),
    [
        (
            codec.IMU,
            codec.encode_imu,
            codec.decode_imu,
            ImuSample(STAMP, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 'imu_link'),
        ),
        (codec.IMU, codec.encode_attitude, codec.decode_attitude, ATTITUDE),
        (
            codec.JOINTS,
            codec.encode_setpoint,
            codec.decode_setpoint,
            Setpoint(STAMP, 0.1, -0.2, 0.3, 0.4, True, True),
        ),
    ],
)
def test_what_is_encoded_is_decoded(made, kind, encode, decode, sample):
    message = made(kind)
    encode(sample, message)
    assert decode(message) == sample


def test_range_battery_and_motors_survive_the_way(made):
    message = made(codec.RANGE)
    codec.encode_range(RangeSample(STAMP, 2.5), message)
    assert codec.decode_range(message) == RangeSample(STAMP, 2.5)
    message = made(codec.BATTERY)
    codec.encode_battery(BatterySample(STAMP, 24.5), message)
    assert codec.decode_battery(message) == BatterySample(STAMP, 24.5)
    message = made(codec.JOINTS)
    codec.encode_motors(MotorCommand(STAMP, (1100.0, 1200.0, 1300.0, 1400.0), (0.1, 0.2, 0.3, 0.4)), message)
    assert codec.decode_motors(message) == (STAMP, (1100.0, 1200.0, 1300.0, 1400.0))


def test_motors_are_read_by_name_not_by_place(made):
    message = made(codec.JOINTS)
    codec.encode_motors(MotorCommand(STAMP, (1100.0, 1200.0, 1300.0, 1400.0), (0.0,) * 4), message)
    message.name = list(reversed(MOTORS))
    assert codec.decode_motors(message)[1] == (1400.0, 1300.0, 1200.0, 1100.0)


def test_a_raw_imu_has_no_orientation_and_is_refused_as_attitude(made):
    message = made(codec.IMU)
    codec.encode_imu(ImuSample(STAMP, (0.0,) * 3, (0.0, 0.0, 9.8)), message)
    with pytest.raises(BadMessage, match='no orientation'):
        codec.decode_attitude(message)


@pytest.mark.parametrize('decode', [codec.decode_imu, codec.decode_attitude])
def test_an_imu_without_a_gyro_is_refused(made, decode):
    message = made(codec.IMU)
    codec.encode_attitude(ATTITUDE, message)
    message.angular_velocity_covariance[0] = -1.0
    with pytest.raises(BadMessage, match='no rates'):
        decode(message)


def test_rates_of_unknown_variance_are_read_but_do_not_arm(made):
    message = made(codec.IMU)
    level = ATTITUDE._replace(quaternion=(1.0, 0.0, 0.0, 0.0), rate_variance=(0.0,) * 3)
    codec.encode_attitude(level, message)
    controller = AttitudeController()
    controller.on_setpoint(Setpoint(STAMP, 0.0, 0.0, 0.0, 0.0, False))
    controller.on_attitude(codec.decode_attitude(message))
    armed, why = controller.arm(True)
    assert not armed
    assert 'rate sigma inf' in why


def spoilt(made, kind, encode, sample, spoil):
    message = made(kind)
    encode(sample, message)
    spoil(message)
    return message


def test_unusable_messages_are_refused_with_a_reason(made):
    imu = ImuSample(STAMP, (0.0,) * 3, (0.0, 0.0, 9.8))
    sticks = Setpoint(STAMP, 0.0, 0.0, 0.0, 0.0, False)

    def zero_stamp(m):
        m.header.stamp.sec, m.header.stamp.nanosec = 0, 0

    def nan_rate(m):
        m.angular_velocity.x = math.nan

    def no_name(m):
        m.name = list(codec.STICKS[1:])
        set_floats(m, 'position', [0.0] * 5)

    def nan_stick(m):
        set_floats(m, 'position', [math.nan] * 6)

    def short(m):
        set_floats(m, 'position', [0.0])

    cases = [
        (codec.decode_imu, spoilt(made, codec.IMU, codec.encode_imu, imu, zero_stamp), 'zero stamp'),
        (codec.decode_imu, spoilt(made, codec.IMU, codec.encode_imu, imu, nan_rate), 'angular velocity'),
        (
            codec.decode_attitude,
            spoilt(made, codec.IMU, codec.encode_attitude, ATTITUDE, nan_rate),
            'angular',
        ),
        (
            codec.decode_setpoint,
            spoilt(made, codec.JOINTS, codec.encode_setpoint, sticks, no_name),
            "no 'roll'",
        ),
        (
            codec.decode_setpoint,
            spoilt(made, codec.JOINTS, codec.encode_setpoint, sticks, nan_stick),
            'not finite',
        ),
        (
            codec.decode_setpoint,
            spoilt(made, codec.JOINTS, codec.encode_setpoint, sticks, short),
            "no 'pitch'",
        ),
    ]
    for decode, message, reason in cases:
        with pytest.raises(BadMessage, match=reason):
            decode(message)


@pytest.mark.parametrize('pulse', [math.nan, 400.0, 3000.0])
def test_pulses_that_are_none_are_refused(made, pulse):
    message = made(codec.JOINTS)
    codec.encode_motors(MotorCommand(STAMP, (pulse, 1200.0, 1300.0, 1400.0), (0.0,) * 4), message)
    with pytest.raises(BadMessage):
        codec.decode_motors(message)


def test_a_range_out_of_its_own_limits_is_no_height(made):
    message = made(codec.RANGE)
    codec.encode_range(RangeSample(STAMP, 2.5), message)
    message.range = math.inf
    with pytest.raises(BadMessage, match='out of range'):
        codec.decode_range(message)


def test_every_estimate_has_an_output_that_takes_it(made):
    samples = [
        ATTITUDE,
        SettledAttitude(*ATTITUDE),
        RawAngle(STAMP, 0.1, 0.2),
        MotorCommand(STAMP, (1000.0,) * 4, (0.0,) * 4),
        ControlReport(STAMP, (0.1,) * 3, (0.2,) * 3, (0.3,) * 4, (0.4,) * 4),
        Event(STAMP, 'trial', 'kept'),
        ArmingState(STAMP, 'armed'),
    ]
    outputs = {**codec.FILTER_PORTS.outputs, **codec.CONTROLLER_PORTS.outputs}
    assert set(outputs) == {type(s) for s in samples}
    for sample in samples:
        output = outputs[type(sample)]
        message = made(output.type)
        output.encode(sample, message)
    assert message.data == 'armed'


def test_truth_velocity_is_in_body_axes(made):
    message = made(codec.ODOMETRY)
    # Nose to the north (yaw 90 degrees), flying north: forward in body axes.
    half = math.sqrt(0.5)
    codec.encode_truth(
        Truth(STAMP, (0.0,) * 3, (0.0, 2.0, 0.0), (half, 0.0, 0.0, half), (0.0,) * 3, (0.0,) * 4), message
    )
    assert message.twist.twist.linear.x == pytest.approx(2.0)
    assert message.twist.twist.linear.y == pytest.approx(0.0)
