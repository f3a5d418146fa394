# SPDX-License-Identifier: Apache-2.0
"""The calibration command as a process, on bags that the simulator made."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml

from bag_tools.bag import BagWriter, zeroed
from kalman_core.parameters import build
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.recording import TYPES, events, fill
from ship_inclinometer.simulation import scenario, simulate

START = 1_767_225_600_000_000_000
LIGHT = {'rate': 50.0, 'magnetometer_rate': 20.0}


def write(path, recordings, gap=0.0):
    """Write recordings one after the other, `gap` seconds apart."""
    messages = {topic: zeroed(kind) for topic, kind in TYPES.items()}
    start = START
    with BagWriter(path) as bag:
        for topic, kind in TYPES.items():
            bag.add(f'/{topic}', kind)
        for recording in recordings:
            for stamp, topic, index in events(recording, start):
                fill(recording, topic, index, stamp, messages[topic])
                bag.write(f'/{topic}', stamp, messages[topic])
            start += round((recording.params.duration + gap) * 1e9)
    return path


def calibrate(*arguments):
    code = 'from ship_inclinometer.nodes.calibration import main; main()'
    argv = [sys.executable, '-c', code, *map(str, arguments)]
    return subprocess.run(argv, capture_output=True, text=True, timeout=600, check=False)


def parameters(path):
    return build(AttitudeParams, yaml.safe_load(path.read_text())['attitude_estimator']['ros__parameters'])


def test_a_sensor_turned_by_hand_gets_its_hard_iron_and_bias_back(tmp_path):
    recording = simulate(scenario('calibration', **LIGHT), 1)
    bag, out = write(tmp_path / 'tumble', [recording]), tmp_path / 'calibration.yaml'
    done = calibrate(bag, '--out', out, '--parts', 'magnetometer,accelerometer', '--field', 48.0)
    assert done.returncode == 0, done.stderr
    params = parameters(out)
    # The raw norm of the field is off by a third.
    field = (recording.magnetometer - params.magnetometer_offset) @ np.reshape(
        params.magnetometer_matrix, (3, 3)
    ).T
    assert np.std(np.linalg.norm(field, axis=1)) < 0.01 * 48e-6
    bias = np.array(params.accelerometer_offset) - recording.truth.accelerometer_bias
    # Twenty milli-g were there; one is left at most.
    assert np.max(np.abs(bias)) < 1e-3 * 9.80665


def test_what_was_not_turned_is_refused_with_the_missing_sides_and_nothing_is_written(tmp_path):
    bag, out = (
        write(
            tmp_path / 'ship',
            [simulate(scenario('beam', duration=60.0, **LIGHT, engine_frequencies=(0.0, 0.0)), 1)],
        ),
        tmp_path / 'c.yaml',
    )
    done = calibrate(bag, '--out', out)
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert 'magnetometer' in done.stderr
    assert 'turn the sensor through all sides' in done.stderr
    assert calibrate(bag, '--out', out, '--parts', 'gyro').returncode == 2
    assert calibrate(bag, '--out', out, '--parts', 'swing').returncode == 2
    assert calibrate(tmp_path / 'nothing', '--out', out).returncode == 2
    assert calibrate(bag, '--out', out, '--with', tmp_path / 'none.yaml', '--parts', 'gyro').returncode == 2
    assert 'nonsense' in calibrate(bag, '--out', out, '--parts', 'nonsense').stderr
    assert list(tmp_path.glob('*.yaml*')) == list(tmp_path.glob('.*.part')) == []


def test_a_gyro_at_rest_gives_its_bias(tmp_path):
    still = replace(
        scenario('calibration', duration=30.0, **LIGHT),
        sea='sine', largest_roll=0.0, largest_pitch=0.0, largest_yaw=0.0, sway=0.0, heave=0.0,
        gyro_warmup=0.0,
    )  # fmt: skip
    recording = simulate(still, 2)
    out = tmp_path / 'calibration.yaml'
    done = calibrate(write(tmp_path / 'still', [recording]), '--out', out, '--parts', 'gyro')
    assert done.returncode == 0, done.stderr
    error = np.array(parameters(out).gyro_offset) - np.mean(recording.truth.gyro_bias, axis=0)
    assert np.max(np.abs(error)) < math.radians(0.02)


@pytest.mark.parametrize('declination', [0.0, 40.0])
def test_a_ship_swing_takes_out_the_ships_own_magnetism(tmp_path, declination):
    seed = 3
    quiet = {'hard_iron': 25.0, 'soft_iron': 0.01, 'gnss_rate': 5.0, 'engine_frequencies': (0.0, 0.0)}
    quiet |= {'significant_height': 0.5, 'largest_roll': 3.0, 'duration': 60.0, **LIGHT}
    quiet |= {'declination': declination}
    # One seed and one duration: the same draws, so the same ship on each leg.
    legs = [simulate(scenario('beam', course=45.0 * n, **quiet), seed) for n in range(8)]
    earlier, out = tmp_path / 'sensor.yaml', tmp_path / 'swing.yaml'
    known = {'antenna_lever_arm': [10.0, 3.0, 10.0], 'declination': declination}
    earlier.write_text(yaml.safe_dump({'attitude_estimator': {'ros__parameters': known}}))
    done = calibrate(
        write(tmp_path / 'swing', legs, gap=5.0), '--out', out, '--parts', 'swing', '--with', earlier
    )
    assert done.returncode == 0, done.stderr
    params = parameters(out)
    assert params.antenna_lever_arm == (10.0, 3.0, 10.0)
    from ship_inclinometer.attitude_batch import attitude_errors, run_recording

    # Other legs of the same ship, between those of the swing, without GNSS.
    before, after = [], []
    for n in range(4):
        leg = simulate(scenario('beam', course=20.0 + 90.0 * n, **quiet), seed)
        recording = replace(leg, gnss_t=np.empty(0), gnss_velocity=np.empty((0, 3)))
        for errors, used in ((before, AttitudeParams(declination=declination)), (after, params)):
            angles = attitude_errors(recording, run_recording(recording, used).rows, 50).angles
            errors.append(np.mean(angles[len(angles) // 2 :, 2]))
    assert np.max(np.abs(before)) > 2.0
    assert np.max(np.abs(after)) < 0.7
