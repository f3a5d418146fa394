# SPDX-License-Identifier: Apache-2.0
"""Tables become messages as the mapping says; what is wrong is named with file, line and column."""

import re
import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bag_tools import import_data as tool
from bag_tools.bag import BagError, BagReader
from bag_tools.import_data import FOLDER, import_data
from bag_tools.mapping import read_mapping
from bag_tools.series import read_series

IMU_MAPPING = """
text: an IMU in its own units
csv: {comment: '%'}
topics:
  - topic: imu/data_raw
    type: sensor_msgs/msg/Imu
    stamp: {column: t, unit: ms, offset: 1.0}
    frame_id: imu
    set: {'orientation_covariance[0]': -1.0}
    fields:
      angular_velocity: {columns: [gy, gx, gz], unit: deg/s, scale: [1, -1, 1]}
      linear_acceleration.z: {column: az, unit: g, add: 0.5}
"""
CSV = '% made by hand\nt,gx,gy,gz,az,name\n0,1,2,3,1.0,a\n10,4,5,6,,b\n20,7,8,9,2.0,c\n'


@pytest.fixture
def files(tmp_path):
    (tmp_path / 'map.yaml').write_text(IMU_MAPPING)
    (tmp_path / 'imu.csv').write_text(CSV)
    return tmp_path


def messages(path, topic):
    with BagReader(path) as reader:
        return [(s, reader.decode(d, reader.topics[t].type)) for t, s, d in reader.messages([topic])]


def test_units_signs_offsets_and_stamps(files):
    counts = import_data(str(files / 'map.yaml'), files / 'imu.csv', files / 'bag')
    assert counts == {'/imu/data_raw': 2}  # the row without az is left out
    (s0, first), (s1, last) = messages(files / 'bag', '/imu/data_raw')
    assert (s0, s1) == (1_000_000_000, 1_020_000_000)
    assert (last.header.stamp.sec, last.header.stamp.nanosec) == (1, 20_000_000)
    assert first.header.frame_id == 'imu'
    assert first.orientation_covariance[0] == -1.0
    rate = first.angular_velocity
    assert (rate.x, rate.y, rate.z) == pytest.approx(np.radians([2.0, -1.0, 3.0]))
    assert last.linear_acceleration.z == pytest.approx(2.5 * 9.80665)


def test_rows_with_gaps_are_kept_or_refused_as_told(files):
    text = IMU_MAPPING.replace('    frame_id', '    nan: keep\n    frame_id')
    (files / 'keep.yaml').write_text(text)
    assert import_data(str(files / 'keep.yaml'), files / 'imu.csv', files / 'bag') == {'/imu/data_raw': 3}
    (files / 'error.yaml').write_text(text.replace('keep', 'error'))
    with pytest.raises(BagError, match=r"imu\.csv: row 1: a value of 'imu/data_raw' is not finite"):
        import_data(str(files / 'error.yaml'), files / 'imu.csv', files / 'bag2')
    assert not (files / 'bag2').exists()


def test_npz_arrays_rates_euler_angles_and_changes(tmp_path):
    euler = np.array([[10.0, -20.0, 30.0], [np.nan, 0.0, 0.0], [0.0, 5.0, 350.0]])
    np.savez(tmp_path / 'a.npz', att=euler, moving=[False, False, True], fs=200.0, name='trial')
    (tmp_path / 'm.yaml').write_text("""
topics:
  - topic: truth
    type: geometry_msgs/msg/QuaternionStamped
    stamp: {rate: fs, offset: 2}
    fields:
      quaternion: {euler: att, unit: deg, scale: [1, 1, -1], add: [0, 0, 90]}
  - topic: moving
    type: std_msgs/msg/Bool
    stamp: {rate: 200}
    changes: true
    fields: {data: moving}
  - topic: joints
    type: sensor_msgs/msg/JointState
    stamp: {rate: 200}
    nan: keep
    set: {name: [a, b, c]}
    fields:
      position: {columns: att}
""")
    counts = import_data(str(tmp_path / 'm.yaml'), tmp_path / 'a.npz', tmp_path / 'bag')
    assert counts == {'/truth': 2, '/moving': 2, '/joints': 3}
    (truth,) = read_series(tmp_path / 'bag', 'truth')
    assert truth.stamps.tolist() == [2_000_000_000, 2_010_000_000]
    expected = Rotation.from_euler('ZYX', [[60.0, -20.0, 10.0], [-260.0, 5.0, 0.0]], degrees=True)
    assert np.abs(np.sum(truth.values * np.roll(expected.as_quat(), 1, axis=1), axis=1)) == pytest.approx(1.0)
    assert [m.data for _, m in messages(tmp_path / 'bag', '/moving')] == [False, True]
    joints = messages(tmp_path / 'bag', '/joints')[2][1]
    assert joints.position.tolist() == [0.0, 5.0, 350.0]
    assert joints.name == ['a', 'b', 'c']


def test_unix_times_keep_their_fractions(tmp_path):
    (tmp_path / 'm.yaml').write_text(IMU_MAPPING.replace('unit: ms, offset: 1.0', 'unit: s'))
    (tmp_path / 'a.csv').write_text('t,gx,gy,gz,az\n1756402240.25,0,0,0,0\n')
    import_data(str(tmp_path / 'm.yaml'), tmp_path / 'a.csv', tmp_path / 'bag')
    assert messages(tmp_path / 'bag', '/imu/data_raw')[0][0] == 1_756_402_240_250_000_000


def test_several_files_of_a_folder_are_merged_by_time(tmp_path):
    (tmp_path / 'a.csv').write_text('t,v\n1,10\n3,30\n')
    (tmp_path / 'b.txt').write_text('2 20\n4 40\n')
    rest = 'type: std_msgs/msg/Float64, stamp: {column: t}, fields: {data: v}'
    topics = ''.join(f'  - {{topic: {name}, file: {name}, {rest}}}\n' for name in 'ab')
    (tmp_path / 'm.yaml').write_text(
        'files: {a: a.csv, b: b.txt}\ncsv: {delimiter: whitespace, header: [t, v]}\ntopics:\n'
        + topics
    )  # fmt: skip
    with pytest.raises(BagError, match=r'a\.csv: line 1'):
        import_data(str(tmp_path / 'm.yaml'), tmp_path, tmp_path / 'bag')
    (tmp_path / 'a.csv').write_text('1 10\n3 30\n')
    import_data(str(tmp_path / 'm.yaml'), tmp_path, tmp_path / 'bag')
    with BagReader(tmp_path / 'bag') as reader:
        assert [(t, s // 10**9) for t, s, _ in reader.messages()] == [
            ('/a', 1),
            ('/b', 2),
            ('/a', 3),
            ('/b', 4),
        ]


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('unit: deg/s', 'unit: furlong', "field angular_velocity: unit 'furlong' is unknown; known: rad"),
        ('[gy, gx, gz]', '[gy, gx]', "'angular_velocity': 3 factors for 2 columns"),
        ('column: az', 'column: bz', "no column 'bz'; the file has: t, gx, gy, gz, az, name"),
        ('linear_acceleration.z', 'linear_acceleration.w', "Imu has no field 'linear_acceleration.w'"),
        ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/Emu', "'sensor_msgs/msg/Emu' is unknown"),
        ('unit: ms, offset: 1.0', 'unit: ms, offset: -1.0', 'begin at -1.000 s; add an offset'),
        ('column: t, unit', 'rate: 3, column: t, unit', 'expected either column or rate'),
        ('column: az', 'column: name', "line 3, column 'name': 'a' is not a number"),
        ('text:', 'test:', "unknown key 'test'; known: copy, csv, files, text, topics"),
        ('    frame_id', '    nan: maybe\n    frame_id', "nan is 'maybe', expected skip | error | keep"),
        ('topics:', 'topics: []\nx:', 'unknown key'),
        ('csv: {comment', 'csv: {coment', 'is malformed; expected delimiter'),
        ('csv: {comment', "csv: {delimiter: '\\t', comment", 'expected one character'),
        ('csv: {comment', 'csv: {delimiter: 5, comment', 'expected one character'),
        ('sensor_msgs/msg/Imu', 'geometry_msgs/msg/Twist', 'has no header for a frame_id'),
        (
            "'orientation_covariance[0]': -1.0",
            'orientation_covariance: [-1, 0]',
            '[-1, 0] does not fit the list of numbers',
        ),
    ],
)
def test_bad_mappings_are_one_clear_line(files, capsys, old, new, words):
    assert old in IMU_MAPPING
    (files / 'map.yaml').write_text(IMU_MAPPING.replace(old, new))
    assert tool.main([str(files / 'map.yaml'), str(files / 'imu.csv'), str(files / 'bag')]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert words in err
    assert not (files / 'bag').exists()


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', 'has no rows'),
        ('t,gx,gy,gz,az\n0,1,2\n', 'line 2 has 3 columns, expected 5'),
        ('t,gx,gy,gz,az\n0,1,x,3,4\n', "line 2, column 'gy': 'x' is not a number"),
        ('t,gx,gy,gz,az\n,1,2,3,4\n', "row 0: the stamp 't' is not finite"),
        (None, 'no such file'),
    ],
)
def test_bad_tables_are_one_clear_line(files, capsys, text, words):
    (files / 'imu.csv').unlink()
    if text is not None:
        (files / 'imu.csv').write_text(text)
    assert tool.main([str(files / 'map.yaml'), str(files / 'imu.csv'), str(files / 'bag')]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert 'imu.csv' in err


@pytest.mark.parametrize('mark', ['', '\ufeff'])
def test_a_table_of_a_spreadsheet_may_have_a_byte_order_mark_and_empty_cells(tmp_path, mark):
    (tmp_path / 'm.yaml').write_text(
        'csv: {delimiter: "\\t"}\n'
        'topics:\n'
        '  - topic: a\n'
        '    type: std_msgs/msg/Float64\n'
        '    stamp: {column: t, unit: s}\n'
        '    fields: {data: {column: x}}\n'
    )
    (tmp_path / 'a.csv').write_text(f'{mark}t\tx\n1e0\t10\n2\t\n3\t30\n', encoding='utf-8')
    import_data(str(tmp_path / 'm.yaml'), tmp_path / 'a.csv', tmp_path / 'bag')
    with BagReader(tmp_path / 'bag') as reader:
        assert [s // 10**9 for _, s, _ in reader.messages()] == [1, 3]


@pytest.mark.parametrize(
    ('type_name', 'field', 'words'),
    [
        # Python 3.13 names the format another way.
        ('std_msgs/msg/UInt8', 'data', r"'/n' at 3\.000 s: \S+ format requires 0 <= number <= 255"),
        ('std_msgs/msg/Float32', 'data', r"'/n' at 6\.000 s: float too large"),
        (
            'std_msgs/msg/UInt8MultiArray',
            'data',
            r"'/n' at 3\.000 s: Python integer 256 out of bounds for uint8",
        ),
        ('std_msgs/msg/Int64', 'data', "'data' is nan, and its field holds whole numbers only"),
    ],
)
def test_numbers_that_their_field_cannot_hold_are_one_clear_line(tmp_path, capsys, type_name, field, words):
    (tmp_path / 'm.yaml').write_text(
        f'topics:\n  - topic: n\n    type: {type_name}\n    stamp: {{column: t}}\n    nan: keep\n'
        f'    fields: {{{field}: {{columns: [x], scale: 100}}}}\n'
    )
    (tmp_path / 'a.csv').write_text('t,x\n1,0.29\n2,1\n3,2.56\n5,\n6,1e40\n')
    assert tool.main([str(tmp_path / 'm.yaml'), str(tmp_path / 'a.csv'), str(tmp_path / 'bag')]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert re.search(words, err)


def test_whole_numbers_are_rounded(tmp_path):
    (tmp_path / 'm.yaml').write_text(
        'topics: [{topic: n, type: std_msgs/msg/UInt8, stamp: {rate: 1},'
        ' fields: {data: {column: x, scale: 100}}}]'
    )
    (tmp_path / 'a.csv').write_text('x\n0.29\n')
    import_data(str(tmp_path / 'm.yaml'), tmp_path / 'a.csv', tmp_path / 'bag')
    assert messages(tmp_path / 'bag', '/n')[0][1].data == 29


def test_a_broken_npz_is_refused(tmp_path, capsys):
    (tmp_path / 'x.npz').write_bytes(b'PK\x03\x04 not really')
    assert tool.main(['broad', str(tmp_path / 'x.npz'), str(tmp_path / 'bag')]) == 2
    assert 'expected an npz file' in capsys.readouterr().err


def test_unknown_mappings_name_what_there_is(tmp_path):
    with pytest.raises(BagError, match='one of: broad, '):
        import_data('brood', tmp_path, tmp_path / 'bag')


def test_other_packages_offer_importers(tmp_path, monkeypatch):
    def one_note(source, writer):
        writer.add('note', 'std_msgs/msg/String')
        writer.write_raw('/note', 5, source.read_bytes())

    module = types.ModuleType('mixer.importers')
    module.IMPORTERS = {'note': one_note}
    monkeypatch.setitem(sys.modules, 'mixer', types.ModuleType('mixer'))
    monkeypatch.setitem(sys.modules, 'mixer.importers', module)
    (tmp_path / 'x').write_bytes(b'\x00\x01\x00\x00\x02\x00\x00\x00a\x00')
    assert import_data('mixer:note', tmp_path / 'x', tmp_path / 'bag') == {'/note': 1}
    assert messages(tmp_path / 'bag', '/note')[0][1].data == 'a'
    with pytest.raises(BagError, match="no importer 'nota'; it has: note"):
        import_data('mixer:nota', tmp_path / 'x', tmp_path / 'bag2')


@pytest.mark.parametrize('path', sorted(FOLDER.glob('*.yaml')), ids=lambda p: p.stem)
def test_shipped_mappings_are_well_formed(path):
    assert read_mapping(path).text


def test_broad_arrives_as_it_was_recorded(recordings, tmp_path):
    source = recordings / 'imu' / 'broad_02.npz'
    counts = import_data('broad', source, tmp_path / 'bag')
    with np.load(source) as data:
        finite = np.all(np.isfinite(data['quat']), axis=1)
        assert counts['/imu/data_raw'] == len(data['gyr'])
        assert counts['/truth/orientation'] == finite.sum()
        (field,) = read_series(tmp_path / 'bag', 'imu/mag')
        assert field.values == pytest.approx(data['mag'].astype(float) * 1e-6)
        (truth,) = read_series(tmp_path / 'bag', 'truth/orientation')
        reference = data['quat'][finite].astype(float)
        assert np.abs(np.sum(truth.values * reference, axis=1)) == pytest.approx(1.0, abs=1e-6)
        assert np.diff(field.stamps) * 1e-9 == pytest.approx(1.0 / float(data['fs']), abs=1e-8)


def test_kingston_speeds_lie_on_one_time_base(recordings, tmp_path):
    import_data('kingston', recordings / 'ev' / 'kingston_1800s', tmp_path / 'bag')
    (imu_series,) = (
        s for s in read_series(tmp_path / 'bag', 'imu/data_raw') if s.role == 'linear_acceleration'
    )
    assert np.median(imu_series.values[:, 2]) == pytest.approx(9.8, abs=0.1)  # z up
    (truth,) = (s for s in read_series(tmp_path / 'bag', 'truth/speed') if s.role == 'linear_velocity')
    assert truth.stamps[0] == 1000 * 10**9
