# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import numpy as np
import pytest

from ev_velocity.params import VelocityParams
from ev_velocity.recordings import RecordingError, columns, read_kingston
from ev_velocity.velocity_batch import run

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data'))
KINGSTON = DATA / 'ev' / 'kingston_1800s'
recorded = pytest.mark.skipif(not KINGSTON.exists(), reason=f'no recording at {KINGSTON} (ESTIMATOR_DATA)')


def error_of(drive, shift=0.0, gps=True, obd=True):
    t, v = drive.gps
    result = run(
        VelocityParams(),
        drive.force,
        gps=(t + shift, v) if gps else None,
        wheel_speed=drive.obd if obd else None,
    )
    truth_t, truth = drive.truth
    return np.interp(truth_t, drive.force[0], result.speed) - truth


def longest(mask, dt=1.0):
    """Return the longest run (s) of True."""
    best = run_length = 0
    for value in mask:
        run_length = run_length + 1 if value else 0
        best = max(best, run_length)
    return best * dt


@recorded
@pytest.mark.parametrize('shift', [0.0, 0.25])
def test_a_recorded_drive_through_multipath(shift):
    error = error_of(read_kingston(KINGSTON), shift)
    assert np.sqrt(np.mean(error**2)) < 0.14
    assert np.percentile(np.abs(error), 99) < 0.55
    assert longest(np.abs(error) > 1.0) <= 3.0
    assert np.abs(error[755:775]).max() < 0.6


@recorded
@pytest.mark.parametrize(('gps', 'obd', 'bar'), [(True, False, 0.25), (False, True, 0.4)])
def test_with_one_speed_sensor_the_filter_never_locks_out(gps, obd, bar):
    error = error_of(read_kingston(KINGSTON), gps=gps, obd=obd)
    assert np.sqrt(np.mean(error**2)) < bar
    assert longest(np.abs(error) > 2.0) <= 5.0


def test_a_missing_column_is_named(tmp_path):
    (tmp_path / 'a.csv').write_text('t_s,v\n1,2\n2,3\n')
    with pytest.raises(RecordingError, match="no column 'speed_mps'; it has: t_s, v"):
        columns(tmp_path / 'a.csv', 't_s', 'speed_mps')
    (tmp_path / 'b.csv').write_text('t_s,v\n1,x\n2,3\n')
    with pytest.raises(RecordingError, match="column 'v' has gaps or text"):
        columns(tmp_path / 'b.csv', 't_s', 'v')
    with pytest.raises(RecordingError, match=r'c\.csv'):
        columns(tmp_path / 'c.csv', 't_s')
