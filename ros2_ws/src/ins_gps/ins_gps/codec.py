# SPDX-License-Identifier: Apache-2.0
"""Messages to samples and estimates to messages, and the ports of the estimator and the DGPS base.

The one place where forward-left-up and ENU (messages) meet forward-right-down and NED (the filter).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ins_gps.dgps import DgpsBase
from ins_gps.estimator import InsGpsEstimator, warm
from ins_gps.odometry import ENU_NED, FLIP, odometry_values
from ins_gps.params import (
    BaseParams,
    FilterParams,
    NmeaParams,
    RinexParams,
    RtcmParams,
    SimulatorParams,
    UbloxParams,
)
from ins_gps.samples import (
    CORRECTION_FIELDS,
    OBSERVATION_FIELDS,
    BiasEstimate,
    Corrections,
    FixEstimate,
    GnssEpoch,
    ImuSample,
    NavigationEstimate,
    PositionSample,
    ReceiverFix,
    SettledEstimate,
    VelocitySample,
)
from kalman_core.rotation import quat_multiply
from node_core.messages import finite3, set3, set_bytes, set_quaternion, set_stamp, stamp_of
from node_core.ports import BadMessage, Input, Output, Ports

IMU = 'sensor_msgs/msg/Imu'
CLOUD = 'sensor_msgs/msg/PointCloud2'
FIX = 'sensor_msgs/msg/NavSatFix'
ODOMETRY = 'nav_msgs/msg/Odometry'
TWIST = 'geometry_msgs/msg/TwistWithCovarianceStamped'
_FLOAT64 = 8  # sensor_msgs/PointField.FLOAT64
_FIELD = 'sensor_msgs/msg/PointField'
# Rotates error vectors of NED into ENU.
_MAT_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_COVARIANCE_UNKNOWN = 0
_COVARIANCE_KNOWN = 3
_NO_FIX, _FIX = -1, 0
_NOT_MEASURED = 1e6  # (rad/s)², far beyond any turn


def decode_imu(message: Any) -> ImuSample:
    """Decode a sensor_msgs/Imu into forward-right-down; raise BadMessage for one without rate or force."""
    if message.angular_velocity_covariance[0] == -1.0:  # REP-145: not measured
        raise BadMessage('no angular velocity')
    if message.linear_acceleration_covariance[0] == -1.0:
        raise BadMessage('no specific force')
    stamp = stamp_of(message)
    x, y, z = finite3(message.angular_velocity, 'angular velocity')
    ax, ay, az = finite3(message.linear_acceleration, 'specific force')
    return ImuSample(stamp, np.array([x, -y, -z]), np.array([ax, -ay, -az]))


def _table(message: Any, names: tuple[str, ...]) -> np.ndarray:
    """Return (m, len(names)) of a cloud's FLOAT64 fields by name; BadMessage for another layout."""
    count, step = message.width * message.height, message.point_step
    data = np.asarray(message.data, dtype=np.uint8)
    if message.is_bigendian or step <= 0 or len(data) < count * step:
        raise BadMessage('cloud has a wrong size or byte order')
    offsets = {f.name: f.offset for f in message.fields if f.datatype == _FLOAT64 and f.count <= 1}
    cells = data[: count * step].reshape(count, step)
    out = np.empty((count, len(names)))
    for column, name in enumerate(names):
        offset = offsets.get(name)
        if offset is None or offset + 8 > step:
            raise BadMessage(f"cloud has no FLOAT64 field '{name}'")
        out[:, column] = np.ascontiguousarray(cells[:, offset : offset + 8]).view('<f8')[:, 0]
    return out


def decode_observations(message: Any) -> GnssEpoch:
    """Decode a cloud of `OBSERVATION_FIELDS`; NaN means not measured."""
    return GnssEpoch(stamp_of(message), _table(message, OBSERVATION_FIELDS))


def decode_corrections(message: Any) -> Corrections:
    """Decode a cloud of `CORRECTION_FIELDS`."""
    return Corrections(stamp_of(message), _table(message, CORRECTION_FIELDS))


def decode_fix(message: Any) -> PositionSample:
    """Decode a NavSatFix; BadMessage without a fix or a usable covariance."""
    stamp = stamp_of(message)
    if message.status.status < 0:
        raise BadMessage('no fix')
    lat, lon, height = message.latitude, message.longitude, message.altitude
    if not math.isfinite(lat + lon + height) or abs(lat) > 90.0 or abs(lon) > 360.0:
        raise BadMessage('position not finite or out of range')
    if message.position_covariance_type == _COVARIANCE_UNKNOWN:
        raise BadMessage('covariance unknown')
    enu = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)
    geodetic = np.array([math.radians(lat), math.radians(lon), height])
    return PositionSample(stamp, geodetic, _positive(enu), message.status.status)


def _positive(enu: np.ndarray) -> np.ndarray:
    """Return a covariance turned from ENU to NED; BadMessage unless it is positive definite."""
    if not np.isfinite(enu).all() or np.linalg.eigvalsh(0.5 * (enu + enu.T))[0] <= 0.0:
        raise BadMessage('covariance not positive definite')
    return _MAT_ENU_NED.T @ (0.5 * (enu + enu.T)) @ _MAT_ENU_NED


def decode_velocity(message: Any) -> VelocitySample:
    """Decode a TwistWithCovarianceStamped whose linear part is velocity in ENU."""
    stamp = stamp_of(message)
    velocity = np.array(finite3(message.twist.twist.linear, 'velocity'))
    covariance = np.asarray(message.twist.covariance, dtype=float).reshape(6, 6)[:3, :3]
    return VelocitySample(stamp, _MAT_ENU_NED.T @ velocity, _positive(covariance))


def _encode_table(message: Any, rows: np.ndarray, names: tuple[str, ...], make_field: Any) -> None:
    if len(message.fields) != len(names):
        fields = []
        for index, name in enumerate(names):
            field = make_field()
            field.name, field.offset, field.datatype, field.count = name, 8 * index, _FLOAT64, 1
            fields.append(field)
        message.fields = fields
        message.height, message.point_step = 1, 8 * len(names)
        message.is_bigendian, message.is_dense = False, False
    message.width = len(rows)
    message.row_step = 8 * len(names) * len(rows)
    set_bytes(message, 'data', np.ascontiguousarray(rows, dtype='<f8').tobytes())


def _field_maker(message: Any) -> Any:
    """Return a constructor of PointField of the same kind (rclpy or rosbags) as the cloud."""
    if type(message).__module__.startswith('sensor_msgs'):
        from sensor_msgs.msg import PointField

        return PointField
    from bag_tools.bag import zeroed

    return lambda: zeroed(_FIELD)


def encode_observations(sample: GnssEpoch, message: Any, frame: str = 'gnss') -> None:
    """Fill a PointCloud2 with one point per satellite and signal."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = frame
    _encode_table(message, sample.rows, OBSERVATION_FIELDS, _field_maker(message))


def encode_corrections(sample: Corrections, message: Any) -> None:
    """Fill a PointCloud2 with one point per corrected satellite."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = 'gnss_base'
    _encode_table(message, sample.rows, CORRECTION_FIELDS, _field_maker(message))


def encode_imu(sample: ImuSample, message: Any, frame: str = 'base_link') -> None:
    """Fill a sensor_msgs/Imu in forward-left-up; it carries no orientation."""
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = frame
    w, f = sample.rate.tolist(), sample.force.tolist()
    rate, force = message.angular_velocity, message.linear_acceleration
    rate.x, rate.y, rate.z = w[0], -w[1], -w[2]
    force.x, force.y, force.z = f[0], -f[1], -f[2]
    message.orientation_covariance[0] = -1.0  # REP-145: no orientation


def ned_quaternion(q: np.ndarray) -> np.ndarray:
    """Return forward-right-down in NED from base_link (forward-left-up) in ENU, wxyz."""
    conjugate = ENU_NED * np.array([1.0, -1.0, -1.0, -1.0])
    return quat_multiply(quat_multiply(conjugate, q), FLIP * np.array([1.0, -1.0, -1.0, -1.0]))


def encode_odometry(estimate: NavigationEstimate, message: Any) -> None:
    """Fill a nav_msgs/Odometry: pose in the local ENU frame, twist in the body; covariances in those."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id, message.child_frame_id = 'map', 'base_link'
    x, y, z = estimate.enu.tolist()
    position = message.pose.pose.position
    position.x, position.y, position.z = x, y, z
    pose, twist = np.empty(36), np.empty(36)
    q, v = odometry_values(
        estimate.q_nb, estimate.velocity, estimate.covariance, float(estimate.rate_variance), pose, twist
    )
    set_quaternion(message.pose.pose.orientation, q)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z = v.tolist()
    w = estimate.rate.tolist()
    angular.x, angular.y, angular.z = w[0], -w[1], -w[2]
    message.pose.covariance = pose
    message.twist.covariance = twist


def encode_fix(estimate: FixEstimate, message: Any) -> None:
    """Fill a NavSatFix of the IMU's reference point; covariance in ENU."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = 'base_link'
    message.status.status, message.status.service = _FIX, 1
    lat, lon, height = estimate.geodetic.tolist()
    message.latitude, message.longitude, message.altitude = math.degrees(lat), math.degrees(lon), height
    message.position_covariance = estimate.covariance.ravel()
    message.position_covariance_type = _COVARIANCE_KNOWN


def encode_receiver_fix(sample: ReceiverFix, message: Any, frame: str = 'gnss') -> None:
    """Fill a NavSatFix of the antenna; without a fix the covariance is unknown."""
    encode_fix(FixEstimate(sample.stamp, sample.geodetic, sample.covariance), message)
    message.header.frame_id = frame
    message.status.status = sample.status
    message.position_covariance_type = sample.covariance_type if sample.status >= 0 else _COVARIANCE_UNKNOWN


def encode_velocity(sample: VelocitySample, message: Any) -> None:
    """Fill a TwistWithCovarianceStamped whose linear part is velocity in ENU; there is no angular part.

    Its frame is `map`, whose axes are east, north, up (REP-103); the antenna's turn with the craft.
    """
    set_stamp(message.header, sample.stamp)
    message.header.frame_id = 'map'
    set3(message.twist.twist.linear, _MAT_ENU_NED @ sample.velocity)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = _MAT_ENU_NED @ sample.covariance @ _MAT_ENU_NED.T
    covariance[3, 3] = covariance[4, 4] = covariance[5, 5] = _NOT_MEASURED
    message.twist.covariance = covariance.ravel()


def encode_biases(estimate: BiasEstimate, message: Any) -> None:
    """Fill a TwistWithCovarianceStamped: linear accelerometer bias (m/s²), angular gyro bias (rad/s)."""
    set_stamp(message.header, estimate.stamp)
    message.header.frame_id = 'base_link'
    b = estimate.values.tolist()
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z = b[0], -b[1], -b[2]
    angular.x, angular.y, angular.z = b[3], -b[4], -b[5]
    message.twist.covariance = np.diag(estimate.sigmas[:6] ** 2).ravel()


INS_GPS_PORTS = Ports(
    name='ins_gps_estimator',
    params=FilterParams,
    estimator=InsGpsEstimator,
    inputs=(
        Input('imu/data_raw', IMU, decode_imu, 'on_imu', timeout=0.5),
        Input('gnss/observations', CLOUD, decode_observations, 'on_gnss'),
        Input('gnss/corrections', CLOUD, decode_corrections, 'on_corrections'),
        Input('gnss/fix', FIX, decode_fix, 'on_position'),
        Input('gnss/velocity', TWIST, decode_velocity, 'on_velocity'),
    ),
    outputs={
        NavigationEstimate: Output('odometry', ODOMETRY, encode_odometry),
        SettledEstimate: Output('odometry_settled', ODOMETRY, encode_odometry),
        FixEstimate: Output('position', FIX, encode_fix),
        BiasEstimate: Output('imu/bias', TWIST, encode_biases),
    },
    warm=warm,
)

BASE_PORTS = Ports(
    name='dgps_base',
    params=BaseParams,
    estimator=DgpsBase,
    inputs=(
        Input('base/observations', CLOUD, decode_observations, 'on_gnss', timeout=5.0),
        Input('base/position', FIX, decode_fix, 'on_position'),
    ),
    outputs={Corrections: Output('gnss/corrections', CLOUD, encode_corrections)},
)

ESTIMATORS = {ports.name: ports for ports in (INS_GPS_PORTS, BASE_PORTS)}

NODE_PARAMETERS = {
    'uav_simulator': SimulatorParams,
    'rinex_driver': RinexParams,
    'ublox_driver': UbloxParams,
    'nmea_driver': NmeaParams,
    'rtcm_driver': RtcmParams,
}
