# SPDX-License-Identifier: Apache-2.0
import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from bag_tools.bag import BagError, BagReader, BagWriter
from kalman_core.rotation import euler_from_quat
from quad_control.codec import decode_imu
from quad_control.importers import IMPORTERS
from quad_control.recordings import RecordingError, read_phantom

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'quad'
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f'no recordings in {DATA} (ESTIMATOR_DATA)')


def ulog(path, rows):
    """Write a PX4 ULog by hand, after the format's specification."""

    def message(kind, body):
        return struct.pack('<HB', len(body), ord(kind)) + body

    formats = {
        'sensor_combined': 'uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;',
        'vehicle_attitude': 'uint64_t timestamp;float[4] q;',
    }
    out = b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 0)
    for name, text in formats.items():
        out += message('F', f'{name}:{text}'.encode())
    for number, name in enumerate(formats):
        out += message('A', struct.pack('<BH', 0, number) + name.encode())
    for number, values in rows:
        out += message(
            'D', struct.pack('<HQ', number, values[0]) + struct.pack(f'<{len(values) - 1}f', *values[1:])
        )
    path.write_bytes(out)
    return path


def imported(name, source, tmp_path):
    out = tmp_path / 'out.mcap'
    with BagWriter(out) as writer:
        IMPORTERS[name](source, writer)
    messages = {}
    with BagReader(out) as reader:
        types = {topic: t.type for topic, t in reader.topics.items()}
        for topic, _, data in reader.messages():
            messages.setdefault(topic, []).append(reader.decode(data, types[topic]))
    return messages


def test_a_ulog_is_turned_from_px4_axes_to_ros_axes(tmp_path):
    # PX4: forward-right-down; level at rest the accelerometer says -g on z. Heading north is yaw 90 degrees.
    source = ulog(
        tmp_path / 'log.ulg',
        [
            (0, (1000, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)),
            (1, (2000, 1.0, 0.0, 0.0, 0.0)),
            (0, (5000, *[0.0] * 6)),
        ],
    )
    messages = imported('ulog', source, tmp_path)
    first = decode_imu(messages['/imu/data_raw'][0])
    assert first.rate == pytest.approx((0.1, -0.2, -0.3), rel=1e-6)
    assert first.force == pytest.approx((0.0, 0.0, 9.8), rel=1e-6)
    q = messages['/truth/orientation'][0].quaternion
    angles = euler_from_quat(np.array([q.w, q.x, q.y, q.z]))
    assert angles == pytest.approx((0.0, 0.0, math.pi / 2), abs=1e-6)


def test_what_is_no_ulog_is_one_clear_error(tmp_path):
    path = tmp_path / 'nonsense.ulg'
    path.write_bytes(b'nonsense')
    for source in (path, tmp_path / 'absent.ulg'):
        with (
            BagWriter(tmp_path / 'out.mcap', overwrite=True) as writer,
            pytest.raises(BagError, match=source.name),
        ):
            IMPORTERS['ulog'](source, writer)
        (tmp_path / 'out.mcap').unlink(missing_ok=True)


def test_a_missing_flight_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r'H9_IMU_1\.csv: no such file'):
        read_phantom(tmp_path, 'H9')


@needs_data
def test_a_phantom_flight_becomes_a_bag(tmp_path):
    messages = imported('phantom4rtk', DATA / 'phantom4rtk' / 'H1_IMU_1.csv', tmp_path)
    assert len(messages['/imu/data_raw']) > 2000
    assert len(messages['/truth/orientation']) > 200


@needs_data
def test_an_mpu6050_recording_becomes_a_bag_with_g_upwards(tmp_path):
    folder = next((DATA / 'mpu6050' / 'set-1').iterdir())
    messages = imported('mpu6050', folder, tmp_path)
    samples = [decode_imu(m) for m in messages['/imu/data_raw']]
    norms = [math.hypot(*s.force) for s in samples]
    assert np.median(norms) == pytest.approx(9.8, rel=0.06)
    assert np.median([s.force[2] for s in samples[:50]]) > 9.0
    # Turned by hand, hardly accelerated: the change of the specific force is -w x f.
    rate, force = (_smooth(np.array([getattr(s, name) for s in samples])) for name in ('rate', 'force'))
    rate = rate - np.median(rate[:100], axis=0)
    change = np.gradient(force[:, 1], np.array([s.stamp for s in samples]) * 1e-9)
    assert np.corrcoef(change, -np.cross(rate, force)[:, 1])[0, 1] > 0.8


def _smooth(values):
    kernel = np.ones(21) / 21.0
    return np.column_stack([np.convolve(column, kernel, 'same') for column in values.T])


@pytest.mark.parametrize(
    ('text', 'word'),
    [('head\n1,2,3\n1,2,x\n', 'H1_IMU_1.csv: '), ('head\n1,2,3\n', r'expected rows of 10')],
)
def test_a_flight_that_is_no_table_is_named(tmp_path, text, word):
    (tmp_path / 'H1_IMU_1.csv').write_text(text)
    with pytest.raises(RecordingError, match=word):
        read_phantom(tmp_path, 'H1')
