# SPDX-License-Identifier: Apache-2.0
"""Says in plain words what is wrong with IMU and GNSS data: the mistakes users make before any filter runs.

Checks: rate and gaps, units (g, °/s), increments instead of rates, axis sense, time offset between IMU and
GNSS, missing ephemerides, a base at the wrong place. Frames: forward-right-down and NED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ins_gps.samples import GnssEpoch

NANOSECONDS = 1_000_000_000
GRAVITY = 9.81  # m/s²
ERROR, WARN, INFO = 'error', 'warning', 'info'
_GRID = 0.02  # s, resolution of the time-offset search before interpolation
_LEAST_TURN = 0.03  # rad/s RMS of the course rate below which a time offset cannot be seen
_LEAST_CORRELATION = 0.6
_OFFSET_LIMIT = 0.05  # s, offsets beyond are reported as an error


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding: how bad, which check, and a sentence."""

    level: str
    check: str
    text: str


def check_imu(stamps: np.ndarray, rate: np.ndarray, force: np.ndarray) -> list[Finding]:
    """Check an IMU: stamps (n,) ns, rate (n, 3) and force (n, 3) as they claim to be (rad/s, m/s²)."""
    findings = []
    if len(stamps) < 10:
        return [Finding(ERROR, 'imu', f'only {len(stamps)} IMU samples')]
    steps = np.diff(stamps) / NANOSECONDS
    step = float(np.median(steps))
    if step <= 0.0:
        return [Finding(ERROR, 'imu stamps', 'IMU stamps do not increase')]
    findings.append(Finding(INFO, 'imu rate', f'IMU at {1.0 / step:.1f} Hz for {steps.sum():.0f} s'))
    if (steps <= 0.0).any():
        findings.append(Finding(ERROR, 'imu stamps', f'{(steps <= 0).sum()} IMU stamps repeat or go back'))
    gaps = steps > 3.0 * step
    if gaps.any():
        text = f'{gaps.sum()} gaps in the IMU, the longest {steps.max():.2f} s'
        findings.append(Finding(WARN, 'imu gaps', text))
    bad = ~(np.isfinite(rate).all(axis=1) & np.isfinite(force).all(axis=1))
    if bad.any():
        findings.append(Finding(ERROR, 'imu values', f'{bad.sum()} IMU samples are not finite'))
        rate, force = rate[~bad], force[~bad]
    return findings + _units(rate, force, step) + _axes(force)


def _units(rate: np.ndarray, force: np.ndarray, step: float) -> list[Finding]:
    out = []
    norm = float(np.median(np.linalg.norm(force, axis=1)))
    for scale, what in ((1.0, 'm/s²'), (GRAVITY, 'g'), (1e-3 * GRAVITY, 'mg'), (1.0 / step, 'increments')):
        if 0.8 * GRAVITY < norm * scale < 1.25 * GRAVITY:
            if what == 'increments':
                text = (
                    'specific force looks like velocity increments (m/s per sample): divide by the interval'
                )
                out.append(Finding(ERROR, 'force units', text))
            elif what != 'm/s²':
                text = f'specific force looks like {what}, expected m/s²'
                out.append(Finding(ERROR, 'force units', text))
            break
    else:
        text = f'median specific force is {norm:.3g}, expected about 9.81 m/s²'
        out.append(Finding(ERROR, 'force units', text))
    fast = float(np.percentile(np.abs(rate), 99.5))
    if fast > 20.0:
        text = f'angular rates reach {fast:.0f}: they look like °/s, expected rad/s'
        out.append(Finding(ERROR, 'rate units', text))
    return out


def _axes(force: np.ndarray) -> list[Finding]:
    mean = force.mean(axis=0)
    norm = np.linalg.norm(mean)
    if norm == 0.0:
        return []
    down = -mean[2] / norm
    if down > 0.7:
        return []
    axis = int(np.argmax(np.abs(mean)))
    sign = '+' if mean[axis] > 0 else '−'
    name = ['forward', 'right', 'down'][axis]
    text = (
        f'gravity shows as {sign} on the {name} axis; at rest the down axis must measure −9.81 (base_link: '
        'z up +9.81): the sensor is turned or its sign is inverted'
    )
    return [Finding(ERROR, 'axes', text)]


def course_rate(stamps: np.ndarray, velocity: np.ndarray, least_speed: float = 1.0):
    """Return mid times (k,) s from the first stamp and course rate (k,) rad/s of velocity NED (n, 3)."""
    t = (stamps - stamps[0]) / NANOSECONDS
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    rate = np.diff(course) / np.diff(t)
    keep = (np.minimum(speed[:-1], speed[1:]) > least_speed) & (np.abs(rate) < 3.0)
    return 0.5 * (t[:-1] + t[1:])[keep], rate[keep]


def time_offset(imu_stamps, rate, gnss_stamps, velocity, limit: float = 3.0) -> tuple[float, float] | None:
    """Return (offset s, correlation) by which GNSS stamps are later than the IMU's, or None if unseen.

    Correlates the course rate of the velocities with the IMU's rate about down, averaged over the interval
    that one course difference spans.
    """
    times, turn = course_rate(gnss_stamps, velocity)
    if len(times) < 20 or math.sqrt(float(np.mean(turn**2))) < _LEAST_TURN:
        return None
    span = float(np.median(np.diff(gnss_stamps))) / NANOSECONDS
    t = (imu_stamps - gnss_stamps[0]) / NANOSECONDS
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:, 2] + rate[:-1, 2]) * np.diff(t))])
    shifts = np.arange(-limit, limit + _GRID, _GRID)
    scores = np.full(len(shifts), -1.0)
    for k, shift in enumerate(shifts):
        at = times - shift
        inside = (at - 0.5 * span > t[0]) & (at + 0.5 * span < t[-1])
        if inside.sum() < 20:
            continue
        ahead = np.interp(at[inside] + 0.5 * span, t, angle)
        yaw = (ahead - np.interp(at[inside] - 0.5 * span, t, angle)) / span
        if yaw.std() > 0.0 and turn[inside].std() > 0.0:
            scores[k] = np.corrcoef(yaw, turn[inside])[0, 1]
    best = int(np.argmax(scores))
    offset = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        a, b, c = scores[best - 1 : best + 2]
        if a - 2.0 * b + c < 0.0:
            offset += 0.5 * _GRID * float((a - c) / (a - 2.0 * b + c))
    return offset, float(scores[best])


def check_time(imu_stamps, rate, gnss_stamps, velocity) -> list[Finding]:
    """Check whether IMU and GNSS share one clock."""
    overlap = min(imu_stamps[-1], gnss_stamps[-1]) - max(imu_stamps[0], gnss_stamps[0])
    if overlap <= 0:
        apart = abs(int(gnss_stamps[0]) - int(imu_stamps[0])) / NANOSECONDS
        leap = ' (18 s: GPS time against UTC?)' if 17.0 < apart < 19.0 else ''
        return [Finding(ERROR, 'time', f'IMU and GNSS do not overlap: they start {apart:.1f} s apart{leap}')]
    found = time_offset(imu_stamps, rate, gnss_stamps, velocity)
    if found is None:
        return [Finding(INFO, 'time', 'too few turns to see a time offset between IMU and GNSS')]
    offset, correlation = found
    if correlation < _LEAST_CORRELATION:
        text = f'turns of IMU and GNSS do not match (correlation {correlation:.2f}): axis sense or mounting?'
        return [Finding(WARN, 'time', text)]
    if abs(offset) > _OFFSET_LIMIT:
        word = 'late' if offset > 0 else 'early'
        return [Finding(ERROR, 'time', f'GNSS stamps are {abs(offset):.2f} s {word} against the IMU')]
    return [Finding(INFO, 'time', f'IMU and GNSS agree to {abs(offset):.2f} s')]


def check_gnss(epochs: list[GnssEpoch]) -> list[Finding]:
    """Check what a receiver delivers: rate, satellites, ephemerides, carrier and Doppler."""
    if len(epochs) < 2:
        return [Finding(ERROR, 'gnss', f'only {len(epochs)} GNSS epochs')]
    stamps = np.array([e.stamp for e in epochs])
    step = float(np.median(np.diff(stamps))) / NANOSECONDS
    rows = np.vstack([e.rows for e in epochs])
    out = [Finding(INFO, 'gnss rate', f'{len(epochs)} epochs at {1.0 / step:.1f} Hz')]
    orbit = np.isfinite(rows[:, 9])
    if not orbit.all():
        missing = {('GE'[int(r[0])], int(r[1])) for r in rows[~orbit] if r[0] in (0.0, 1.0)}
        names = ', '.join(f'{s}{n:02d}' for s, n in sorted(missing)[:8])
        level = WARN if orbit.any() else ERROR
        out.append(Finding(level, 'ephemeris', f'no ephemeris for {names}'))
    per_epoch = np.array([np.isfinite(e.rows[:, 9]).sum() for e in epochs])
    if np.median(per_epoch) < 5:
        text = (
            f'{np.median(per_epoch):.0f} usable satellites in the median epoch, 5 are needed to find faults'
        )
        out.append(Finding(WARN, 'satellites', text))
    if not np.isfinite(rows[:, 4]).any():
        out.append(Finding(WARN, 'carrier', 'no carrier phase: carrier differences are not possible'))
    if not np.isfinite(rows[:, 5]).any():
        out.append(Finding(INFO, 'doppler', 'no Doppler: velocity comes from carrier differences'))
    return out
