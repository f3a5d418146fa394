# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import can
import numpy as np
import pytest

from ev_velocity.can_frames import OWN_DBC, CarOnCan
from ev_velocity.params import VelocityParams
from ev_velocity.recordings import RecordingError, columns, read_can, read_kingston, read_obd
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


def test_a_log_becomes_times_and_values_from_its_first_frame(tmp_path):
    path = tmp_path / 'drive.log'
    car = CarOnCan('virtual', 'test_recordings')
    with can.Logger(str(path)) as writer:
        for i in range(50):
            for message in car.frames(0.1 * i, 0.2, 0.0):
                message.timestamp, message.channel = 1_767_225_600.0 + 0.02 * i, 0
                writer.on_message_received(message)
    car.close()
    drive = read_can(path, OWN_DBC, 'imiev')
    t, wheels = drive.wheels
    np.testing.assert_allclose(t, 0.02 * np.arange(50), atol=1e-6)
    assert wheels.shape == (50, 4)
    np.testing.assert_allclose(wheels[1:, 0], 0.1 * np.arange(1, 50), atol=0.02)
    assert drive.force[0].size == drive.force[1].size == 0
    assert set(drive.gear[1]) == {1}
    assert (drive.frames, drive.rejected) == (250, 0)
    assert drive.duration == pytest.approx(0.98, abs=1e-5)


def test_an_obd_file_gives_time_reference_and_speed(tmp_path):
    (tmp_path / 'obd.csv').write_text('gps_s,ref_mps,obd_mps\n1,2.5,2.2\n2,3.5,3.3\n')
    t, reference, obd = read_obd(tmp_path / 'obd.csv')
    assert (list(t), list(reference), list(obd)) == ([1.0, 2.0], [2.5, 3.5], [2.2, 3.3])
