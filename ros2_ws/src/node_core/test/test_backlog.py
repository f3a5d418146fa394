# SPDX-License-Identifier: Apache-2.0
"""What a node does with messages that piled up while it could not run."""

import time
from dataclasses import dataclass

import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor

from node_core.messages import set_stamp, stamp_of
from node_core.node import EstimatorNode
from node_core.ports import Input, Ports
from node_core.testing import TIMEOUT, message_class, probe

IMU = 'sensor_msgs/msg/Imu'
SPEED = 'geometry_msgs/msg/TwistWithCovarianceStamped'
SECOND = 10**9


@dataclass(frozen=True)
class NoParams:
    """Nothing to set."""


class Order:
    """Keeps the stamps in the order in which they come."""

    def __init__(self, _params):
        self.stamps = []

    def on_stamp(self, stamp):
        self.stamps.append(stamp)

    def reset(self):
        self.stamps.clear()


PORTS = Ports(
    name='order',
    params=NoParams,
    estimator=Order,
    inputs=(
        Input('speed', SPEED, stamp_of, 'on_stamp'),
        Input('imu/data_raw', IMU, stamp_of, 'on_stamp'),
    ),
    outputs={},
)


def test_a_backlog_is_used_in_the_order_of_its_stamps_not_topic_by_topic():
    stalled = rclpy.Context()
    rclpy.init(context=stalled)
    node = EstimatorNode(PORTS, context=stalled)
    executor = SingleThreadedExecutor(context=stalled)
    executor.add_node(node)
    try:
        with probe() as p:
            fast, slow = p.publisher(IMU, 'imu/data_raw'), p.publisher(SPEED, 'speed')
            sent = []
            for publisher, kind, interval in ((fast, IMU, SECOND // 50), (slow, SPEED, SECOND)):
                for stamp in range(SECOND + interval // 2, 4 * SECOND, interval):
                    message = message_class(kind)()
                    set_stamp(message.header, stamp)
                    publisher.publish(message)
                    sent.append(stamp)
                assert publisher.wait_for_all_acked(Duration(seconds=TIMEOUT))
            used = node.driver.estimator.stamps
            end = time.monotonic() + TIMEOUT
            while len(used) < len(sent) and time.monotonic() < end:
                executor.spin_once(timeout_sec=1.0)
            assert used == sorted(sent)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=stalled)
