# SPDX-License-Identifier: Apache-2.0
"""Field access works alike on rclpy's and rosbags' message objects."""

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header

from node_core import messages
from node_core.ports import BadMessage

STORE = get_typestore(Stores.ROS2_JAZZY)


@given(st.integers(min_value=1, max_value=2**31 * 10**9 - 1))
def test_stamps_survive_a_round_trip(stamp):
    imu = Imu()
    messages.set_stamp(imu.header, stamp)
    assert messages.stamp_of(imu) == stamp


def test_a_zero_stamp_is_rejected():
    with pytest.raises(BadMessage, match='zero stamp'):
        messages.stamp_of(Imu())


@pytest.mark.parametrize('bad', [float('nan'), float('inf'), -float('inf')])
def test_vectors_that_are_not_finite_are_rejected(bad):
    imu = Imu()
    imu.angular_velocity.y = bad
    with pytest.raises(BadMessage, match='rate not finite'):
        messages.finite3(imu.angular_velocity, 'rate')


def test_quaternions_change_order_only_at_the_message():
    message = Quaternion()
    messages.set_quaternion(message, (0.5, -0.5, 0.5, -0.5))
    assert (message.w, message.x, message.y, message.z) == (0.5, -0.5, 0.5, -0.5)
    np.testing.assert_array_equal(messages.get_quaternion(message), [0.5, -0.5, 0.5, -0.5])


@pytest.mark.parametrize('components', [(0.0, 0.0, 0.0, 0.0), (float('nan'), 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_rejected(components):
    message = Quaternion(w=components[0], x=components[1], y=components[2], z=components[3])
    with pytest.raises(BadMessage):
        messages.get_quaternion(message)


def test_float_sequences_are_written_for_both_kinds_of_message():
    live = JointState()
    messages.set_floats(live, 'position', [1, 2.5])
    assert list(live.position) == [1.0, 2.5]

    joint_state = STORE.types['sensor_msgs/msg/JointState']
    header = STORE.types['std_msgs/msg/Header'](STORE.types['builtin_interfaces/msg/Time'](0, 0), '')
    empty = np.array([])
    recorded = joint_state(header, [], empty, empty, empty)
    messages.set_floats(recorded, 'position', [1, 2.5])
    assert STORE.deserialize_cdr(
        STORE.serialize_cdr(recorded, joint_state.__msgtype__), joint_state.__msgtype__
    ).position.tolist() == [1.0, 2.5]
    assert isinstance(live.header, Header)
