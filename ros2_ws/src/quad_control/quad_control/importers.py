# SPDX-License-Identifier: Apache-2.0
"""Importers: public recordings and PX4 flight logs as bags with this package's topics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagError, BagWriter, zeroed
from kalman_core.rotation import quat_multiply
from node_core.messages import set_quaternion, set_stamp
from quad_control import codec
from quad_control.params import GRAVITY
from quad_control.recordings import RecordingError, read_phantom
from quad_control.samples import BatterySample, ImuSample

_RAW, _TRUTH, _BATTERY = '/imu/data_raw', '/truth/orientation', '/battery'
_QUATERNION = 'geometry_msgs/msg/QuaternionStamped'
# Recordings without a date start here: a zero stamp means "not set" in ROS.
_START = 1_000_000_000
# Rotations between PX4's axes (north-east-down, forward-right-down) and those of ROS (wxyz).
_ENU_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
_FRD_FLU = np.array([0.0, 1.0, 0.0, 0.0])

Samples = list[tuple[int, str, Callable[[Any, Any], None], Any]]


def import_phantom(source: Path, writer: BagWriter) -> None:
    """Import one Phantom 4 RTK flight; `source` is its IMU file, FOLDER/H1_IMU_1.csv."""
    name = source.name.split('_')[0]
    try:
        flight = read_phantom(source.parent, name)
    except RecordingError as error:
        raise BagError(str(error)) from None
    samples: Samples = [
        (_ns(t), _RAW, codec.encode_imu, ImuSample(_ns(t), tuple(gyro), tuple(force), 'imu_link'))
        for t, gyro, force in zip(flight.time, flight.gyro, flight.force)
    ]
    samples += [(_ns(t), _TRUTH, _encode_orientation, q) for t, q in zip(flight.truth_time, flight.truth)]
    _write(writer, samples)


def import_mpu6050(source: Path, writer: BagWriter) -> None:
    """Import an MPU6050 recording; `source` is the folder with mpu6050_gyroscope.mat and its partner.

    Degrees per second and g. Signs as the recording itself shows them: it begins upright with +1 g on z, and
    the change of the accelerometer follows −ω × f without flipping any axis.
    """
    gyro = _matrix(source / 'mpu6050_gyroscope.mat')
    force = _matrix(source / 'mpu6050_accelerometer.mat')
    time = gyro[:, 0]
    rates = np.radians(gyro[:, 1:4])
    forces = np.column_stack([np.interp(time, force[:, 0], GRAVITY * force[:, i]) for i in (1, 2, 3)])
    samples: Samples = [
        (_ns(t), _RAW, codec.encode_imu, ImuSample(_ns(t), tuple(w), tuple(f), 'imu_link'))
        for t, w, f in zip(time - time[0], rates, forces)
    ]
    _write(writer, samples)


def import_ulog(source: Path, writer: BagWriter) -> None:
    """Import a PX4 ULog: sensor_combined, vehicle_attitude as reference, battery_status. Needs pyulog."""
    try:
        from pyulog import ULog
        from pyulog.exceptions import ULogException
    except ImportError:
        raise BagError(f'{source}: reading a ULog needs the Python package pyulog') from None
    if not source.is_file():
        raise BagError(f'{source}: no such file, expected a PX4 ULog')
    try:
        log = ULog(str(source), ['sensor_combined', 'vehicle_attitude', 'battery_status'])
    except (ULogException, TypeError, ValueError, IndexError, KeyError) as error:
        raise BagError(f'{source}: not a PX4 ULog ({error})') from None
    data = {d.name: d.data for d in log.data_list if d.multi_id == 0}
    if 'sensor_combined' not in data:
        raise BagError(f"{source}: no topic 'sensor_combined', found: {', '.join(sorted(data)) or 'none'}")
    imu = data['sensor_combined']
    # Forward-right-down to forward-left-up: y and z change their sign.
    flip = (1.0, -1.0, -1.0)
    gyro = np.column_stack([imu[f'gyro_rad[{i}]'] * flip[i] for i in range(3)]).astype(float)
    force = np.column_stack([imu[f'accelerometer_m_s2[{i}]'] * flip[i] for i in range(3)]).astype(float)
    samples: Samples = []
    for microseconds, w, f in zip(imu['timestamp'], gyro, force):
        stamp = int(microseconds) * 1000 + _START
        sample = ImuSample(stamp, tuple(w), tuple(f))
        samples.append((stamp, _RAW, codec.encode_imu, sample))
    if 'vehicle_attitude' in data:
        attitude = data['vehicle_attitude']
        for row, microseconds in enumerate(attitude['timestamp']):
            q = np.array([float(attitude[f'q[{i}]'][row]) for i in range(4)])
            turned = quat_multiply(quat_multiply(_ENU_NED, q), _FRD_FLU)
            samples.append((int(microseconds) * 1000 + _START, _TRUTH, _encode_orientation, turned))
    if 'battery_status' in data:
        battery = data['battery_status']
        for microseconds, voltage in zip(battery['timestamp'], battery['voltage_v']):
            stamp = int(microseconds) * 1000 + _START
            samples.append((stamp, _BATTERY, codec.encode_battery, BatterySample(stamp, float(voltage))))
    _write(writer, samples)


def _ns(seconds: float) -> int:
    return _START + round(float(seconds) * 1e9)


def _matrix(path: Path) -> np.ndarray:
    """Return the (n, 4) table t, x, y, z of an HDF5 .mat file."""
    try:
        import h5py
    except ImportError:
        raise BagError(f'{path}: reading it needs the Python package h5py') from None
    if not path.is_file():
        raise BagError(f'{path}: no such file, expected a recorded table')
    with h5py.File(path) as file:
        tables = [np.asarray(v) for v in file.values() if getattr(v, 'ndim', 0) == 2]
    for table in tables:
        wide = table if table.shape[1] == 4 else table.T
        if wide.shape[1] == 4:
            return wide
    raise BagError(f'{path}: no table of 4 columns (time, x, y, z)')


def _encode_orientation(q: np.ndarray, message: Any) -> None:
    set_quaternion(message.quaternion, q)


def _write(writer: BagWriter, samples: Samples) -> None:
    """Write samples in order of their stamps."""
    types = {_RAW: codec.IMU, _TRUTH: _QUATERNION, _BATTERY: codec.BATTERY}
    used = {topic for _, topic, _, _ in samples}
    messages = {topic: zeroed(types[topic]) for topic in types if topic in used}
    for topic in messages:
        writer.add(topic, types[topic])
    for stamp, topic, encode, sample in sorted(samples, key=lambda s: s[0]):
        message = messages[topic]
        encode(sample, message)
        set_stamp(message.header, stamp)
        writer.write(topic, stamp, message)


IMPORTERS = {'phantom4rtk': import_phantom, 'mpu6050': import_mpu6050, 'ulog': import_ulog}
