# SPDX-License-Identifier: Apache-2.0
"""A small estimator for tests: a leaky mean of one axis of the angular rate."""

from dataclasses import dataclass

from kalman_core.health import Tally
from kalman_core.parameters import parameter
from node_core.messages import finite3, set3, set_stamp, stamp_of
from node_core.ports import Input, Output, Ports


@dataclass(frozen=True, slots=True)
class LeakParams:
    leak: float = parameter(0.5, 'weight of the new sample', unit='1', minimum=0.0, maximum=1.0, live=True)
    axis: int = parameter(0, 'axis', minimum=0, maximum=2)


@dataclass(frozen=True, slots=True)
class Rate:
    stamp: int
    rate: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mean:
    stamp: int
    value: float


class Leak:
    def __init__(self, params):
        self.set_params(params)
        self.tally = Tally()
        self.reset()

    def set_params(self, params):
        self.params = params

    def reset(self):
        self.mean = 0.0

    def on_rate(self, sample):
        self.tally.accept('imu/data_raw', sample.stamp)
        self.mean += self.params.leak * (sample.rate[self.params.axis] - self.mean)
        return Mean(sample.stamp, self.mean)

    def diagnostics(self):
        return {'mean': self.mean}


def decode(message):
    return Rate(stamp_of(message), finite3(message.angular_velocity, 'rate'))


def encode(estimate, message):
    set_stamp(message.header, estimate.stamp)
    set3(message.vector, (estimate.value, 0.0, 0.0))


LEAK_PORTS = Ports(
    name='leak',
    params=LeakParams,
    estimator=Leak,
    inputs=(Input('imu/data_raw', 'sensor_msgs/msg/Imu', decode, 'on_rate', timeout=0.5),),
    outputs={Mean: Output('mean', 'geometry_msgs/msg/Vector3Stamped', encode)},
)


def build():
    from node_core.node import EstimatorNode

    return EstimatorNode(LEAK_PORTS)


if __name__ == '__main__':
    import sys

    from node_core.spin import run

    sys.exit(run(build))
