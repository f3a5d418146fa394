# SPDX-License-Identifier: Apache-2.0
"""The doctor's visit to a bag: reads IMU and raw GNSS and runs every check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagReader
from ins_gps import codec
from ins_gps.constants import SPEED_OF_LIGHT, WAVELENGTH_L1
from ins_gps.doctor import ERROR, Finding, check_gnss, check_imu, check_time
from ins_gps.fix import OK, solve_position, solve_velocity
from ins_gps.samples import GnssEpoch, ImuSample
from kalman_core.earth import geodetic_from_ecef, mat_ecef_from_ned
from node_core.ports import BadMessage


def examine(path: str | Path, imu_topic: str, gnss_topic: str) -> list[Finding]:
    """Return the findings on a bag; BagError if it cannot be read or lacks a topic."""
    imu: list[ImuSample] = []
    epochs: list[GnssEpoch] = []
    refused: dict[str, int] = {}
    with BagReader(path) as bag:
        names: dict[str, tuple[Any, list[Any], str]] = {
            bag.topic(imu_topic).name: (codec.decode_imu, imu, codec.IMU)
        }
        names[bag.topic(gnss_topic).name] = (codec.decode_observations, epochs, codec.CLOUD)
        for topic, _, data in bag.messages(list(names)):
            decode, samples, type_name = names[topic]
            try:
                samples.append(decode(bag.decode(data, type_name)))
            except BadMessage as error:
                reason = f'{topic}: {error}'
                refused[reason] = refused.get(reason, 0) + 1
    findings = [
        Finding(ERROR, 'messages', f'{count} messages refused, {why}') for why, count in refused.items()
    ]
    stamps = np.array([s.stamp for s in imu], dtype=np.int64)
    rate = np.array([s.rate for s in imu]).reshape(-1, 3)
    force = np.array([s.force for s in imu]).reshape(-1, 3)
    findings += check_imu(stamps, rate, force) + check_gnss(epochs)
    times, velocities = gnss_velocities(epochs)
    if len(times) > 1 and len(stamps) > 10:
        findings += check_time(stamps, rate, times, velocities)
    return findings


def gnss_velocities(epochs: list[GnssEpoch]) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (k,) ns and velocities (k, 3) m/s NED of the epochs whose Doppler gives one."""
    times, velocities = [], []
    for epoch in epochs:
        rows = epoch.rows[epoch.rows[:, 2] == 1.0]
        ranges = rows[:, 3] + SPEED_OF_LIGHT * rows[:, 15]
        fix = solve_position(rows[:, 9:15], ranges, np.full(len(rows), 5.0), rows[:, 0])
        if fix.status != OK:
            continue
        rates = -rows[:, 5] * WAVELENGTH_L1 + SPEED_OF_LIGHT * rows[:, 16]
        motion = solve_velocity(rows[:, 9:15], rates, np.full(len(rows), 0.3), rows[:, 0], fix.position)
        if motion.status != OK:
            continue
        lat, lon, _ = geodetic_from_ecef(fix.position)
        times.append(epoch.stamp)
        velocities.append(mat_ecef_from_ned(lat, lon).T @ motion.position)
    return np.array(times, dtype=np.int64), np.array(velocities).reshape(-1, 3)
