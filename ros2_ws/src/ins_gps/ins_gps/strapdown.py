# SPDX-License-Identifier: Apache-2.0
"""Strapdown mechanisation in north, east, down with coning and sculling corrections.

Frames: ``n`` is NED, ``b`` forward-right-down; ``q_nb`` rotates b to n. Source: paper 003 eq. 8; Savage,
"Strapdown inertial navigation integration algorithm design", JGCD 21 (1998), parts 1 and 2.
"""

import math

import numpy as np
from numba import njit

from kalman_core.earth import EARTH_RATE, gravity, radii
from kalman_core.rotation import quat_normalize

# Columns of the navigation vector: latitude, longitude (rad), height (m), velocity (m/s, NED), q_nb.
NAV = 10
# Nearer to a pole than this cosine (0.06 deg) north has no use as a direction; the rates are held there.
_LEAST_COSINE = 1e-3


@njit(cache=True, nogil=True)
def navigation_rates(latitude, height, v_n, v_e, out):
    """Fill `out` (6,) with the Earth rate and the transport rate (rad/s, NED)."""
    meridian, normal = radii(latitude)
    s, c = math.sin(latitude), max(math.cos(latitude), _LEAST_COSINE)
    out[0], out[1], out[2] = EARTH_RATE * c, 0.0, -EARTH_RATE * s
    out[3] = v_e / (normal + height)
    out[4] = -v_n / (meridian + height)
    out[5] = -v_e * s / (c * (normal + height))


@njit(cache=True, nogil=True)
def increments(rate, force, rate_before, force_before, dt, out):
    """Fill `out` (6,) with the rotation vector (rad) and velocity increment (m/s) of an interval, frame b.

    rate, force: means over this interval; *_before: over the one before (equal length assumed, for the
    correction terms only). Coning: Savage part 1 eq. 53; sculling and rotation: part 2 eq. 34, 36.
    """
    ax, ay, az = rate[0] * dt, rate[1] * dt, rate[2] * dt
    bx, by, bz = rate_before[0] * dt, rate_before[1] * dt, rate_before[2] * dt
    vx, vy, vz = force[0] * dt, force[1] * dt, force[2] * dt
    ux, uy, uz = force_before[0] * dt, force_before[1] * dt, force_before[2] * dt
    k = 1.0 / 12.0
    out[0] = ax + k * (by * az - bz * ay)
    out[1] = ay + k * (bz * ax - bx * az)
    out[2] = az + k * (bx * ay - by * ax)
    out[3] = vx + 0.5 * (ay * vz - az * vy) + k * (by * vz - bz * vy + uy * az - uz * ay)
    out[4] = vy + 0.5 * (az * vx - ax * vz) + k * (bz * vx - bx * vz + uz * ax - ux * az)
    out[5] = vz + 0.5 * (ax * vy - ay * vx) + k * (bx * vy - by * vx + ux * ay - uy * ax)


@njit(cache=True, nogil=True)
def _rotate(q, x, y, z, out):
    tx = 2.0 * (q[2] * z - q[3] * y)
    ty = 2.0 * (q[3] * x - q[1] * z)
    tz = 2.0 * (q[1] * y - q[2] * x)
    out[0] = x + q[0] * tx + q[2] * tz - q[3] * ty
    out[1] = y + q[0] * ty + q[3] * tx - q[1] * tz
    out[2] = z + q[0] * tz + q[1] * ty - q[2] * tx


@njit(cache=True, nogil=True)
def _half_exp(x, y, z, out):
    """Fill `out` (4,) with the quaternion of a small rotation vector."""
    square = x * x + y * y + z * z
    if square < 1e-8:
        w, k = 1.0 - square / 8.0, 0.5 - square / 48.0
    else:
        angle = math.sqrt(square)
        w, k = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle
    out[0], out[1], out[2], out[3] = w, k * x, k * y, k * z


@njit(cache=True, nogil=True)
def mechanise(nav, inc, dt, work):
    """Advance `nav` (NAV,) in place by dt (s) with increments `inc` (6,) of `increments`.

    work: (>=20,) scratch; on return ``work[0:3]`` is the velocity increment of specific force in n (m/s).
    Position uses the mean velocity of the interval, rates and gravity their values at its middle.
    """
    f_n = work[0:3]
    rates = work[3:9]
    q = nav[6:10]
    turn = work[9:13]
    half = 0.5 * dt
    meridian, normal = radii(nav[0])
    c = max(math.cos(nav[0]), _LEAST_COSINE)
    mid_lat = nav[0] + half * nav[3] / (meridian + nav[2])
    mid_h = nav[2] - half * nav[5]
    _rotate(q, inc[3], inc[4], inc[5], f_n)
    # Velocity at the middle, first order: enough for the Earth terms, which are 1e-4 of the rest.
    m_n, m_e, m_d = nav[3] + 0.5 * f_n[0], nav[4] + 0.5 * f_n[1], nav[5]
    navigation_rates(mid_lat, mid_h, m_n, m_e, rates)
    zn, ze, zd = (rates[0] + rates[3]) * dt, (rates[1] + rates[4]) * dt, (rates[2] + rates[5]) * dt
    # n turns while the force acts: half of its rotation applies to the increment.
    fx, fy, fz = f_n[0], f_n[1], f_n[2]
    f_n[0] = fx - 0.5 * (ze * fz - zd * fy)
    f_n[1] = fy - 0.5 * (zd * fx - zn * fz)
    f_n[2] = fz - 0.5 * (zn * fy - ze * fx)
    wn, we, wd = 2.0 * rates[0] + rates[3], 2.0 * rates[1] + rates[4], 2.0 * rates[2] + rates[5]
    g = gravity(mid_lat, mid_h)
    dn = f_n[0] - dt * (we * m_d - wd * m_e)
    de = f_n[1] - dt * (wd * m_n - wn * m_d)
    dd = f_n[2] - dt * (wn * m_e - we * m_n) + dt * g
    v_n, v_e, v_d = nav[3] + 0.5 * dn, nav[4] + 0.5 * de, nav[5] + 0.5 * dd
    nav[3] += dn
    nav[4] += de
    nav[5] += dd
    h_before = nav[2]
    nav[2] -= dt * v_d
    h_mid = 0.5 * (h_before + nav[2])
    nav[0] += dt * v_n / (meridian + h_mid)
    _, normal = radii(mid_lat)
    c = max(math.cos(mid_lat), _LEAST_COSINE)
    nav[1] += dt * v_e / ((normal + h_mid) * c)
    if nav[1] >= math.pi:
        nav[1] -= 2.0 * math.pi
    elif nav[1] < -math.pi:
        nav[1] += 2.0 * math.pi
    _half_exp(inc[0], inc[1], inc[2], turn)
    a0, a1, a2, a3 = q[0], q[1], q[2], q[3]
    b0 = a0 * turn[0] - a1 * turn[1] - a2 * turn[2] - a3 * turn[3]
    b1 = a0 * turn[1] + a1 * turn[0] + a2 * turn[3] - a3 * turn[2]
    b2 = a0 * turn[2] - a1 * turn[3] + a2 * turn[0] + a3 * turn[1]
    b3 = a0 * turn[3] + a1 * turn[2] - a2 * turn[1] + a3 * turn[0]
    _half_exp(-zn, -ze, -zd, turn)
    q[0] = turn[0] * b0 - turn[1] * b1 - turn[2] * b2 - turn[3] * b3
    q[1] = turn[0] * b1 + turn[1] * b0 + turn[2] * b3 - turn[3] * b2
    q[2] = turn[0] * b2 - turn[1] * b3 + turn[2] * b0 + turn[3] * b1
    q[3] = turn[0] * b3 + turn[1] * b2 - turn[2] * b1 + turn[3] * b0
    q[:] = quat_normalize(q)


@njit(cache=True, nogil=True)
def mechanise_series(nav, rates, forces, dt):
    """Integrate means of rate and specific force (N, 3) over N intervals of dt (s) from `nav` (NAV,).

    Returns (N + 1, NAV) with the start in row 0; `nav` is left as it is.
    """
    n = rates.shape[0]
    out = np.empty((n + 1, NAV))
    state = nav.copy()
    out[0] = state
    inc = np.empty(6)
    work = np.empty(20)
    for i in range(n):
        j = max(i - 1, 0)
        increments(rates[i], forces[i], rates[j], forces[j], dt, inc)
        mechanise(state, inc, dt, work)
        out[i + 1] = state
    return out
