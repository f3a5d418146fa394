# SPDX-License-Identifier: Apache-2.0
"""Time series of physical quantities out of bags, whatever message carries them.

A quantity is one of `scalar`, `vector` (n components) and `orientation` (quaternions wxyz). Its role says
what it means (orientation, position, linear_velocity, ...), so that an estimate and a truth of different
message types can be compared: an Imu's orientation with a QuaternionStamped.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.bag import BagError, BagReader, Topic

Array = NDArray[np.float64]
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Series:
    """A quantity over time: `stamps` (n,) int64 ns, ascending; `values` (n, d); `covariance` (n, c, c).

    For `orientation` d is 4 (wxyz, unit norm) and c is 3 (rad²); otherwise c equals d. `labels` name the
    components; `unit` is that of the values (rad for the errors of an orientation).
    """

    role: str
    kind: str
    stamps: NDArray[np.int64]
    values: Array
    labels: tuple[str, ...]
    unit: str = ''
    covariance: Array | None = None

    def seconds(self, origin: int | None = None) -> Array:
        """Return the stamps in seconds since `origin` (ns; default: the first stamp)."""
        first = int(self.stamps[0]) if origin is None else origin
        return (self.stamps - first).astype(np.float64) * 1e-9


@dataclass(frozen=True, slots=True)
class Quantity:
    """How to get one quantity out of a message: `value` returns its numbers, `covariance` a flat square."""

    role: str
    kind: str
    labels: tuple[str, ...]
    unit: str
    value: Callable[[Any], Any]
    covariance: Callable[[Any], Any] | None = None


_XYZ = ('x', 'y', 'z')


def _xyz(get: Callable[[Any], Any]) -> Callable[[Any], tuple[float, float, float]]:
    def value(message: Any) -> tuple[float, float, float]:
        v = get(message)
        return v.x, v.y, v.z

    return value


def _wxyz(get: Callable[[Any], Any]) -> Callable[[Any], tuple[float, float, float, float]]:
    def value(message: Any) -> tuple[float, float, float, float]:
        q = get(message)
        return q.w, q.x, q.y, q.z

    return value


def _block(get: Callable[[Any], Any], at: int) -> Callable[[Any], Array]:
    """Return the 3x3 block at row `at` of a row-major 6x6 covariance."""
    return lambda m: np.asarray(get(m), dtype=np.float64).reshape(6, 6)[at : at + 3, at : at + 3]


def _vector(
    role: str, unit: str, get: Callable[[Any], Any], cov: Callable[[Any], Any] | None = None
) -> Quantity:
    return Quantity(role, 'vector', _XYZ, unit, _xyz(get), cov)


def _orientation(get: Callable[[Any], Any], cov: Callable[[Any], Any] | None = None) -> Quantity:
    return Quantity('orientation', 'orientation', ('w', 'x', 'y', 'z'), 'rad', _wxyz(get), cov)


def _pose(get: Callable[[Any], Any], cov: Callable[[Any], Any] | None = None) -> tuple[Quantity, ...]:
    return (
        _vector('position', 'm', lambda m: get(m).position, _block(cov, 0) if cov else None),
        _orientation(lambda m: get(m).orientation, _block(cov, 3) if cov else None),
    )


def _twist(get: Callable[[Any], Any], cov: Callable[[Any], Any] | None = None) -> tuple[Quantity, ...]:
    return (
        _vector('linear_velocity', 'm/s', lambda m: get(m).linear, _block(cov, 0) if cov else None),
        _vector('angular_velocity', 'rad/s', lambda m: get(m).angular, _block(cov, 3) if cov else None),
    )


def _number(get: Callable[[Any], Any], unit: str = '', cov: Callable[[Any], Any] | None = None) -> Quantity:
    return Quantity('value', 'scalar', ('value',), unit, lambda m: (float(get(m)),), cov)


_QUANTITIES: dict[str, tuple[Quantity, ...]] = {
    'geometry_msgs/msg/Vector3': (Quantity('vector', 'vector', _XYZ, '', _xyz(lambda m: m)),),
    'geometry_msgs/msg/Vector3Stamped': (_vector('vector', '', lambda m: m.vector),),
    'geometry_msgs/msg/PointStamped': (_vector('position', 'm', lambda m: m.point),),
    'geometry_msgs/msg/AccelStamped': (
        _vector('linear_acceleration', 'm/s²', lambda m: m.accel.linear),
        _vector('angular_acceleration', 'rad/s²', lambda m: m.accel.angular),
    ),
    'geometry_msgs/msg/Quaternion': (_orientation(lambda m: m),),
    'geometry_msgs/msg/QuaternionStamped': (_orientation(lambda m: m.quaternion),),
    'geometry_msgs/msg/PoseStamped': _pose(lambda m: m.pose),
    'geometry_msgs/msg/PoseWithCovarianceStamped': _pose(lambda m: m.pose.pose, lambda m: m.pose.covariance),
    'geometry_msgs/msg/Twist': _twist(lambda m: m),
    'geometry_msgs/msg/TwistStamped': _twist(lambda m: m.twist),
    'geometry_msgs/msg/TwistWithCovarianceStamped': _twist(
        lambda m: m.twist.twist, lambda m: m.twist.covariance
    ),
    'nav_msgs/msg/Odometry': (
        *_pose(lambda m: m.pose.pose, lambda m: m.pose.covariance),
        *_twist(lambda m: m.twist.twist, lambda m: m.twist.covariance),
    ),
    'sensor_msgs/msg/Imu': (
        _orientation(lambda m: m.orientation, lambda m: m.orientation_covariance),
        _vector(
            'angular_velocity', 'rad/s', lambda m: m.angular_velocity, lambda m: m.angular_velocity_covariance
        ),
        _vector(
            'linear_acceleration',
            'm/s²',
            lambda m: m.linear_acceleration,
            lambda m: m.linear_acceleration_covariance,
        ),
    ),
    'sensor_msgs/msg/MagneticField': (
        _vector('magnetic_field', 'T', lambda m: m.magnetic_field, lambda m: m.magnetic_field_covariance),
    ),
    'sensor_msgs/msg/Temperature': (_number(lambda m: m.temperature, '°C'),),
    'sensor_msgs/msg/NavSatFix': (
        Quantity('geodetic', 'vector', ('latitude', 'longitude', 'altitude'), '',
                 lambda m: (m.latitude, m.longitude, m.altitude),
                 lambda m: m.position_covariance * (m.position_covariance_type > 0)),
    ),
}  # fmt: skip
for _name in ('Float64', 'Float32', 'Int8', 'Int16', 'Int32', 'Int64', 'UInt8', 'UInt16', 'UInt32', 'Bool'):
    _QUANTITIES[f'std_msgs/msg/{_name}'] = (_number(lambda m: m.data),)

_PATH = re.compile(r'([A-Za-z_]\w*)((?:\[\d+\])*)')


def walk(message: Any, path: str) -> Any:
    """Return the part of `message` at a path such as ``pose.covariance[0]``; raise LookupError."""
    value = message
    for part in path.split('.'):
        match = _PATH.fullmatch(part)
        if match is None:
            raise LookupError(path)
        try:
            value = getattr(value, match[1])
            for index in re.findall(r'\d+', match[2]):
                value = value[int(index)]
        except (AttributeError, IndexError, TypeError):
            raise LookupError(path) from None
    return value


_WITH_COVARIANCE = re.compile(
    r'(.*\b(?:pose|twist))\.(?:pose|twist)\.(position|linear|angular)(?:\.([xyz]))?'
)
_BESIDE_COVARIANCE = re.compile(r'(angular_velocity|linear_acceleration|magnetic_field)(?:\.([xyz]))?')
_UNITS = {
    'twist.linear': 'm/s',
    'twist.angular': 'rad/s',
    'accel.linear': 'm/s²',
    'accel.angular': 'rad/s²',
    'pose.position': 'm',
    'angular_velocity': 'rad/s',
    'linear_acceleration': 'm/s²',
    'magnetic_field': 'T',
}


def _unit(path: str) -> str:
    """Return the unit of the vector, or of the component of one, at `path` where ROS prescribes it."""
    vector = re.sub(r'\.[xyz]$', '', path)
    return next((unit for end, unit in _UNITS.items() if f'.{vector}'.endswith(f'.{end}')), '')


def _covariance_of(path: str, sample: Any) -> Callable[[Any], Any] | None:
    """Return what gets the covariance of the vector, or component of one, at `path`; None without one."""
    if match := _WITH_COVARIANCE.fullmatch(path):
        holder, size, first = f'{match[1]}.covariance', 6, 3 if match[2] == 'angular' else 0
    elif match := _BESIDE_COVARIANCE.fullmatch(path):
        holder, size, first = f'{match[1]}_covariance', 3, 0
    else:
        return None
    try:
        walk(sample, holder)
    except LookupError:
        return None
    axis = match[match.lastindex or 0]
    rows = slice(first, first + 3)
    if axis in _XYZ:
        first += _XYZ.index(axis)
        rows = slice(first, first + 1)
    return lambda m: np.asarray(walk(m, holder), dtype=np.float64).reshape(size, size)[rows, rows]


def _quantity_at(path: str, sample: Any) -> Quantity:
    """Return the quantity at a field path, judged by one message."""
    value = walk(sample, path)
    kind = type(value).__name__.split('__')[-1]
    if kind in ('Vector3', 'Point', 'Point32'):
        get = _xyz(lambda m: walk(m, path))
        return Quantity(path, 'vector', _XYZ, _unit(path), get, _covariance_of(path, sample))
    if kind == 'Quaternion':
        return Quantity(
            'orientation', 'orientation', ('w', 'x', 'y', 'z'), 'rad', _wxyz(lambda m: walk(m, path))
        )
    if isinstance(value, bool | int | float | np.number):
        label = (path.rsplit('.', 1)[-1],)
        number = lambda m: (float(walk(m, path)),)  # noqa: E731
        return Quantity(path, 'scalar', label, _unit(path), number, _covariance_of(path, sample))
    if isinstance(value, np.ndarray):
        labels = tuple(f'[{i}]' for i in range(len(value)))
        return Quantity(path, 'vector', labels, '', lambda m: tuple(walk(m, path)))
    raise LookupError(path)


def _stamp(message: Any, bag_time: int) -> int:
    header = getattr(message, 'header', None)
    if header is None:
        return bag_time
    return header.stamp.sec * NANOSECONDS + header.stamp.nanosec


def _covariances(rows: list[Any], size: int) -> Array | None:
    """Return (n, size, size), or None when any is missing, unknown (first element negative) or all zero."""
    try:
        stack = np.array([np.asarray(r, dtype=np.float64).reshape(size, size) for r in rows])
    except ValueError:
        return None
    diagonal = np.einsum('nii->ni', stack)
    return stack if np.all(np.isfinite(stack)) and np.all(diagonal > 0.0) else None


def _assemble(quantity: Quantity, stamps: list[int], values: list[Any], covariances: list[Any]) -> Series:
    times = np.array(stamps, dtype=np.int64)
    data = np.array(values, dtype=np.float64).reshape(len(values), -1)
    good = np.all(np.isfinite(data), axis=1)
    if quantity.kind == 'orientation':
        norm = np.sqrt(np.sum(data * data, axis=1))
        good &= np.abs(norm - 1.0) < 0.5  # an unset quaternion is all zero
        data = data / np.where(norm > 0.0, norm, 1.0)[:, None]
    order = np.argsort(times[good], kind='stable')
    cov = None
    if covariances:
        cov = _covariances(covariances, 3 if quantity.kind == 'orientation' else data.shape[1])
        cov = cov[good][order] if cov is not None else None
    return Series(
        quantity.role,
        quantity.kind,
        times[good][order],
        data[good][order],
        quantity.labels,
        quantity.unit,
        cov,
    )


def _first_message(reader: BagReader, topic: Topic) -> Any:
    for _, _, data in reader.messages([topic.name]):
        return reader.decode(data, topic.type)
    raise BagError(f"{reader.path}: topic '{topic.name}' has no messages")


def read_series(path: str | Path, topic_name: str, field: str | None = None) -> list[Series]:
    """Return the quantities of a topic, by header stamp (bag time where there is no header).

    `field` picks one by path (``twist.twist.linear.x``) for any message type. Non-finite rows and unset
    quaternions are left out. Raises BagError when nothing can be read.
    """
    with BagReader(path) as reader:
        topic = reader.topic(topic_name)
        if field is not None:
            try:
                quantities: tuple[Quantity, ...] = (_quantity_at(field, _first_message(reader, topic)),)
            except LookupError:
                raise BagError(
                    f"{reader.path}: '{topic.name}' ({topic.type}) has no numbers at '{field}'"
                ) from None
        elif topic.type in _QUANTITIES:
            quantities = _QUANTITIES[topic.type]
        else:
            raise BagError(
                f"{reader.path}: '{topic.name}' is {topic.type}; expected a field path to score it by"
            )
        stamps: list[int] = []
        values: list[list[Any]] = [[] for _ in quantities]
        covariances: list[list[Any]] = [[] for _ in quantities]
        for _, bag_time, data in reader.messages([topic.name]):
            message = reader.decode(data, topic.type)
            stamps.append(_stamp(message, bag_time))
            for quantity, rows, squares in zip(quantities, values, covariances):
                rows.append(quantity.value(message))
                if quantity.covariance is not None:
                    squares.append(quantity.covariance(message))
    if not stamps:
        raise BagError(f"{path}: topic '{topic.name}' has no messages")
    assembled = [_assemble(q, stamps, v, c) for q, v, c in zip(quantities, values, covariances)]
    return [s for s in assembled if len(s.stamps)]


def without_repeats(series: Series) -> Series:
    """Return the series with the last of equal stamps only, as interpolation needs."""
    keep = np.append(np.diff(series.stamps) > 0, True)
    cov = None if series.covariance is None else series.covariance[keep]
    return replace(series, stamps=series.stamps[keep], values=series.values[keep], covariance=cov)
