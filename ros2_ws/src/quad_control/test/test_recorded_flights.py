# SPDX-License-Identifier: Apache-2.0
"""The attitude filter on flights that nobody here flew, from their first sample and from the middle."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bag_tools.align import LAG, MOUNTING, aligned, solve
from bag_tools.errors import at, attitude_errors, euler_angles
from bag_tools.series import Series
from quad_control.attitude_filter import AttitudeFilter
from quad_control.params import AttitudeParams
from quad_control.recordings import read_phantom
from quad_control.samples import Attitude, ImuSample

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'quad' / 'phantom4rtk'
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f'no recordings in {DATA} (ESTIMATOR_DATA)')


def series(time, quaternions):
    stamps = np.round(time * 1e9).astype(np.int64)
    return Series('orientation', 'orientation', stamps, quaternions, ('w', 'x', 'y', 'z'), 'rad')


def estimated(recording):
    """Attitudes of the sensor, causal."""
    attitude = AttitudeFilter(AttitudeParams(period=float(np.median(np.diff(recording.time)))))
    out = []
    for t, gyro, force in zip(recording.time, recording.gyro, recording.force):
        estimates = attitude.on_imu(ImuSample(10**9 + round(t * 1e9), tuple(gyro), tuple(force)))
        out += [e.quaternion for e in estimates if type(e) is Attitude]
    return series(recording.time, np.array(out))


def solved(recording, estimate):
    """Mounting and lag of the sensor against the autopilot, from the whole flight."""
    truth = series(recording.truth_time, recording.truth)
    return truth, solve(estimate, truth, (MOUNTING, LAG), lambda stamps: np.ones(len(stamps), dtype=bool))


def test_the_mean_error_over_whole_flights_is_below_two_and_a_half_degrees():
    found = []
    for i in range(1, 6):
        flight = read_phantom(DATA, f'H{i}')
        estimate = estimated(flight)
        truth, constants = solved(flight, estimate)
        seen, known = at(aligned(estimate, constants), truth.stamps)
        errors = (euler_angles(seen[known]) - euler_angles(truth.values[known]))[:, :2]
        found.append(np.degrees(np.sqrt(np.mean(errors**2, axis=0))))
    assert np.mean(found) <= 2.5


@pytest.mark.parametrize('name', ['H2', 'H4'])
def test_a_start_in_the_middle_of_a_flight_finds_the_tilt_within_five_seconds(name):
    flight = read_phantom(DATA, name)
    truth, constants = solved(flight, estimated(flight))
    squares = []
    for start in range(3, 24, 3):
        seen = (flight.time >= start) & (flight.time < start + 15.0)
        part = replace(flight, time=flight.time[seen], gyro=flight.gyro[seen], force=flight.force[seen])
        estimate = aligned(estimated(part), constants)
        attitude, known = at(estimate, truth.stamps)
        known &= truth.stamps > estimate.stamps[0] + 5_000_000_000
        tilt = attitude_errors(attitude[known], truth.values[known])['inclination']
        squares.append(np.mean(tilt**2))
    assert np.degrees(np.sqrt(np.mean(squares))) < 3.0
