# SPDX-License-Identifier: Apache-2.0
"""The attitude filter on flights that nobody here flew, from their first sample and from the middle."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quad_control.attitude_filter import AttitudeFilter
from quad_control.params import AttitudeParams
from quad_control.recordings import alignment, read_phantom, upward
from quad_control.samples import Attitude, ImuSample

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'quad' / 'phantom4rtk'
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f'no recordings in {DATA} (ESTIMATOR_DATA)')


def estimated(recording):
    """Upward directions (n, 3) in the sensor's axes, causal."""
    attitude = AttitudeFilter(AttitudeParams(period=float(np.median(np.diff(recording.time)))))
    out = []
    for t, gyro, force in zip(recording.time, recording.gyro, recording.force):
        estimates = attitude.on_imu(ImuSample(10**9 + round(t * 1e9), tuple(gyro), tuple(force)))
        out += [e.quaternion for e in estimates if type(e) is Attitude]
    return upward(np.array(out))


def test_the_mean_error_over_whole_flights_is_below_two_and_a_half_degrees():
    flights = [read_phantom(DATA, f'H{i}') for i in range(1, 6)]
    assert np.mean([alignment(f, estimated(f)).rmse for f in flights]) <= 2.5


@pytest.mark.parametrize('name', ['H2', 'H4'])
def test_a_start_in_the_middle_of_a_flight_finds_the_tilt_within_five_seconds(name):
    flight = read_phantom(DATA, name)
    known = alignment(flight, estimated(flight))
    truth = upward(flight.truth) @ known.mounting
    squares = []
    for start in range(3, 24, 3):
        seen = (flight.time >= start) & (flight.time < start + 15.0)
        part = replace(flight, time=flight.time[seen], gyro=flight.gyro[seen], force=flight.force[seen])
        at = flight.truth_time + known.lag
        late = (at > start + 5.0) & (at < part.time[-1])
        up = estimated(part)
        up = np.column_stack([np.interp(at[late], part.time, up[:, axis]) for axis in range(3)])
        squares.append(np.mean(np.sum((up - truth[late]) ** 2, axis=1)))
    # The root mean square of the tilt error; small angles are chords.
    assert np.degrees(np.sqrt(np.mean(squares))) < 3.0
