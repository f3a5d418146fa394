# SPDX-License-Identifier: Apache-2.0
"""GNSS side of the simulation: constellations, range errors, clock, faults, outages; and whole runs.

Source: paper 003 tables 1 and 3, with the readings that `papers.md` justifies.
"""

from __future__ import annotations

import math

import numpy as np

from ins_gps.constants import (
    EARTH_RATE,
    GPS_EPOCH_UNIX,
    SPEED_OF_LIGHT,
    WAVELENGTH_L1,
    WEEK,
)
from ins_gps.orbit import COLUMN, azimuth_elevation, ephemeris_row, range_and_rate, satellite_state
from ins_gps.samples import OBS, OBSERVATION_COLUMNS, GnssEpoch
from ins_gps.simulation import (
    NANOSECONDS,
    Clock,
    ErrorBudget,
    Run,
    Scenario,
    add_imu_errors,
    make_truth,
)
from kalman_core.earth import ecef_from_geodetic, mat_ecef_from_ned
from kalman_core.rotation import matrix_from_quat

# (azimuth, elevation) in degrees of the open-sky constellation, PDOP 2.05.
OPEN_SKY = ((0, 70), (60, 30), (130, 20), (190, 45), (250, 25), (315, 15))
_PAPER_TABLE = {
    'crs': (-5.9875e1, 6.5281e1, -8.5656e1, 4.6969e1, 6.200e1, 5.4563e1),
    'delta_n': (1.5294e-9, 1.6692e-9, 1.4644e-9, 1.4919e-9, 1.1192e-9, 1.6494e-9),
    'mean_anomaly': (-4.8401e-1, -8.7179e-1, -8.8417e-1, -8.8899e-1, -9.7589e-1, 1.1990e-1),
    'cuc': (-2.9840e-6, 3.3509e-6, -4.5337e-6, 2.4196e-6, 1.3784e-7, 2.8610e-6),
    'eccentricity': (3.7472e-3, 1.1916e-3, 6.8008e-3, 6.7628e-3, 7.8766e-3, 5.0219e-3),
    'cus': (7.8715e-6, 3.3546e-6, 6.5677e-6, 1.1941e-5, 1.1863e-5, 3.4180e-6),
    'sqrt_a': (5.1536e3, 5.1535e3, 5.1537e3, 5.1537e3, 5.1538e3, 5.1537e3),
    'week_second': (2.5198e5, 2.5200e5, 2.5200e5, 2.5200e5, 2.5200e5, 2.5200e5),
    'cic': (-2.2352e-8, -5.0291e-8, -4.4703e-8, -1.2852e-7, 7.2643e-8, -1.6764e-8),
    'ascending_node': (6.408e-1, -7.0909e-1, -3.5952e-1, 9.6454e-1, -2.7200e-1, -7.0123e-1),
    'cis': (1.3039e-7, 4.0978e-7, -1.2480e-7, -9.1270e-8, -6.8918e-8, 6.8918e-8),
    'inclination': (3.0394e-1, 3.0031e-1, 3.0513e-1, 3.0066e-1, 3.1381e-1, 3.0266e-1),
    'crc': (2.2494e2, 3.0363e2, 2.5019e2, 1.4213e2, 1.6128e2, 3.0716e2),
    'perigee': (-5.1669e-1, -2.8071e-1, -8.2533e-1, 8.2234e-1, -6.0022e-1, 5.1312e-1),
    'node_rate': (-2.5994e-9, -2.7268e-9, -2.5919e-9, -2.5278e-9, -2.3444e-9, -2.7663e-9),
}
_SEMICIRCLES = ('delta_n', 'mean_anomaly', 'ascending_node', 'inclination', 'perigee', 'node_rate')


def paper_constellation(week_start: float) -> np.ndarray:
    """Return the ephemerides (6, COLUMNS) of paper 003 table 3 in the GPS week starting at `week_start`."""
    rows = []
    for k in range(6):
        values = {
            name: column[k] * (math.pi if name in _SEMICIRCLES else 1.0)
            for name, column in _PAPER_TABLE.items()
        }
        toe = week_start + values['week_second']
        rows.append(ephemeris_row(system=0, satellite=k + 1, toe=toe, toc=toe, **values))
    return np.array(rows)


def constellation_through(directions, origin, time: float) -> np.ndarray:
    """Return circular GPS orbits that pass the given (azimuth, elevation) [deg] of `origin` at `time` (s)."""
    sqrt_a = 5153.7
    radius = sqrt_a**2
    site = ecef_from_geodetic(*origin)
    mat = mat_ecef_from_ned(origin[0], origin[1])
    rows = []
    for k, (azimuth, elevation) in enumerate(directions):
        a, e = math.radians(azimuth), math.radians(elevation)
        los = mat @ np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), -math.sin(e)])
        along = site @ los
        distance = -along + math.sqrt(along**2 + radius**2 - site @ site)
        # The signal left earlier: n·τ along the orbit is half a kilometre, of no matter for the direction.
        point = (site + distance * los) / radius
        latitude = math.asin(point[2])
        inclination = max(math.radians(55.0), abs(latitude) + math.radians(2.0))
        u = math.asin(math.sin(latitude) / math.sin(inclination))
        if k % 2:
            u = math.pi - u
        node = math.atan2(point[1], point[0]) - math.atan2(math.cos(inclination) * math.sin(u), math.cos(u))
        week_second = time % WEEK
        rows.append(
            ephemeris_row(
                system=0,
                satellite=k + 1,
                toe=time,
                toc=time,
                sqrt_a=sqrt_a,
                inclination=inclination,
                ascending_node=node + EARTH_RATE * week_second,
                mean_anomaly=u,
                week_second=week_second,
            )
        )
    return np.array(rows)


def constellation(scenario: Scenario) -> np.ndarray:
    """Return the ephemerides of a scenario: 'paper', 'open_sky', or a RINEX navigation file's path."""
    time = scenario.start / NANOSECONDS - GPS_EPOCH_UNIX
    if scenario.satellites == 'paper':
        return paper_constellation(time - time % WEEK)
    if scenario.satellites == 'open_sky':
        return constellation_through(OPEN_SKY, scenario.origin, time + 0.5 * scenario.duration)
    from ins_gps.rinex import read_navigation

    rows = read_navigation(scenario.satellites).ephemerides
    if not len(rows):
        raise ValueError(f'{scenario.satellites}: no ephemeris of GPS or Galileo')
    # Take each satellite once, and move the file's time so that the run starts at its median toe.
    _, first = np.unique(rows[:, :2], axis=0, return_index=True)
    rows = rows[first].copy()
    shift = time - np.median(rows[:, COLUMN['toe']])
    rows[:, COLUMN['toe']] += shift
    rows[:, COLUMN['toc']] += shift
    return rows


def _uniform_walk(rng, count: int, k: int, bound: float, time: float, dt: float) -> np.ndarray:
    """Return (count, k) first-order processes of σ = bound/√3, limited to ±bound."""
    out = np.empty((count, k))
    sigma = bound / math.sqrt(3.0)
    factor = math.exp(-dt / time)
    fresh = sigma * math.sqrt(1.0 - factor * factor)
    x = rng.uniform(-bound, bound, k)
    for i in range(count):
        out[i] = x
        x = factor * x + fresh * rng.standard_normal(k)
    return out


def range_errors(
    budget: ErrorBudget, count: int, satellites: int, dt: float, rng: np.random.Generator
) -> np.ndarray:
    """Return code errors (count, satellites) in m of a budget at epochs dt (s) apart."""
    k = satellites
    slow = (budget.ionosphere, budget.troposphere, budget.satellite_clock, budget.orbit)
    if budget.white:
        parts = (*slow, budget.multipath, budget.receiver, budget.selective_availability)
        return sum((rng.uniform(-1.0, 1.0, (count, k)) * p for p in parts), np.zeros((count, k)))
    errors = np.zeros((count, k))
    for bound in slow:
        errors += bound * rng.uniform(-1.0, 1.0, k)
    errors += _uniform_walk(rng, count, k, budget.multipath, budget.multipath_time, dt)
    return errors + budget.receiver * rng.uniform(-1.0, 1.0, (count, k))


def selective_availability(budget: ErrorBudget, count: int, k: int, dt: float, rng) -> np.ndarray:
    """Return the clock dither (count, k) in m of the correlated budget: second order, σ = bound/√3.

    It moves code, carrier and Doppler alike, since it is the satellite's clock.
    """
    if budget.white or budget.selective_availability <= 0.0:
        return np.zeros((count, k))
    steps = count * 10
    fine = dt / 10.0
    w = 1.0 / budget.availability_time
    # Critically damped: variance of x under unit white noise is 1/(4 w^3).
    gain = budget.selective_availability / math.sqrt(3.0) * math.sqrt(4.0 * w**3) * math.sqrt(fine)
    x = budget.selective_availability / math.sqrt(3.0) * rng.standard_normal(k)
    v = w * budget.selective_availability / math.sqrt(3.0) * rng.standard_normal(k)
    out = np.empty((count, k))
    for i in range(steps):
        if i % 10 == 0:
            out[i // 10] = x
        v += -fine * (2.0 * w * v + w * w * x) + gain * rng.standard_normal(k)
        x = x + fine * v
    return out


def clock_series(clock: Clock, count: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return (count, 2): receiver clock bias (m) and drift (m/s)."""
    out = np.empty((count, 2))
    bias, drift = clock.bias, clock.drift
    for i in range(count):
        out[i] = bias, drift
        step = clock.drift_walk * math.sqrt(dt) * rng.standard_normal()
        # Exact joint integral of the drift's random walk over the interval.
        spread = clock.drift_walk * math.sqrt(dt**3 / 12.0) * rng.standard_normal()
        bias += drift * dt + 0.5 * step * dt + spread + clock.walk * math.sqrt(dt) * rng.standard_normal()
        drift += step
    return out


def observe(scenario: Scenario, stamps, truth, true_rate, rng) -> tuple[list[GnssEpoch], np.ndarray]:
    """Return the receiver's epochs along `truth` (N + 1, NAV) at IMU stamps, and its clock (epochs, 2)."""
    eph = constellation(scenario)
    k = len(eph)
    stride = round(scenario.imu_rate / scenario.gnss_rate)
    indices = np.arange(0, len(stamps), stride)
    dt = 1.0 / scenario.gnss_rate
    budget = scenario.budget
    code_error = range_errors(budget, len(indices), k, dt, rng)
    dither = selective_availability(budget, len(indices), k, dt, rng)
    dither_rate = np.gradient(dither, dt, axis=0) if len(dither) > 1 else np.zeros_like(dither)
    clock = clock_series(scenario.clock, len(indices), dt, rng)
    walk = np.cumsum(budget.carrier_walk * math.sqrt(dt) * rng.standard_normal((len(indices), k)), axis=0)
    carrier_error = walk + budget.carrier_noise * rng.standard_normal((len(indices), k))
    doppler_error = budget.doppler_noise * rng.standard_normal((len(indices), k))
    cycles = np.round(rng.uniform(-1e5, 1e5, k))
    locked = np.zeros(k)
    epochs = []
    for e, index in enumerate(indices):
        t = (stamps[index] - scenario.start) / NANOSECONDS
        exact = _observe_exactly(eph, scenario, stamps[index], truth[index], true_rate[max(index - 1, 0)])
        visible = exact[:, 9] > scenario.mask
        for outage in scenario.outages:
            if outage.start <= t < outage.end:
                highest = np.argsort(-exact[:, 9])
                visible[highest[outage.left :]] = False
        locked = np.where(visible, locked + dt, 0.0)
        rows = np.full((k, OBSERVATION_COLUMNS), np.nan)
        rows[:, 0], rows[:, 1], rows[:, 2] = eph[:, 0], eph[:, 1], 1.0
        bias, drift = clock[e]
        offset = bias - SPEED_OF_LIGHT * exact[:, 6]
        rows[:, OBS['pseudorange']] = exact[:, 8] + offset + code_error[e] + dither[e]
        rows[:, OBS['carrier_phase']] = (
            exact[:, 8] + offset + carrier_error[e] + dither[e]
        ) / WAVELENGTH_L1 + cycles
        rate = exact[:, 10] + drift - SPEED_OF_LIGHT * exact[:, 7] + doppler_error[e] + dither_rate[e]
        rows[:, OBS['doppler']] = -rate / WAVELENGTH_L1
        rows[:, OBS['cn0']] = 45.0
        rows[:, OBS['lock_time']] = locked
        rows[:, OBS['slip']] = 0.0
        rows[:, 9:17] = exact[:, :8]
        _apply_faults(scenario, rows, t)
        stamp = int(stamps[index]) + round(scenario.gnss_offset * NANOSECONDS)
        epochs.append(GnssEpoch(stamp, rows[visible]))
    return epochs, clock


def _apply_faults(scenario: Scenario, rows: np.ndarray, t: float) -> None:
    for fault in scenario.faults:
        if not fault.start <= t < fault.end:
            continue
        column, row = OBS['pseudorange'], fault.satellite - 1
        if fault.kind == 'jump':
            rows[row, column] += fault.size
        elif fault.kind == 'ramp':
            rows[row, column] += fault.size * (t - fault.start)
        elif fault.kind == 'slip':
            rows[row, OBS['carrier_phase']] += fault.size
        else:
            raise ValueError(f'unknown fault {fault.kind!r}; known: jump, ramp, slip')


def _observe_exactly(eph, scenario: Scenario, stamp, nav, rate) -> np.ndarray:
    """Return (k, 11): satellite state (8), range, elevation, range rate at the antenna."""
    time = stamp / NANOSECONDS - GPS_EPOCH_UNIX
    mat_en = mat_ecef_from_ned(nav[0], nav[1])
    mat_nb = matrix_from_quat(nav[6:10])
    lever = np.asarray(scenario.lever_arm)
    site = ecef_from_geodetic(nav[0], nav[1], nav[2]) + mat_en @ mat_nb @ lever
    velocity = mat_en @ (nav[3:6] + mat_nb @ np.cross(rate, lever))
    out = np.empty((len(eph), 11))
    los = np.empty(3)
    for i in range(len(eph)):
        delay = 0.07
        for _ in range(4):
            satellite_state(eph[i], time - delay, out[i])
            distance, range_rate = range_and_rate(out[i], site, velocity, los)
            delay = distance / SPEED_OF_LIGHT
        out[i, 8], out[i, 10] = distance, range_rate
        out[i, 9] = azimuth_elevation(los, nav[0], nav[1])[1]
    return out


def simulate(scenario: Scenario, seed: int = 0) -> Run:
    """Return one run of a scenario; the seed decides all random errors."""
    rng = np.random.default_rng(seed)
    truth, rate, force = make_truth(
        scenario.trajectory, scenario.origin, scenario.duration, scenario.imu_rate
    )
    dt = 1.0 / scenario.imu_rate
    stamps = scenario.start + np.round(np.arange(len(truth)) * dt * NANOSECONDS).astype(np.int64)
    epochs, clock = observe(scenario, stamps, truth, rate, rng)
    w, f = add_imu_errors(rate, force, scenario.imu, dt, rng)
    return Run(stamps, truth, w, f, epochs, clock, rate)
