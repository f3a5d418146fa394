# SPDX-License-Identifier: Apache-2.0
"""Broadcast ephemeris to satellite position, velocity and clock at transmit time.

Frames: ``e`` is Earth-fixed at the instant of transmission; `range_and_rate` turns it by the signal's
travel time (Sagnac). Times are continuous GPS seconds since 1980-01-06.
Sources: IS-GPS-200N tables 20-III and 20-IV and section 20.3.3.3.3; IS-GPS-705 section 20.3.3.3.1;
Galileo OS SIS ICD 2.1 section 5.1.
"""

import math

import numpy as np
from numba import njit

from ins_gps.constants import EARTH_RATE, GALILEO, GALILEO_MU, GPS_MU, SPEED_OF_LIGHT

# Columns of an ephemeris row; times in s, angles in rad, rates in rad/s, lengths in m. `group_delay` is that
# of the pair the clock belongs to: TGD, BGD(E1,E5a) for F/NAV, BGD(E1,E5b) for I/NAV. `delay_5` and `delay_7`
# are those of the first signal with L5 or E5a, and with E5b.
EPHEMERIS_FIELDS = (
    'system',
    'satellite',
    'toe',
    'toc',
    'af0',
    'af1',
    'af2',
    'group_delay',
    'sqrt_a',
    'eccentricity',
    'inclination',
    'ascending_node',
    'perigee',
    'mean_anomaly',
    'delta_n',
    'inclination_rate',
    'node_rate',
    'cuc',
    'cus',
    'crc',
    'crs',
    'cic',
    'cis',
    'week_second',
    'health',
    'accuracy',
    'issue',
    'delay_5',
    'delay_7',
)
COLUMN = {name: index for index, name in enumerate(EPHEMERIS_FIELDS)}
COLUMNS = len(EPHEMERIS_FIELDS)
# Newton on Kepler's equation converges quadratically: from E = M four steps reach 1e-15 for e < 0.03.
_KEPLER_STEPS = 6


@njit(cache=True, nogil=True)
def satellite_state(eph, time, out):
    """Fill `out` (8,) with position (m), velocity (m/s), clock (s) and clock drift (s/s) at `time`.

    eph: one row of `EPHEMERIS_FIELDS`; time: GPS time of transmission (s). The clock is the correction for
    a single-frequency user of the first signal: polynomial + relativity − group delay.
    """
    mu = GALILEO_MU if eph[0] == GALILEO else GPS_MU
    tk = time - eph[2]
    a = eph[8] * eph[8]
    ecc = eph[9]
    n = math.sqrt(mu / (a * a * a)) + eph[14]
    mean = eph[13] + n * tk
    anomaly = mean
    for _ in range(_KEPLER_STEPS):
        anomaly -= (anomaly - ecc * math.sin(anomaly) - mean) / (1.0 - ecc * math.cos(anomaly))
    sin_e, cos_e = math.sin(anomaly), math.cos(anomaly)
    anomaly_dot = n / (1.0 - ecc * cos_e)
    root = math.sqrt(1.0 - ecc * ecc)
    phi = math.atan2(root * sin_e, cos_e - ecc) + eph[12]
    phi_dot = root * anomaly_dot / (1.0 - ecc * cos_e)
    s2, c2 = math.sin(2.0 * phi), math.cos(2.0 * phi)
    u = phi + eph[18] * s2 + eph[17] * c2
    r = a * (1.0 - ecc * cos_e) + eph[20] * s2 + eph[19] * c2
    inc = eph[10] + eph[15] * tk + eph[22] * s2 + eph[21] * c2
    u_dot = phi_dot * (1.0 + 2.0 * (eph[18] * c2 - eph[17] * s2))
    r_dot = a * ecc * sin_e * anomaly_dot + 2.0 * phi_dot * (eph[20] * c2 - eph[19] * s2)
    inc_dot = eph[15] + 2.0 * phi_dot * (eph[22] * c2 - eph[21] * s2)
    node_dot = eph[16] - EARTH_RATE
    node = eph[11] + node_dot * tk - EARTH_RATE * eph[23]
    sin_u, cos_u = math.sin(u), math.cos(u)
    sin_n, cos_n = math.sin(node), math.cos(node)
    sin_i, cos_i = math.sin(inc), math.cos(inc)
    x, y = r * cos_u, r * sin_u
    x_dot = r_dot * cos_u - y * u_dot
    y_dot = r_dot * sin_u + x * u_dot
    out[0] = x * cos_n - y * cos_i * sin_n
    out[1] = x * sin_n + y * cos_i * cos_n
    out[2] = y * sin_i
    plane = y_dot * cos_i - y * sin_i * inc_dot
    out[3] = x_dot * cos_n - plane * sin_n - out[1] * node_dot
    out[4] = x_dot * sin_n + plane * cos_n + out[0] * node_dot
    out[5] = y_dot * sin_i + y * cos_i * inc_dot
    tc = time - eph[3]
    relativity = -2.0 * math.sqrt(mu) / (SPEED_OF_LIGHT * SPEED_OF_LIGHT) * ecc * eph[8]
    out[6] = eph[4] + (eph[5] + eph[6] * tc) * tc + relativity * sin_e - eph[7]
    out[7] = eph[5] + 2.0 * eph[6] * tc + relativity * cos_e * anomaly_dot


@njit(cache=True, nogil=True)
def satellite_at_reception(eph, time, pseudorange, out):
    """Fill `out` (8,) as `satellite_state` for the signal received at `time` (receiver clock, s).

    Transmission = reception − pseudorange/c − satellite clock, both in the receiver's time tag, so the
    receiver clock error drops out. pseudorange in m, raw.
    """
    sent = time - pseudorange / SPEED_OF_LIGHT
    satellite_state(eph, sent, out)
    # The code is stamped by the satellite's clock without the group delay that `out[6]` contains.
    satellite_state(eph, sent - (out[6] + eph[7]), out)


@njit(cache=True, nogil=True)
def other_band_clock(eph, signal, ratio):
    """Return what to add to the clock (s) of the first signal for the signal of RINEX band `signal`.

    ratio: (f_1/f_signal)². With B the group delay of the two signals the later one lags by (ratio − 1) B,
    whichever pair the broadcast clock belongs to. No ISC of L5 is read: it counts as 0.
    """
    if signal == 5.0:
        return (1.0 - ratio) * eph[27]
    if signal == 7.0:
        return (1.0 - ratio) * eph[28]
    return (1.0 - ratio) * eph[7]


@njit(cache=True, nogil=True)
def satellites_at_reception(ephemerides, times, pseudoranges, out):
    """`satellite_at_reception` for m satellites: (m, COLUMNS), (m,), (m,), out (m, 8)."""
    for i in range(len(times)):
        satellite_at_reception(ephemerides[i], times[i], pseudoranges[i], out[i])


@njit(cache=True, nogil=True)
def range_and_rate(satellite, position, velocity, out):
    """Return geometric range (m) and range rate (m/s); fill `out` (3,) with the line of sight.

    satellite: (>=6,) position and velocity at transmission, frame of transmission; position, velocity: (3,)
    ECEF of the receiver at reception. The line of sight points from receiver to satellite, frame of
    reception. The rate is d(range)/d(reception time), with the satellite seen retarded.
    """
    sx, sy, sz = satellite[0], satellite[1], satellite[2]
    x, y = sx, sy
    distance = 0.0
    # The Earth turns by 1e-5 rad during the flight: two passes leave under 1e-9 m.
    for _ in range(3):
        dx, dy, dz = x - position[0], y - position[1], sz - position[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        turn = EARTH_RATE * distance / SPEED_OF_LIGHT
        c, s = math.cos(turn), math.sin(turn)
        x, y = c * sx + s * sy, c * sy - s * sx
    dx, dy, dz = x - position[0], y - position[1], sz - position[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    out[0], out[1], out[2] = dx / distance, dy / distance, dz / distance
    vx = c * satellite[3] + s * satellite[4]
    vy = c * satellite[4] - s * satellite[3]
    along = out[0] * vx + out[1] * vy + out[2] * satellite[5]
    receiver = out[0] * velocity[0] + out[1] * velocity[1] + out[2] * velocity[2]
    turning = EARTH_RATE * (out[0] * y - out[1] * x)
    rate = (along - receiver) / (1.0 + (along - turning) / SPEED_OF_LIGHT)
    return distance, rate


@njit(cache=True, nogil=True)
def azimuth_elevation(line_of_sight, latitude, longitude):
    """Return azimuth (rad, clockwise from north) and elevation (rad) of a line of sight (3,) in ECEF."""
    sl, cl = math.sin(latitude), math.cos(latitude)
    so, co = math.sin(longitude), math.cos(longitude)
    x, y, z = line_of_sight[0], line_of_sight[1], line_of_sight[2]
    north = -sl * co * x - sl * so * y + cl * z
    east = -so * x + co * y
    up = cl * co * x + cl * so * y + sl * z
    return math.atan2(east, north), math.asin(min(1.0, max(-1.0, up)))


def ephemeris_row(**values: float) -> np.ndarray:
    """Return one ephemeris row (COLUMNS,) from named fields; those not named are 0.

    Galileo's delays of E5a and E5b differ by a nanosecond or so: one that is not named is `group_delay`.
    """
    row = np.zeros(COLUMNS)
    if values.get('system') == GALILEO:
        row[[COLUMN['delay_5'], COLUMN['delay_7']]] = values.get('group_delay', 0.0)
    for name, value in values.items():
        row[COLUMN[name]] = value
    return row


def select_ephemeris(ephemerides: np.ndarray, system: int, satellite: int, time: float) -> int:
    """Return the index of the healthy row of this satellite whose toe is nearest to `time`, or -1.

    A row is usable within 2 h of its toe for GPS and 4 h for Galileo (interface documents' fit intervals
    with one upload missed).
    """
    best, best_age = -1, 14_400.0 if system == GALILEO else 7_201.0
    for index in range(len(ephemerides)):
        row = ephemerides[index]
        if row[0] != system or row[1] != satellite or row[COLUMN['health']] != 0.0:
            continue
        age = abs(time - row[2])
        if age < best_age:
            best, best_age = index, age
    return best
