# SPDX-License-Identifier: Apache-2.0
"""Figures on recordings of others: code fix, carrier-difference velocity, walk, drive, drop-outs."""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from ins_gps.batch import run_batch
from ins_gps.channels import corrected_range
from ins_gps.constants import SPEED_OF_LIGHT, WAVELENGTH_L1
from ins_gps.dgps import DgpsBase
from ins_gps.doctor import time_offset
from ins_gps.filter import NavigationFilter
from ins_gps.fix import solve_position, solve_velocity
from ins_gps.orbit import range_and_rate
from ins_gps.params import BaseParams, FilterParams
from ins_gps.recordings import gnss_epochs, read_drive_imu, read_track, read_walk_imu
from ins_gps.samples import GROUND_CORRECTIONS, ImuSample, PositionSample
from ins_gps.simulation import HG1700, add_imu_errors
from ins_gps.smoother import Smoother
from ins_gps.solution import error_of
from ins_gps.strapdown import navigation_rates
from kalman_core.earth import ecef_from_geodetic, geodetic_from_ecef, gravity, mat_ecef_from_ned
from kalman_core.rotation import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    rotvec_from_quat,
)

SECOND = 1_000_000_000


def data_folder() -> Path | None:
    """Return the folder of recordings, or None where it is missing."""
    root = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ins'
    return root if root.is_dir() else None


def code_fix(epoch, start=None):
    """Return the least-squares fix of an epoch's first-signal codes, modelled delays removed."""
    rows = epoch.rows[epoch.rows[:, 2] == 1.0]
    ranges = (
        rows[:, 3] + SPEED_OF_LIGHT * rows[:, 15] - np.nan_to_num(rows[:, 17]) - np.nan_to_num(rows[:, 18])
    )
    return solve_position(rows[:, 9:15], ranges, np.ones(len(rows)), rows[:, 0], start)


def carrier_velocity(before, now, position_before, position) -> np.ndarray | None:
    """Return the mean ECEF velocity (3,) between two epochs from carrier differences, or None.

    Solves for the displacement between known-to-metres positions; exact for the range difference.
    """
    common = {(r[0], r[1]): r for r in before.rows if r[2] == 1.0}
    dt = (now.stamp - before.stamp) / SECOND
    rows, residuals = [], []
    los, zero = np.empty(3), np.zeros(3)
    for row in now.rows[now.rows[:, 2] == 1.0]:
        old = common.get((row[0], row[1]))
        if old is None or not math.isfinite(row[4] + old[4] + row[9] + old[9]) or row[8] > 0.0:
            continue
        change = (row[4] - old[4]) * WAVELENGTH_L1 + SPEED_OF_LIGHT * (row[15] - old[15])
        first = range_and_rate(old[9:15], position_before, zero, los)[0]
        second = range_and_rate(row[9:15], position, zero, los)[0]
        residuals.append(change - (second - first))
        rows.append([*(-los), 1.0])
    if len(rows) < 5:
        return None
    A, b = np.array(rows), np.array(residuals)
    used = np.ones(len(b), bool)
    for _ in range(len(b) - 5):
        x = np.linalg.lstsq(A[used], b[used], rcond=None)[0]
        off = np.abs(b - A @ x)
        off[~used] = 0.0
        if off.max() < 0.05:
            break
        used[np.argmax(off)] = False
    x = np.linalg.lstsq(A[used], b[used], rcond=None)[0]
    return (position - position_before + x[:3]) / dt


def spirent(root: Path) -> dict[str, float]:
    """Return mean code fix error (m) and carrier-difference velocity error (m/s) on the exact simulator."""
    folder = root / 'spirent_iono_none'
    navigation = (folder / 'RINEX_GN_Spirent.23N', folder / 'RINEX_EN_Spirent.23L')
    epochs = gnss_epochs(folder / 'Rover-dynamic_MO_Spirent.obs', navigation, atmosphere=False)
    truth = np.loadtxt(folder / 'Rover-dynamic_PVA_Spirent.csv', delimiter=',', skiprows=1)[::10]
    position = truth[:, 4:7]
    fixes = [code_fix(epoch).position for epoch in epochs]
    fix_errors = np.linalg.norm(np.array(fixes) - position[: len(fixes)], axis=1)
    velocity_errors = []
    for k in range(1, len(epochs)):
        v = carrier_velocity(epochs[k - 1], epochs[k], fixes[k - 1], fixes[k])
        velocity_errors.append(np.linalg.norm(v - (position[k] - position[k - 1])))
    return {'fix': float(fix_errors.mean()), 'velocity': float(np.mean(velocity_errors))}


def spirent_motion(root: Path):
    """Return stamps (n,), truth (n, 10) and exact mean rate and force (n - 1, 3) of the simulator's rover."""
    path = root / 'spirent_iono_none' / 'Rover-dynamic_motion_Spirent.csv'
    data = np.loadtxt(path, delimiter=',', skiprows=2)
    truth = np.empty((len(data), 10))
    for i, row in enumerate(data):
        truth[i, :3] = geodetic_from_ecef(row[1:4])
        mat = mat_ecef_from_ned(truth[i, 0], truth[i, 1])
        truth[i, 3:6] = mat.T @ row[4:7]
        truth[i, 6:] = quat_from_euler(row[18], row[17], row[16])
    n, dt = len(data) - 1, 0.1
    rate, force = np.empty((n, 3)), np.empty((n, 3))
    rates = np.empty(6)
    for i in range(n):
        a, b = truth[i], truth[i + 1]
        v = 0.5 * (a[3:6] + b[3:6])
        navigation_rates(0.5 * (a[0] + b[0]), 0.5 * (a[2] + b[2]), v[0], v[1], rates)
        turn = rotvec_from_quat(quat_multiply(quat_conjugate(a[6:]), b[6:])) / dt
        middle = matrix_from_quat(quat_multiply(a[6:], quat_from_rotvec(0.5 * dt * turn)))
        rate[i] = turn + middle.T @ (rates[:3] + rates[3:])
        g = np.array([0.0, 0.0, gravity(a[0], a[2])])
        force[i] = middle.T @ ((b[3:6] - a[3:6]) / dt + np.cross(2.0 * rates[:3] + rates[3:], v) - g)
    return data[:, 0] * 1e-3, truth, rate, force


def spirent_tight(root: Path, seed: int) -> dict[str, float]:
    """Return error and consistency of the tight filter on the simulator's rover with a made HG1700."""
    folder = root / 'spirent_iono_none'
    navigation = (folder / 'RINEX_GN_Spirent.23N', folder / 'RINEX_EN_Spirent.23L')
    epochs = gnss_epochs(folder / 'Rover-dynamic_MO_Spirent.obs', navigation, atmosphere=False)
    seconds, truth, rate, force = spirent_motion(root)
    stamps = epochs[0].stamp + np.round(seconds * SECOND).astype(np.int64)
    rng = np.random.default_rng(seed)
    w, f = add_imu_errors(rate, force, HG1700, 0.1, rng)
    params = FilterParams(
        gyro_noise=HG1700.gyro_noise, accel_noise=HG1700.accel_noise, gyro_bias_walk=0.0, accel_bias_walk=0.0,
        gyro_bias_sigma=HG1700.gyro_bias, accel_bias_sigma=HG1700.accel_bias, code_noise=0.002, code_slow=0.0,
        code_slow_alone=0.0, code_multipath=0.0, carrier_noise=0.0005, carrier_walk=0.0001,
        doppler_noise=0.001, elevation_weighting=False, alignment='given', channels=24, imu_gap=0.5,
    )  # fmt: skip
    navigation_filter = NavigationFilter(params)
    navigation_filter.initialise(int(stamps[0]), truth[0], np.r_[[1.0] * 3, [0.1] * 3, [0.01] * 3])
    history = run_batch(navigation_filter, stamps[1:], w, f, epochs)
    index = np.minimum(np.searchsorted(stamps, history.stamps), len(truth) - 1)
    errors = np.array([error_of(n, truth[i]) for n, i in zip(history.nav, index, strict=True)])[30:]
    sigma = np.sqrt(np.einsum('kii->ki', history.covariance))[30:]
    return {
        'position': float(np.linalg.norm(errors[:, :3], axis=1).mean()),
        'velocity': float(np.linalg.norm(errors[:, 3:6], axis=1).mean()),
        'within': float(np.mean(np.abs(errors[:, :3]) <= 3.0 * sigma[:, :3])),
        'rejected': float(sum(sum(t.rejected.values()) for t in navigation_filter.tally.sensors.values())),
    }


def static(root: Path) -> dict[str, float]:
    """Return carrier and Doppler velocity noise (m/s) and the DGPS fix error (m) of two fixed receivers."""
    folder = root / 'matrtklib_static'
    base_at, rover_at = (np.loadtxt(folder / f'{name}_position.txt') for name in ('base', 'rover'))
    truth = ecef_from_geodetic(math.radians(rover_at[0]), math.radians(rover_at[1]), rover_at[2])
    navigation = (folder / 'base.nav',)
    base_epochs = gnss_epochs(folder / 'base.obs', navigation)
    rover_epochs = gnss_epochs(folder / 'rover.obs', navigation)
    base = DgpsBase(BaseParams(position=tuple(base_at), elevation_mask=math.radians(10.0)))
    corrections = [c for c in map(base.on_gnss, base_epochs) if c is not None]
    navigation_filter = NavigationFilter(FilterParams())
    errors, plain, given = [], [], 0
    for epoch in rover_epochs:
        while given < len(corrections) and corrections[given].stamp <= epoch.stamp:
            navigation_filter.corrections(corrections[given])
            given += 1
        navigation_filter.gnss(epoch)
        errors.append(ecef_from_geodetic(*navigation_filter.nav[:3]) - truth)
        state, config = navigation_filter.state, navigation_filter.config
        ranges = np.array(
            [corrected_range(state, navigation_filter.channels, config, row) for row in epoch.rows]
        )
        known = ranges[:, 2] > 0.0
        rows = epoch.rows[known]
        fix = solve_position(rows[:, 9:15], ranges[known, 0], _zenith_weights(rows, truth), rows[:, 0])
        plain.append(fix.position - truth)
    errors = np.array(errors)
    carrier, doppler = [], []
    for before, now in itertools.pairwise(rover_epochs):
        v = carrier_velocity(before, now, truth, truth)
        if v is not None:
            carrier.append(v)
        rows = now.rows
        rates = -rows[:, 5] * WAVELENGTH_L1 + SPEED_OF_LIGHT * rows[:, 16]
        fix = solve_velocity(rows[:, 9:15], rates, np.full(len(rows), 0.3), rows[:, 0], truth)
        doppler.append(fix.position)
    return {
        'carrier': float(np.sqrt(np.mean(np.square(carrier)))),
        'doppler': float(np.sqrt(np.mean(np.square(doppler)))),
        'dgps': float(np.linalg.norm(errors[30:], axis=1).mean()),
        'fix': float(np.linalg.norm(plain, axis=1).mean()),
    }


def _zenith_weights(rows, site) -> np.ndarray:
    los, up = np.empty(3), site / np.linalg.norm(site)
    out = np.empty(len(rows))
    for i, row in enumerate(rows):
        range_and_rate(row[9:15], site, np.zeros(3), los)
        out[i] = 1.0 / max(0.1, float(los @ up))
    return out


def walk(root: Path) -> dict[str, float]:
    """Return the errors (m) of the recorded walk from a known stand, and of the corrected code alone.

    The first 10 s, standing, are the reference station: their position is known and gives both the range
    corrections (held for the minute) and the start.
    """
    folder = root / 'gnss_imu_walk_60s'
    imu, track = read_walk_imu(folder / 'imu_60s.csv'), read_track(folder / 'reference_rtk_60s.pos')
    epochs = gnss_epochs(folder / 'walk_60s.obs', (folder / 'walk.nav',))
    stand = track.geodetic[:40].mean(axis=0)
    degrees = (math.degrees(stand[0]), math.degrees(stand[1]), float(stand[2]))
    # The reference track's own base is off by tens of metres: the check of the base's position is told so.
    base = DgpsBase(BaseParams(position=degrees, position_limit=100.0))
    code, navigation = (
        NavigationFilter(FilterParams(mode='gps', correction_age=100.0)),
        NavigationFilter(FilterParams(correction_age=100.0)),
    )
    errors, plain, done = [], [], 0
    for k, epoch in enumerate(epochs):
        while done < len(imu.stamps) and imu.stamps[done] <= epoch.stamp:
            navigation.imu(ImuSample(int(imu.stamps[done]), imu.rate[done], imu.force[done]))
            done += 1
        standing = track.stamps[k] - track.stamps[0] < 10 * SECOND
        correction = base.on_gnss(epoch) if standing else None
        if correction is not None:
            navigation.corrections(correction)
            code.corrections(correction)
        if standing:
            navigation.position(PositionSample(epoch.stamp, stand, np.eye(3) * 0.05**2, GROUND_CORRECTIONS))
        navigation.gnss(epoch)
        code.gnss(epoch)
        if track.stamps[k] - track.stamps[0] > 20 * SECOND:
            for what, out in ((navigation, errors), (code, plain)):
                reference = np.r_[track.geodetic[k], track.velocity[k], what.nav[6:]]
                out.append(error_of(what.nav, reference))
    e, p = np.array(errors), np.array(plain)
    sigma = np.sqrt(np.maximum(np.diag(navigation.covariance)[:3], 0.0))
    carrier = navigation.tally.sensor('gnss/carrier')
    return {
        'horizontal': float(np.linalg.norm(e[:, :2], axis=1).mean()),
        'position': float(np.linalg.norm(e[:, :3], axis=1).mean()),
        'code': float(np.linalg.norm(p[:, :3], axis=1).mean()),
        'sigmas': float(np.max(np.abs(e[-1, :3]) / sigma)),
        'slips': float(sum(carrier.rejected.values())),
    }


def drive(root: Path, outage: float = 60.0, **changes) -> dict[str, float]:
    """Return errors (m) and NEES (3 expected) of position in the outages of the loosely coupled drive.

    end: filtered, at the end; smoothed: largest. The logger's clock is unknown: its offset comes from
    `doctor.time_offset`. `changes`: of the filter's parameters.
    """
    folder = root / 'gnss_imu_drive'
    track = read_track(folder / 'gnss_1934_sf.pos')
    imu = read_drive_imu(folder / 'imu_1934.csv')
    imu = read_drive_imu(folder / 'imu_1934.csv', int(track.stamps[0] - imu.stamps[0]))
    offset, _ = time_offset(imu.stamps, imu.rate, track.stamps, track.velocity, limit=10.0)
    stamps = imu.stamps + round(offset * SECOND)
    seconds = (track.stamps - track.stamps[0]) / SECOND
    params = FilterParams(
        mode='loose', accel_bias_sigma=0.3, gyro_bias_sigma=0.02, initial_tilt_sigma=0.05, channels=4,
        gyro_noise=3e-4, accel_noise=1e-2, gyro_bias_walk=2e-5, accel_bias_walk=5e-4,
    )  # fmt: skip
    ends, smoothed, nees = [], [], []
    for start in (120.0, 240.0, 360.0, 450.0):
        hidden = (seconds >= start) & (seconds < start + outage)
        samples = [
            PositionSample(int(t), g, np.diag([0.05, 0.05, 0.1]) ** 2, GROUND_CORRECTIONS)
            for t, g, h in zip(track.stamps, track.geodetic, hidden, strict=True)
            if not h
        ]
        run = Smoother(replace(params, **changes), interval=0.5).run(stamps, imu.rate, imu.force, samples)
        t = (run.stamps - track.stamps[0]) / SECOND
        inside = np.flatnonzero((t >= start) & (t < start + outage - 0.3))
        errors = {
            what: np.array([_off_track(track, run.stamps[k], nav[k]) for k in inside])
            for what, nav in (('filtered', run.filtered), ('smoothed', run.smoothed))
        }
        e, P = errors['filtered'], run.filtered_covariance[inside][:, :3, :3]
        ends.append(np.linalg.norm(e[-1]))
        smoothed.append(np.linalg.norm(errors['smoothed'], axis=1).max())
        nees.append(np.mean(np.einsum('ki,ki->k', e, np.linalg.solve(P, e[..., None])[..., 0])))
    return {'end': float(np.mean(ends)), 'smoothed': float(np.mean(smoothed)), 'nees': float(np.mean(nees))}


def _off_track(track, stamp: int, nav) -> np.ndarray:
    """Return the position error (3,) m of `nav` against the track between its points."""
    geodetic = [np.interp(stamp, track.stamps, track.geodetic[:, i]) for i in range(3)]
    return error_of(nav, np.r_[geodetic, nav[3:]])[:3]
