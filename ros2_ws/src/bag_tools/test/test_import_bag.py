# SPDX-License-Identifier: Apache-2.0
"""A bag of another driver becomes one of these conventions: axes, units, stamps; the rest comes along."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from bag_samples import IMU, SECOND, VECTOR, imu, stamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags import rosbag1
from rosbags.convert.cli import main as convert
from rosbags.typesys import Stores, get_typestore

from bag_tools import import_data as tool
from bag_tools.bag import BagError, BagReader, BagWriter, zeroed
from bag_tools.content import compare
from bag_tools.import_data import import_data
from bag_tools.mapping import STANDARD_GRAVITY

FIXTURE = Path(__file__).parents[4] / 'bags' / 'imu_hand_held.mcap'
ODD = 1_767_225_600_123_456_789  # ns: no double holds it
FRD = """
copy: [imu/mag, /truth/orientation]
topics:
  - topic: imu/data_raw
    from: /sensor/imu
    type: sensor_msgs/msg/Imu
    stamp: {column: bag_time}
    frame_id: imu_link
    fields:
      angular_velocity: {columns: angular_velocity, scale: [1, -1, -1]}
      linear_acceleration: {columns: linear_acceleration, unit: g, scale: [1, -1, -1]}
      orientation_covariance: orientation_covariance
      angular_velocity_covariance: angular_velocity_covariance
      linear_acceleration_covariance: linear_acceleration_covariance
"""
PLAIN = """
topics:
  - topic: out
    from: in
    type: geometry_msgs/msg/Vector3Stamped
    stamp: {column: header.stamp}
    fields: {vector: vector}
"""


def messages(path, topic):
    with BagReader(path) as reader:
        return [(s, reader.decode(d, reader.topics[t].type)) for t, s, d in reader.messages([topic])]


def mapping(folder, text):
    (folder / 'map.yaml').write_text(text)
    return str(folder / 'map.yaml')


def write(path, type_name, contents, name='in'):
    """Write a bag of one topic from (bag time, message)."""
    with BagWriter(path) as bag:
        bag.add(name, type_name)
        for bag_time, message in contents:
            bag.write(f'/{name}', bag_time, message)
    return path


def vector(stamp, xyz):
    message = stamped(zeroed(VECTOR), stamp)
    message.vector.x, message.vector.y, message.vector.z = xyz
    return message


def write_foreign(path):
    """Write the fixture as another driver has it: forward-right-down, force in g, no stamps."""
    with BagReader(FIXTURE) as reader, BagWriter(path) as bag:
        names = {'/imu/data_raw': '/sensor/imu'}
        for name, topic in reader.topics.items():
            bag.add(names.get(name, name), topic.type)
        for name, bag_time, data in reader.messages(stop=reader.start + 5 * SECOND):
            message = reader.decode(data, reader.topics[name].type)
            if name in names:
                message.header.stamp.sec = message.header.stamp.nanosec = 0
                rate, force = message.angular_velocity, message.linear_acceleration
                rate.y, rate.z = -rate.y, -rate.z
                force.x /= STANDARD_GRAVITY
                force.y, force.z = -force.y / STANDARD_GRAVITY, -force.z / STANDARD_GRAVITY
            bag.write(names.get(name, name), bag_time, message)
    return path


def test_another_drivers_axes_units_and_stamps_become_those_of_the_original(tmp_path):
    write_foreign(tmp_path / 'theirs.mcap')
    counts = import_data(mapping(tmp_path, FRD), tmp_path / 'theirs.mcap', tmp_path / 'ours')
    assert counts == {'/imu/data_raw': 500, '/imu/mag': 250, '/truth/orientation': 500}
    with BagReader(FIXTURE) as reader, BagWriter(tmp_path / 'original') as bag:
        for name, topic in reader.topics.items():
            bag.add(name, topic.type)
        for name, bag_time, data in reader.messages(stop=reader.start + 5 * SECOND):
            bag.write_raw(name, bag_time, data)
    # All is equal to the last bit but what went through g and back: that may be one bit off.
    names = ['/imu/mag', '/truth/orientation']
    assert all(r.equal for r in compare(tmp_path / 'ours', tmp_path / 'original', names, stamps=True))
    pairs = zip(
        messages(tmp_path / 'ours', '/imu/data_raw'), messages(tmp_path / 'original', '/imu/data_raw')
    )
    for (bag_time, mine), (was, original) in pairs:
        assert bag_time == was
        for axis in 'xyz':
            force, truth = (getattr(m.linear_acceleration, axis) for m in (mine, original))
            assert abs(force - truth) <= np.spacing(abs(truth))
            setattr(mine.linear_acceleration, axis, truth)
        assert repr(mine) == repr(original)
    # The order of messages of one bag time is that of the source.
    with BagReader(tmp_path / 'ours') as ours, BagReader(tmp_path / 'original') as original:
        assert [(t, s) for t, s, _ in ours.messages()] == [(t, s) for t, s, _ in original.messages()]


@given(
    st.lists(
        st.tuples(
            st.integers(1, 2**31 * SECOND - 1),
            st.integers(1, 2**31 * SECOND - 1),
            st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
        ),
        min_size=1,
        max_size=8,
    )
)
@settings(max_examples=25, deadline=None)
def test_stamps_bag_times_and_numbers_pass_unchanged(tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp('any')
    rows.sort(key=lambda row: row[0])
    write(folder / 'in', VECTOR, [(bag_time, vector(stamp, xyz)) for bag_time, stamp, xyz in rows])
    import_data(mapping(folder, PLAIN), folder / 'in', folder / 'out')
    found = [
        (s, m.header.stamp.sec * SECOND + m.header.stamp.nanosec, (m.vector.x, m.vector.y, m.vector.z))
        for s, m in messages(folder / 'out', '/out')
    ]
    assert found == rows


@pytest.mark.parametrize(('unit', 'value'), [('ns', ODD), ('us', ODD // 1000), ('s', 1_767_225_600)])
def test_whole_numbers_are_exact_stamps(tmp_path, unit, value):
    message = zeroed('std_msgs/msg/UInt64')
    message.data = value
    write(tmp_path / 'in', 'std_msgs/msg/UInt64', [(5, message)])
    text = PLAIN.replace('column: header.stamp', f'column: data, unit: {unit}, offset: 1')
    text = text.replace('vector: vector', 'vector.x: data')
    import_data(mapping(tmp_path, text), tmp_path / 'in', tmp_path / 'out')
    np.savez(tmp_path / 'a.npz', data=np.array([value, value]))
    (tmp_path / 'a.csv').write_text(f'data\n{value}\n')
    table = text.replace('    from: in\n', '')
    ((_, first),) = messages(tmp_path / 'out', '/out')
    scale = {'ns': 1, 'us': 1000, 's': SECOND}[unit]
    assert first.header.stamp.sec * SECOND + first.header.stamp.nanosec == value * scale + SECOND
    for source in ('a.npz', 'a.csv'):
        import_data(mapping(tmp_path, table), tmp_path / source, tmp_path / f'{source}_out')
        assert messages(tmp_path / f'{source}_out', '/out')[0][0] == value * scale + SECOND


def test_one_topic_may_become_several_and_rows_with_gaps_are_left_out(tmp_path):
    contents = [(SECOND * k, imu(SECOND * k, (k, 2.0, 3.0))) for k in range(1, 4)]
    contents[1][1].angular_velocity.x = float('nan')
    write(tmp_path / 'in', IMU, contents)
    text = """
copy: '*'
topics:
  - {topic: turn, from: in, type: std_msgs/msg/Float64, stamp: {column: header.stamp},
     fields: {data: {column: angular_velocity.z, unit: deg/s, add: 1}}}
  - {topic: rate, from: /in, type: geometry_msgs/msg/Vector3Stamped, stamp: {column: bag_time, offset: 0.5},
     fields: {vector: {columns: [angular_velocity.y, angular_velocity.x, angular_velocity.z]}}}
  - {topic: first, from: in, type: std_msgs/msg/Float64, stamp: {rate: 10},
     fields: {data: {column: orientation_covariance, index: 0}}}
"""
    counts = import_data(mapping(tmp_path, text), tmp_path / 'in', tmp_path / 'out.db3')
    assert counts == {'/in': 3, '/turn': 3, '/rate': 2, '/first': 3}
    assert messages(tmp_path / 'out.db3', '/turn')[0][1].data == pytest.approx(np.radians(4.0))
    bag_time, last = messages(tmp_path / 'out.db3', '/rate')[1]
    assert (bag_time, last.header.stamp.sec, last.header.stamp.nanosec) == (3 * SECOND, 3, SECOND // 2)
    assert (last.vector.x, last.vector.y) == (2.0, 3.0)


def test_lists_and_times_are_columns(tmp_path):
    contents = []
    for k in range(3):
        message = stamped(zeroed('sensor_msgs/msg/JointState'), ODD + k)
        message.name = ['a', 'b']
        message.position = np.array([k, 10.0 + k])
        contents.append((k, message))
    write(tmp_path / 'in', 'sensor_msgs/msg/JointState', contents)
    text = PLAIN.replace(
        'vector: vector', "vector.x: 'position[1]', vector.y: {column: header.stamp, unit: ns}"
    )
    import_data(mapping(tmp_path, text), tmp_path / 'in', tmp_path / 'out')
    found = [m for _, m in messages(tmp_path / 'out', '/out')]
    assert [m.vector.x for m in found] == [10.0, 11.0, 12.0]
    assert [m.header.stamp.nanosec for m in found] == [ODD % SECOND + k for k in range(3)]
    assert found[0].vector.y == pytest.approx(ODD * 1e-9)


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('from: in', 'from: inn', "no topic 'inn'; the bag has: /in, /names, /none, /zero"),
        ('vector: vector', 'vector: velocity', "message 0: geometry_msgs/msg/Vector3Stamped has no field"),
        ('header.stamp', 'header.time', "has no field 'header.time'"),
        ('from: in', 'from: none', 'none: has no messages'),
        ('vector: vector', 'vector.x: header.frame_id', "'header.frame_id' is not a number"),
        ('vector: vector', 'vector.x: header', "'header' is not a number"),
        ('vector: vector', 'vector.x: vector', 'has 1 components, the mapping gives 3'),
        ('header.stamp}', 'header.stamp, unit: ms}', "the stamp 'header.stamp' is a time; expected no unit"),
        ('header.stamp', 'vector', "the stamp 'vector' has 3 numbers, expected one"),
        ('column: header.stamp', 'column: vector.x, unit: km', "the stamp 'vector.x' reaches 2e+13 s"),
        ('from: in', 'from: zero', "the stamp 'header.stamp' is zero throughout"),
        ('header.stamp}', 'header.stamp, offset: -2e9}', 'add an offset'),
        ('header.stamp}', 'header.stamp, offset: -1e10}', 'offset is -1e+10 s, allowed: within 9.2e+09'),
        ('column: header.stamp', 'rate: fs', "rate 'fs' is 0 Hz"),
        ('in\n    type: geometry_msgs/msg/Vector3Stamped', 'none\n    type: std_msgs/msg/Bool', 'no field'),
        ('vector: vector', 'vector.x: bag_time.sec', "has no field 'bag_time.sec'"),
        ('topics:', 'copy: [nothing]\ntopics:', "no topic 'nothing'"),
        ('topics:', 'copy: [in, out]\ntopics:', "no topic 'out'"),
        ('topic: out', 'topic: in\n    file: a', "'file' is for tables, 'from' is for bags"),
        ('topics:', 'files: {a: a.csv}\ntopics:', "'files' is for tables, 'from' is for bags"),
        ('topics:', 'topics:\n  - {topic: a, type: std_msgs/msg/Bool, stamp: {rate: 1}, fields: {data: b}}',
         "expected 'from' in all topics (a bag) or in none"),
        ('header.stamp', 'vector.z', "row 1: the stamp 'vector.z' is not finite"),
        ('    stamp: {column: header.stamp}\n', '', "'stamp' is missing"),
        ('vector: vector', 'vector: {index: 0}', 'expected exactly one of column, columns, euler'),
        ('vector: vector', 'vector: 5', 'expected a mapping with add, column'),
        ('column: header.stamp', 'rate: [1]', 'expected a number of Hz or the name of a constant'),
        ('column: header.stamp', 'column: header.stamp, unit: [s]', "unit '['s']' is unknown"),
        ('vector: vector', 'vector: {column: vector, index: a}', "index is 'a', expected a whole number"),
        ('{vector: vector}', '{}', 'expected at least one field'),
        ('vector: vector', 'header.stamp: vector.x', "field 'header.stamp' holds no number"),
        ('vector: vector', 'header.frame_id: vector.x', "field 'header.frame_id' holds no number"),
        ('fields', 'set: {vector.x: abc}\n    fields', "set 'vector.x': 'abc' does not fit float"),
        ('fields', 'set: {vector: [1, 2]}\n    fields', "set 'vector': [1, 2] does not fit Vector3"),
        ('fields', 'set: {header: 5}\n    fields', "set 'header': 5 does not fit"),
        ('fields', 'set: {header.frame_id: 5}\n    fields', "set 'header.frame_id': 5 does not fit a text"),
        ('fields', 'set: [a]\n    fields', 'set: expected a mapping'),
        ('topics:', 'files: [a]\ntopics:', 'files: expected a mapping'),
        ('    from: in\n', '', "in.mcap: is a bag; expected tables, or 'from: TOPIC' in each topic of"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_clear_line(tmp_path, capsys, old, new, words):
    with BagWriter(tmp_path / 'in.mcap') as bag:
        for name in ('in', 'none', 'zero'):
            bag.add(name, VECTOR)
        bag.add('names', 'sensor_msgs/msg/JointState')
        for k in range(1, 3):
            bag.write('/in', k, vector(ODD, (1e10 * k, 0.0, 0.0 if k == 1 else float('nan'))))
            bag.write('/zero', k, vector(0, (1.0, 0.0, 0.0)))
            joints = stamped(zeroed('sensor_msgs/msg/JointState'), ODD)
            joints.position = np.zeros(k)
            bag.write('/names', k, joints)
    assert old in PLAIN
    text = mapping(tmp_path, PLAIN.replace(old, new))
    assert tool.main([text, str(tmp_path / 'in.mcap'), str(tmp_path / 'out')]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert words in err
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('field', 'words'),
    [
        ('position', "'position' changes its length from message to message"),
        ("'position[1]'", "message 0: sensor_msgs/msg/JointState has no field 'position[1]'"),
        ('velocity', "'velocity' is empty"),
        ('name', "'name' is not a number"),
    ],
)
def test_lists_that_fit_no_column_are_one_clear_line(tmp_path, capsys, field, words):
    contents = []
    for k in range(1, 3):
        message = stamped(zeroed('sensor_msgs/msg/JointState'), ODD)
        message.position, message.name = np.zeros(k), ['a', 'b']
        contents.append((k, message))
    write(tmp_path / 'in', 'sensor_msgs/msg/JointState', contents)
    text = PLAIN.replace('vector: vector', f'vector.x: {field}')
    assert tool.main([mapping(tmp_path, text), str(tmp_path / 'in'), str(tmp_path / 'out')]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert words in err


def test_a_topic_may_replace_its_source_but_not_be_copied_too(tmp_path):
    write(tmp_path / 'in', VECTOR, [(1, vector(ODD, (1.0, 2.0, 3.0)))])
    text = PLAIN.replace('topic: out', 'topic: in').replace('{vector: vector}', '{vector.z: vector.y}')
    assert import_data(mapping(tmp_path, f"copy: '*'{text}"), tmp_path / 'in', tmp_path / 'out') == {'/in': 1}
    assert messages(tmp_path / 'out', '/in')[0][1].vector.z == 2.0
    with pytest.raises(BagError, match="topic '/in' cannot be copied, the mapping writes it"):
        import_data(mapping(tmp_path, f'copy: in{text}'), tmp_path / 'in', tmp_path / 'out2')


def test_a_number_too_large_for_its_field_is_named_with_its_source(tmp_path):
    write(tmp_path / 'in', VECTOR, [(1, vector(ODD, (300.0, 0.0, 0.0)))])
    text = PLAIN.replace('geometry_msgs/msg/Vector3Stamped', 'std_msgs/msg/UInt8')
    text = text.replace('vector: vector', 'data: vector.x')
    with pytest.raises(BagError, match=r"in:/in: '/out' at .* a number does not fit its field"):
        import_data(mapping(tmp_path, text), tmp_path / 'in', tmp_path / 'out')


def test_sources_of_other_kinds_are_named(tmp_path, capsys):
    (tmp_path / 'old.bag').write_bytes(b'#ROSBAG V2.0\n')
    (tmp_path / 'in.csv').write_text('a\n1\n')
    (tmp_path / 'folder').mkdir()
    path = mapping(tmp_path, PLAIN)
    for source, words in (
        ('old.bag', 'is a bag of ROS 1; convert it: rosbags-convert --src'),
        ('in.csv', 'not a bag; expected a rosbag2 folder'),
        ('folder', 'no metadata.yaml in this folder'),
        ('absent', 'no such file or folder'),
    ):
        assert tool.main([path, str(tmp_path / source), str(tmp_path / 'out')]) == 2
        err = capsys.readouterr().err
        assert err.count('\n') == 1
        assert words in err
    write(tmp_path / 'in', VECTOR, [(1, vector(ODD, (1.0, 2.0, 3.0)))])
    tables = mapping(tmp_path, PLAIN.replace('    from: in\n', ''))
    assert tool.main([tables, str(tmp_path / 'in'), str(tmp_path / 'out')]) == 2
    assert 'is a bag; expected tables' in capsys.readouterr().err
    copying = mapping(tmp_path, 'copy: a' + PLAIN.replace('    from: in\n', ''))
    assert tool.main([copying, str(tmp_path / 'in.csv'), str(tmp_path / 'out')]) == 2
    assert "'copy' is for bags" in capsys.readouterr().err


def test_a_bag_of_ros_1_converts_as_the_error_says(tmp_path, monkeypatch):
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types['std_msgs/msg/Header'](7, types['builtin_interfaces/msg/Time'](1_767_225_600, 5), 'imu')
    message = types[VECTOR](header, types['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0))
    with rosbag1.Writer(tmp_path / 'my old.bag') as bag:
        connection = bag.add_connection('/in', VECTOR, typestore=store)
        bag.write(connection, ODD, store.serialize_ros1(message, VECTOR))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BagError, match='is a bag of ROS 1; convert it: ') as raised:
        import_data(mapping(tmp_path, PLAIN), Path('my old.bag'), 'out')
    monkeypatch.setattr('sys.argv', shlex.split(str(raised.value).partition('convert it: ')[2]))
    with pytest.raises(SystemExit, match='0'):
        convert()
    import_data(mapping(tmp_path, PLAIN), Path('my old'), 'out')
    ((bag_time, found),) = messages('out', '/out')
    assert (bag_time, found.header.stamp.nanosec, found.vector.y) == (ODD, 5, 2.0)


def axes_table():
    """Return (signs read, force factors, factors of the rest) of each row of the FAQ."""
    text = (FIXTURE.parents[1] / 'docs' / 'faq.md').read_text(encoding='utf-8')
    rows = re.findall(r'^\| ([+−]) ([+−]) ([+−]) \|.*?\| (.*?) \| (.*?) \|$', text, re.MULTILINE)
    for *signs, force, rest in rows:
        read = np.array([1 if s == '+' else -1 for s in signs])
        numbers = [np.array(re.findall(r'-?1', cell) or [1, 1, 1], dtype=int) for cell in (force, rest)]
        yield read, *numbers


def test_the_axes_of_the_faq_restore_the_force_and_never_mirror():
    rows = list(axes_table())
    assert len({tuple(read) for read, _, _ in rows}) == len(rows) == 5
    for read, force, rest in rows:
        # Each position shows the sign of one axis of the specific force, + in our own.
        assert np.array_equal(read * force, [1, 1, 1])
        assert np.prod(rest) == 1
        # What is not a rotation of the force is one of its opposite: the sensor reports gravity.
        assert np.array_equal(force, rest * np.prod(read))
