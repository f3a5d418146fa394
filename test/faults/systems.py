# SPDX-License-Identifier: Apache-2.0
"""The five graphs that faults are put into: their processes, their bag, and what is compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from workspace_harness.make_bags import root

from bag_tools.bag import BagReader, resolve, zeroed
from bag_tools.catalogue import Entry
from bag_tools.cdr import decoder
from bag_tools.registry import find_ports
from ins_gps.replays import REPLAYS as INS_REPLAYS
from kalman_core.parameters import build
from node_core.driver import EstimatorDriver
from node_core.messages import NANOSECONDS, stamp_of
from node_core.ports import BadMessage, Ports

IMU_TOPIC = '/imu/data_raw'
_DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class NodeSpec:
    """One process. `hears` are topics it subscribes to, for nodes that are not driven by a table of ports."""

    package: str
    executable: str
    name: str
    params: Mapping[str, Any] = field(default_factory=dict)
    remaps: Mapping[str, str] = field(default_factory=dict)
    hears: tuple[str, ...] = ()

    @property
    def ports(self) -> Ports | None:
        """The table of ports, None for other nodes."""
        return None if self.hears else find_ports(self.package, self.executable)

    @property
    def inputs(self) -> dict[str, str]:
        """Topics (relative) that the node subscribes to, with their types where they are known."""
        if self.ports is None:
            return dict.fromkeys(self.hears, '')
        return {p.topic: p.type for p in self.ports.inputs}


@dataclass(frozen=True)
class System:
    """A graph and its bag. The first node is the one whose output is compared.

    `warm`, `fault` and `recovery` are lengths of the bag (s): before the fault, under it, and what the
    estimator is given to be back within `tolerance` of an undisturbed run. `value` takes the numbers out of
    an output, `distance` compares two of them. `live` names (node, parameter, good, bad value) to change.
    With `one_axis` only one component of the specific force is used, which may well be zero.
    """

    name: str
    bag: str
    nodes: tuple[NodeSpec, ...]
    output: str
    warm: float
    fault: float
    recovery: float
    tolerance: float
    unit: str
    value: Callable[[Any], tuple[float, ...]]
    distance: Callable[[tuple[float, ...], tuple[float, ...]], float]
    live: tuple[str, str, float, float]
    one_axis: bool = False

    @property
    def main(self) -> NodeSpec:
        """The estimator that is compared."""
        return self.nodes[0]

    @property
    def output_type(self) -> str:
        """Message type of the compared output."""
        assert self.main.ports is not None
        return next(o.type for o in self.main.ports.outputs.values() if o.topic == self.output)

    def __str__(self) -> str:
        return self.name


def _orientation(message: Any) -> tuple[float, ...]:
    q = message.orientation
    return (q.w, q.x, q.y, q.z)


def _angle(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the angle (°) between two unit quaternions."""
    return 2.0 * _DEGREES * math.acos(min(1.0, abs(sum(p * q for p, q in zip(a, b)))))


def _inclination(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the angle (°) between the verticals of two attitudes: heading is free without a compass."""
    return _DEGREES * math.acos(max(-1.0, min(1.0, sum(p * q for p, q in zip(_up(a), _up(b))))))


def _up(q: tuple[float, ...]) -> tuple[float, ...]:
    w, x, y, z = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


def _speed(message: Any) -> tuple[float, ...]:
    return (message.twist.twist.linear.x,)


def _position(message: Any) -> tuple[float, ...]:
    p = message.pose.pose.position
    return (p.x, p.y, p.z)


def _ins_params() -> dict[str, Any]:
    """Return the parameters of the replay, but for the attitude: one who restarts does not know it."""
    replay = next(r for r in INS_REPLAYS if r.bag == 'gnss_outage')
    entry: Entry = replay.entries[-1]
    given = ('alignment', 'initial_attitude', 'initial_tilt_sigma', 'initial_yaw_sigma')
    return {name: value for name, value in entry.params.items() if name not in given}


_IMU_KALMAN = System(
    'imu_kalman',
    'imu_hand_held',
    (
        NodeSpec('imu_kalman', 'attitude_estimator', 'attitude_estimator'),
        NodeSpec(
            'imu_kalman',
            'angle_estimator',
            'angle_estimator',
            remaps={'imu/data': 'angle/data', 'imu/data_settled': 'angle/data_settled'},
        ),
    ),
    'imu/data',
    warm=2.0,
    fault=1.0,
    recovery=4.0,
    tolerance=3.0,
    unit='°',
    value=_orientation,
    distance=_angle,
    live=('attitude_estimator', 'accel_noise', 0.03, -1.0),
)
_SHIP = System(
    'ship_inclinometer',
    'ship_beam_sea',
    (
        NodeSpec('ship_inclinometer', 'attitude_estimator', 'attitude_estimator'),
        NodeSpec('ship_inclinometer', 'roll_analysis', 'roll_analysis'),
        NodeSpec(
            'ship_inclinometer',
            'alarm_monitor',
            'alarm_monitor',
            hears=('ship/attitude', 'ship/validity', 'ship/roll', 'ship/settings', 'ship/command'),
        ),
    ),
    'imu/data',
    warm=26.0,
    fault=2.0,
    recovery=30.0,
    tolerance=3.0,
    unit='°',
    value=_orientation,
    distance=_inclination,
    live=('roll_analysis', 'no_roll', 0.6, -1.0),
)
_EV = System(
    'ev_velocity',
    'ev_good_road',
    (
        NodeSpec('ev_velocity', 'velocity_estimator', 'velocity_estimator'),
        NodeSpec('ev_velocity', 'fusion_estimator', 'fusion_estimator'),
    ),
    'vehicle/velocity',
    warm=1.0,
    fault=0.4,
    recovery=1.2,
    tolerance=0.5,
    unit='m/s',
    value=_speed,
    distance=lambda a, b: abs(a[0] - b[0]),
    live=('velocity_estimator', 'gps_sigma', 0.2, -1.0),
    one_axis=True,
)
_INS = System(
    'ins_gps',
    'gnss_outage',
    (
        NodeSpec('ins_gps', 'ins_gps_estimator', 'ins_gps_estimator', params=_ins_params()),
        NodeSpec(
            'ins_gps',
            'ins_gps_estimator',
            'loose_estimator',
            params=_ins_params() | {'mode': 'loose'},
            remaps={t: f'loose/{t}' for t in ('odometry', 'odometry_settled', 'position', 'imu/bias')},
        ),
    ),
    'odometry',
    warm=6.0,
    fault=3.0,
    recovery=10.0,
    tolerance=5.0,
    unit='m',
    value=_position,
    distance=math.dist,
    live=('ins_gps_estimator', 'gyro_noise', 2e-4, -1.0),
)
_QUAD = System(
    'quad_control',
    'quad_free_10deg',
    (
        NodeSpec('quad_control', 'attitude_filter', 'attitude_filter'),
        NodeSpec('quad_control', 'attitude_controller', 'attitude_controller'),
        NodeSpec(
            'quad_control', 'esc_driver', 'esc_driver', params={'bus': 'fake'}, hears=('motors/command',)
        ),
    ),
    'imu/data',
    warm=3.0,
    fault=0.5,
    recovery=3.0,
    tolerance=5.0,
    unit='°',
    value=_orientation,
    distance=_inclination,
    live=('attitude_controller', 'roll_kp', 0.5, -1.0),
)
SYSTEMS = {s.name: s for s in (_IMU_KALMAN, _SHIP, _EV, _INS, _QUAD)}


@dataclass(frozen=True)
class Recorded:
    """What a system is fed with: (topic, bag time ns, CDR bytes) in order, and the types by topic."""

    types: dict[str, str]
    messages: tuple[tuple[str, int, bytes], ...]


def bag_path(system: System) -> Path:
    """Return the path of the system's fixture."""
    return root() / 'bags' / f'{system.bag}.mcap'


@cache
def recorded(name: str) -> Recorded:
    """Return what the nodes of system `name` hear of its bag, without what one of them publishes itself."""
    system = SYSTEMS[name]
    heard = {resolve(topic) for node in system.nodes for topic in node.inputs}
    made = {
        resolve(node.remaps.get(o.topic, o.topic))
        for node in system.nodes
        if node.ports is not None
        for o in node.ports.outputs.values()
    }
    with BagReader(bag_path(system)) as reader:
        topics = (heard & set(reader.topics)) - made
        types = {topic: reader.topics[topic].type for topic in topics}
        rows = tuple((topic, stamp, bytes(data)) for topic, stamp, data in reader.messages(topics))
    return Recorded(types, rows)


def offline_outputs(
    system: System, first: int = 0, last: int | None = None, shift: int = 0
) -> dict[int, tuple[float, ...]]:
    """Return the compared values by stamp (ns) when the main estimator hears messages `first` … `last`.

    `shift` (ns) is taken off every stamp of the result: graphs that are fed with shifted stamps compare.
    """
    ports = system.main.ports
    assert ports is not None
    driver = EstimatorDriver(ports, build(ports.params, dict(system.main.params)))
    inputs = {resolve(p.topic): p for p in ports.inputs}
    source = recorded(system.name)
    from bag_tools.bag import jazzy

    decoders = {topic: decoder(jazzy(), kind) for topic, kind in source.types.items()}
    out = zeroed(system.output_type)
    values = {}
    for topic, _, data in source.messages[first:last]:
        port = inputs.get(topic)
        if port is None:
            continue
        for output, estimate in driver.feed(port, decoders[topic](data)):
            if output.topic == system.output:
                output.encode(estimate, out)
                values[stamp_of(out) - shift] = system.value(out)
    return values


@cache
def undisturbed(name: str) -> dict[int, tuple[float, ...]]:
    """Return the compared values by stamp of a run without any fault."""
    return offline_outputs(SYSTEMS[name], 0, index_at(name, horizon(name)))


def horizon(name: str) -> float:
    """Return the bag time (s) that a case reaches at most."""
    system = SYSTEMS[name]
    return system.warm + 2.0 * system.fault + 2.0 * system.recovery


@cache
def index_at(name: str, seconds: float) -> int:
    """Return the number of messages within the first `seconds` of the bag."""
    rows = recorded(name).messages
    end = rows[0][1] + round(seconds * NANOSECONDS)
    return sum(stamp < end for _, stamp, _ in rows)


def imu_count(name: str, first: int, last: int) -> int:
    """Return how many of messages `first` … `last` are of the fast sensor."""
    return sum(topic == IMU_TOPIC for topic, _, _ in recorded(name).messages[first:last])


def stamp_or_none(message: Any) -> int | None:
    """Return the header stamp (ns), None where it is zero."""
    try:
        return stamp_of(message)
    except BadMessage:
        return None
