# SPDX-License-Identifier: Apache-2.0
"""Typed samples and estimates of the navigation graph, free of ROS.

Inside `ins_gps` level frame is NED and body forward-right-down; `codec` converts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# One row per satellite and signal; the order is that of the fields of `gnss/observations`.
OBSERVATION_FIELDS = (
    'constellation',  # 0 GPS, 1 Galileo
    'satellite',  # number within the constellation
    'signal',  # RINEX band: 1, 2, 5, 7
    'pseudorange',  # m, raw
    'carrier_phase',  # cycles, growing with range
    'doppler',  # Hz, positive when approaching
    'cn0',  # dB-Hz
    'lock_time',  # s since the phase was last lost
    'slip',  # 1: the receiver says that the phase may have slipped
    'satellite_x',  # m, ECEF at transmission
    'satellite_y',
    'satellite_z',
    'satellite_vx',  # m/s
    'satellite_vy',
    'satellite_vz',
    'satellite_clock',  # s, correction for this signal, group delay included
    'satellite_drift',  # s/s
    'ionosphere',  # m, modelled delay, NaN: not modelled
    'troposphere',  # m, modelled delay, NaN: not modelled
)
OBS = {name: index for index, name in enumerate(OBSERVATION_FIELDS)}
OBSERVATION_COLUMNS = len(OBSERVATION_FIELDS)

CORRECTION_FIELDS = (
    'constellation',
    'satellite',
    'range_correction',  # m, to be added to the pseudorange at the header's time
    'rate_correction',  # m/s
    'issue',  # issue of the ephemeris it refers to
)


class ImuSample(NamedTuple):
    """Rates (rad/s) and specific force (m/s^2), forward-right-down, mean over the time since the last."""

    stamp: int
    rate: np.ndarray
    force: np.ndarray


class GnssEpoch(NamedTuple):
    """One epoch of a receiver: rows (m, OBSERVATION_COLUMNS), NaN where not measured."""

    stamp: int
    rows: np.ndarray


class Corrections(NamedTuple):
    """DGPS corrections of one base epoch: rows (m, 5) of `CORRECTION_FIELDS`."""

    stamp: int
    rows: np.ndarray


GROUND_CORRECTIONS = 2  # STATUS_GBAS_FIX of sensor_msgs/NavSatStatus


class PositionSample(NamedTuple):
    """A fix from elsewhere: latitude, longitude (rad), height (m), covariance (3, 3) m^2 in NED.

    status as in NavSatStatus: 0 fix, 1 with a satellite's, `GROUND_CORRECTIONS` with a ground station's help.
    """

    stamp: int
    geodetic: np.ndarray
    covariance: np.ndarray
    status: int = 0


class VelocitySample(NamedTuple):
    """Velocity (3,) m/s in NED with covariance (3, 3)."""

    stamp: int
    velocity: np.ndarray
    covariance: np.ndarray


class NavigationEstimate(NamedTuple):
    """What the filter knows at `stamp`, at the reference point of the IMU.

    enu (m) relative to `origin` (rad, rad, m); velocity NED (m/s); q_nb forward-right-down to NED;
    rate: bias-free angular rate (rad/s, forward-right-down); covariance (9, 9) of position, velocity (NED)
    and attitude error (rad, NED).
    """

    stamp: int
    geodetic: np.ndarray
    origin: np.ndarray
    enu: np.ndarray
    velocity: np.ndarray
    q_nb: np.ndarray
    rate: np.ndarray
    covariance: np.ndarray
    rate_variance: float = 0.0  # (rad/s)², of each component of `rate`


class SettledEstimate(NavigationEstimate):
    """The same, the event-time window later."""

    __slots__ = ()


class FixEstimate(NamedTuple):
    """Position at a GNSS epoch for map users: geodetic (rad, rad, m) and covariance (3, 3) in ENU, m^2."""

    stamp: int
    geodetic: np.ndarray
    covariance: np.ndarray


class ReceiverFix(NamedTuple):
    """A receiver's own fix: geodetic (rad, rad, m), covariance (3, 3) in ENU, m^2.

    status as in NavSatStatus: -1 no fix, 0 fix, 1 with a satellite's, 2 with a ground station's corrections.
    covariance_type as in NavSatFix: 0 unknown, 1 approximated, 2 diagonal known, 3 known.
    """

    stamp: int
    geodetic: np.ndarray
    covariance: np.ndarray
    status: int
    covariance_type: int = 3


class BiasEstimate(NamedTuple):
    """Accelerometer (m/s²) and gyro bias (rad/s), forward-right-down, clock (m), drift (m/s); σ of all."""

    stamp: int
    values: np.ndarray
    sigmas: np.ndarray
