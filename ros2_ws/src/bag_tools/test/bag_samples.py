# SPDX-License-Identifier: Apache-2.0
"""What several tests share: small bags, and an estimator whose output depends on the order of its inputs."""

from dataclasses import dataclass

import numpy as np

from bag_tools.bag import BagWriter, zeroed
from kalman_core.health import Tally
from kalman_core.parameters import parameter
from node_core.messages import finite3, set3, set_stamp, stamp_of
from node_core.ports import Input, Output, Ports

IMU = 'sensor_msgs/msg/Imu'
MAG = 'sensor_msgs/msg/MagneticField'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True)
class MixParams:
    """Parameters of the mixing estimator."""

    leak: float = parameter(0.25, 'weight of the new sample', minimum=0.0, maximum=1.0, live=True)


@dataclass(frozen=True, slots=True)
class Sample:
    """A stamped vector."""

    stamp: int
    vector: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mixture:
    """The estimate."""

    stamp: int
    vector: np.ndarray


@dataclass(frozen=True, slots=True)
class Slow:
    """A second estimate, on its own topic."""

    stamp: int
    value: float


class Mix:
    """A leaky mean of all inputs: no two orders of the same messages give the same bits."""

    def __init__(self, params):
        self.tally = Tally()
        self.set_params(params)
        self.reset()

    def set_params(self, params):
        self.params = params

    def reset(self):
        self.state = np.zeros(3)

    def on_fast(self, sample):
        self.tally.accept('imu/data_raw', sample.stamp, nis=3.0, gate=16.3)
        self.state = self.state + self.params.leak * (np.array(sample.vector) - self.state)
        return Mixture(sample.stamp, self.state.copy())

    def on_slow(self, sample):
        self.state = self.state * 0.9 + 0.1 * np.array(sample.vector)
        return [Slow(sample.stamp, float(self.state[0])), Mixture(sample.stamp, self.state.copy())]


def encode_mixture(estimate, message):
    set_stamp(message.header, estimate.stamp)
    set3(message.vector, estimate.vector)


def encode_slow(estimate, message):
    message.data = float(estimate.value)


MIX = Ports(
    name='mix',
    params=MixParams,
    estimator=Mix,
    inputs=(
        Input(
            'imu/data_raw', IMU, lambda m: Sample(stamp_of(m), finite3(m.angular_velocity, 'rate')), 'on_fast'
        ),
        Input('imu/mag', MAG, lambda m: Sample(stamp_of(m), finite3(m.magnetic_field, 'field')), 'on_slow'),
    ),
    outputs={
        Mixture: Output('mixture', VECTOR, encode_mixture),
        Slow: Output('slow', 'std_msgs/msg/Float64', encode_slow, latched=True),
    },
)
# Listens to what MIX says and to a sensor: the order of the two shows.
CHAIN = Ports(
    name='chain',
    params=MixParams,
    estimator=Mix,
    inputs=(
        Input('mixture', VECTOR, lambda m: Sample(stamp_of(m), finite3(m.vector, 'mixture')), 'on_fast'),
        Input('aux', VECTOR, lambda m: Sample(stamp_of(m), finite3(m.vector, 'aux')), 'on_slow'),
    ),
    outputs={
        Mixture: Output('chained', VECTOR, encode_mixture),
        Slow: Output('chained_slow', 'std_msgs/msg/Float64', encode_slow),
    },
)
ESTIMATORS = {'mix': MIX, 'chain': CHAIN}


def stamped(message, stamp):
    set_stamp(message.header, stamp)
    return message


def imu(stamp, rate):
    message = stamped(zeroed(IMU), stamp)
    set3(message.angular_velocity, rate)
    return message


def mag(stamp, field):
    message = stamped(zeroed(MAG), stamp)
    set3(message.magnetic_field, field)
    return message


def write_sensors(path, seconds=2.0, seed=1, **options):
    """Write an IMU at 100 Hz, others at 25 and 10 Hz with equal stamps, and a note; return `path`."""
    rng = np.random.default_rng(seed)
    with BagWriter(path, **options) as bag:
        bag.add('imu/data_raw', IMU)
        bag.add('imu/mag', MAG)
        bag.add('aux', VECTOR)
        bag.add('note', 'std_msgs/msg/String', latched=True)
        note = zeroed('std_msgs/msg/String')
        note.data = 'latched'
        bag.write('/note', SECOND, note)
        for k in range(round(seconds * 100)):
            stamp = SECOND + k * 10_000_000
            bag.write('/imu/data_raw', stamp, imu(stamp, rng.normal(size=3)))
            if not k % 4:
                bag.write('/imu/mag', stamp, mag(stamp, rng.normal(size=3)))
            if not k % 10:
                aux = stamped(zeroed(VECTOR), stamp)
                set3(aux.vector, rng.normal(size=3))
                bag.write('/aux', stamp, aux)
    return path
