# SPDX-License-Identifier: Apache-2.0
"""The WGS-84 Earth: positions, local-level frames, rotation and normal gravity.

Geodetic positions are (latitude rad, longitude rad, height above the ellipsoid m). Functions on one
position take three scalars; the ``..._series`` forms take and return (N, 3) arrays and call the same
kernels. Local-level axes are named in every function: NED (north, east, down) or ENU (east, north, up).

Sources: NGA.STND.0036 (WGS-84, 2014) for the constants and eqs. 4-1 to 4-3 (normal gravity); Bowring, "The
accuracy of geodetic latitude and height equations" (1985); Groves, "Principles of GNSS, Inertial, and
Multisensor Integrated Navigation Systems" (2013), 2.4 and 5.4.1.
"""

import math

import numpy as np
from numba import njit

SEMI_MAJOR_AXIS = 6378137.0  # m, defining
FLATTENING = 1.0 / 298.257223563  # defining
GRAVITATIONAL_PARAMETER = 3.986004418e14  # m³/s², defining, atmosphere included
EARTH_RATE = 7.292115e-5  # rad/s, defining
SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)  # m
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
GRAVITY_EQUATOR = 9.7803253359  # m/s², derived, normal gravity on the ellipsoid
GRAVITY_POLE = 9.8321849379  # m/s², derived
SOMIGLIANA = SEMI_MINOR_AXIS * GRAVITY_POLE / (SEMI_MAJOR_AXIS * GRAVITY_EQUATOR) - 1.0
# ω²a²b/GM, the ratio of centrifugal to gravitational acceleration at the equator.
GRAVITY_RATIO = EARTH_RATE**2 * SEMI_MAJOR_AXIS**2 * SEMI_MINOR_AXIS / GRAVITATIONAL_PARAMETER

_SECOND_ECCENTRICITY_SQUARED = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
# Bowring's iteration gains at least two digits a turn between 5000 km deep and any height; its start is
# within 1e-8 rad near the surface.
_BOWRING_TURNS = 5


@njit(cache=True, nogil=True)
def radii(latitude):
    """Return (meridian, normal) radii of curvature [m] of the ellipsoid at `latitude` (rad)."""
    sine = math.sin(latitude)
    w2 = 1.0 - ECCENTRICITY_SQUARED * sine * sine
    normal = SEMI_MAJOR_AXIS / math.sqrt(w2)
    return normal * (1.0 - ECCENTRICITY_SQUARED) / w2, normal


@njit(cache=True, nogil=True)
def ecef_from_geodetic(latitude, longitude, height):
    """Return the ECEF position (3,) [m] of a geodetic one (rad, rad, m)."""
    normal = radii(latitude)[1]
    out = np.empty(3)
    across = (normal + height) * math.cos(latitude)
    out[0] = across * math.cos(longitude)
    out[1] = across * math.sin(longitude)
    out[2] = (normal * (1.0 - ECCENTRICITY_SQUARED) + height) * math.sin(latitude)
    return out


@njit(cache=True, nogil=True)
def geodetic_from_ecef(position):
    """Return (latitude rad, longitude rad, height m) of an ECEF position (3,) [m].

    Good to 1e-9 m from 5000 km below the ellipsoid to beyond geostationary orbit, poles included; longitude
    is 0 on the axis.
    """
    x, y, z = position[0], position[1], position[2]
    across = math.hypot(x, y)
    beta = math.atan2(z * SEMI_MAJOR_AXIS, across * SEMI_MINOR_AXIS)
    latitude = 0.0
    for _ in range(_BOWRING_TURNS):
        sine, cosine = math.sin(beta), math.cos(beta)
        latitude = math.atan2(
            z + _SECOND_ECCENTRICITY_SQUARED * SEMI_MINOR_AXIS * sine * sine * sine,
            max(across - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * cosine * cosine * cosine, 0.0),
        )
        beta = math.atan2((1.0 - FLATTENING) * math.sin(latitude), math.cos(latitude))
    sine = math.sin(latitude)
    # Well conditioned at every latitude, unlike across/cos(latitude) - normal.
    surface = SEMI_MAJOR_AXIS * math.sqrt(1.0 - ECCENTRICITY_SQUARED * sine * sine)
    height = across * math.cos(latitude) + z * sine - surface
    return latitude, math.atan2(y, x), height


@njit(cache=True, nogil=True)
def ecef_from_geodetic_series(geodetic):
    """Return ECEF positions (N, 3) [m] of geodetic ones (N, 3) [rad, rad, m]."""
    out = np.empty((geodetic.shape[0], 3))
    for i in range(geodetic.shape[0]):
        out[i] = ecef_from_geodetic(geodetic[i, 0], geodetic[i, 1], geodetic[i, 2])
    return out


@njit(cache=True, nogil=True)
def geodetic_from_ecef_series(positions):
    """Return geodetic positions (N, 3) [rad, rad, m] of ECEF ones (N, 3) [m]."""
    out = np.empty((positions.shape[0], 3))
    for i in range(positions.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = geodetic_from_ecef(positions[i])
    return out


@njit(cache=True, nogil=True)
def mat_ecef_from_ned(latitude, longitude):
    """Return the matrix (3, 3) that rotates north-east-down components to ECEF."""
    sp, cp = math.sin(latitude), math.cos(latitude)
    sl, cl = math.sin(longitude), math.cos(longitude)
    return np.array([[-sp * cl, -sl, -cp * cl], [-sp * sl, cl, -cp * sl], [cp, 0.0, -sp]])


@njit(cache=True, nogil=True)
def mat_ecef_from_enu(latitude, longitude):
    """Return the matrix (3, 3) that rotates east-north-up components to ECEF."""
    sp, cp = math.sin(latitude), math.cos(latitude)
    sl, cl = math.sin(longitude), math.cos(longitude)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])


@njit(cache=True, nogil=True)
def swap_ned_enu(vec):
    """Return a vector (3,) given in NED in ENU, or the other way round: the exchange is its own inverse."""
    return np.array([vec[1], vec[0], -vec[2]])


@njit(cache=True, nogil=True)
def enu_from_ecef(position, latitude, longitude, height):
    """Return the ECEF `position` (3,) [m] as east, north, up (3,) [m] from a geodetic origin."""
    difference = position - ecef_from_geodetic(latitude, longitude, height)
    mat = mat_ecef_from_enu(latitude, longitude)
    out = np.empty(3)
    for i in range(3):
        out[i] = mat[0, i] * difference[0] + mat[1, i] * difference[1] + mat[2, i] * difference[2]
    return out


@njit(cache=True, nogil=True)
def ecef_from_enu(enu, latitude, longitude, height):
    """Return the ECEF position (3,) [m] of east, north, up (3,) [m] from a geodetic origin."""
    mat = mat_ecef_from_enu(latitude, longitude)
    out = ecef_from_geodetic(latitude, longitude, height)
    for i in range(3):
        out[i] += mat[i, 0] * enu[0] + mat[i, 1] * enu[1] + mat[i, 2] * enu[2]
    return out


@njit(cache=True, nogil=True)
def gravity(latitude, height):
    """Return normal gravity [m/s²] (down along the ellipsoid's normal) at latitude (rad) and height (m).

    Somigliana's closed form on the ellipsoid, second-order expansion in height: within 1e-6 m/s² up to 10 km
    and 2e-4 m/s² at 100 km of the exact field of the level ellipsoid.
    """
    sine2 = math.sin(latitude) ** 2
    surface = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA * sine2) / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sine2)
    ratio = height / SEMI_MAJOR_AXIS
    linear = 2.0 * (1.0 + FLATTENING + GRAVITY_RATIO - 2.0 * FLATTENING * sine2)
    return surface * (1.0 - linear * ratio + 3.0 * ratio * ratio)


@njit(cache=True, nogil=True)
def gravity_series_formula(latitude, height):
    """Return normal gravity [m/s²] by the six-constant formula that inertial papers print.

    Its first constant is 9.7803267715 (GRS-80 at the equator); 9.7803266715, found in print, is a misprint
    of 1e-7 m/s². Kept for comparison with such papers; `gravity` is the one to use.
    Source: Schwarz and Wei, "INS/GPS integration for geodetic applications" (2000).
    """
    sine2 = math.sin(latitude) ** 2
    surface = 9.7803267715 * (1.0 + 0.0052790414 * sine2 + 0.0000232718 * sine2 * sine2)
    slope = -0.0000030876910891 + 0.0000000043977311 * sine2
    return surface + slope * height + 0.0000000000007211 * height * height


@njit(cache=True, nogil=True)
def earth_rate_ned(latitude):
    """Return the Earth's rotation (3,) [rad/s] against inertial space, in NED."""
    return np.array([EARTH_RATE * math.cos(latitude), 0.0, -EARTH_RATE * math.sin(latitude)])


@njit(cache=True, nogil=True)
def transport_rate_ned(latitude, height, velocity_ned):
    """Return the rotation (3,) [rad/s] of NED against the Earth at a velocity (3,) [m/s] in NED.

    Not defined at the poles, where north has no direction.
    """
    meridian, normal = radii(latitude)
    east = velocity_ned[1] / (normal + height)
    return np.array([east, -velocity_ned[0] / (meridian + height), -east * math.tan(latitude)])
