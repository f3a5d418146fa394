# SPDX-License-Identifier: Apache-2.0
"""Bags are written whole or not at all, read whatever the storage, and refused with one clear line."""

import importlib
import resource
from contextlib import contextmanager

import numpy as np
import pytest
from bag_samples import IMU, SECOND, imu, write_sensors
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from bag_tools.bag import BagError, BagReader, BagWriter, jazzy, resolve, zeroed
from bag_tools.content import content_hash, flatten

STORAGES = [
    ('bag', {}),
    ('bag', {'compression': 'zstd'}),
    ('bag', {'storage': 'sqlite3'}),
    ('bag', {'storage': 'sqlite3', 'compression': 'zstd'}),
    ('bag.mcap', {}),
    ('bag.mcap', {'compression': 'zstd'}),
    ('bag.db3', {}),
]


def read(path):
    with BagReader(path) as reader:
        return [(t, s, reader.decode(d, reader.topics[t].type)) for t, s, d in reader.messages()]


@pytest.mark.parametrize(('name', 'options'), STORAGES)
def test_round_trip_keeps_order_stamps_and_every_bit(tmp_path, name, options):
    values = np.random.default_rng(0).normal(size=(50, 3))
    with BagWriter(tmp_path / name, **options) as bag:
        bag.add('a', IMU)
        bag.add('/b', IMU)
        for k, v in enumerate(values):
            # Equal stamps: the order of writing decides.
            bag.write('/b' if k % 2 else '/a', SECOND + k // 4, imu(SECOND + k, v))
    messages = read(tmp_path / name)
    assert [t for t, _, _ in messages] == ['/b' if k % 2 else '/a' for k in range(50)]
    assert [s for _, s, _ in messages] == [SECOND + k // 4 for k in range(50)]
    got = np.array(
        [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for _, _, m in messages]
    )
    assert got.tobytes() == values.tobytes()


def test_all_storages_hold_the_same_content(tmp_path):
    hashes = set()
    for index, (name, options) in enumerate(STORAGES):
        folder = tmp_path / str(index)
        hashes.add(content_hash(write_sensors(folder / name, **options)))
    assert len(hashes) == 1


def test_topics_tell_type_count_and_durability(tmp_path):
    write_sensors(tmp_path / 'bag', seconds=1.0)
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.topics['/imu/data_raw'].type == IMU
        assert reader.topics['/imu/data_raw'].count == 100
        assert reader.topics['/imu/mag'].count == 25
        assert reader.topics['/note'].latched
        assert reader.topics['/note'].qos[0].durability == QosDurability.TRANSIENT_LOCAL
        assert not reader.topics['/imu/mag'].latched
        assert reader.topic('imu/mag').name == '/imu/mag'
        with pytest.raises(
            BagError, match="no topic '/gps'; the bag has: /aux, /imu/data_raw, /imu/mag, /note"
        ):
            reader.topic('/gps')


def test_window_and_topics_select_messages(tmp_path):
    write_sensors(tmp_path / 'bag', seconds=1.0)
    with BagReader(tmp_path / 'bag') as reader:
        stamps = [s for _, s, _ in reader.messages(['/imu/mag'], SECOND + 40_000_000, SECOND + 120_000_000)]
        assert stamps == [SECOND + 40_000_000, SECOND + 80_000_000]
        assert list(reader.messages(['/absent'])) == []


def test_an_empty_bag_is_a_bag(tmp_path):
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.add('imu', IMU)
    with BagReader(tmp_path / 'bag.mcap') as reader:
        assert (reader.count, reader.start, reader.stop) == (0, 0, 0)
        assert list(reader.messages()) == []


@pytest.mark.parametrize('name', ['bag', 'bag.mcap', 'bag.db3'])
def test_a_failed_write_leaves_nothing(tmp_path, name):
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / name) as bag:  # noqa: PT012
        bag.add('imu', IMU)
        bag.write('/imu', SECOND, imu(SECOND, (1, 2, 3)))
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


@contextmanager
def disk_of(size):
    """No file may grow beyond `size` bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize('name', ['bag', 'bag.mcap', 'bag.db3'])
@pytest.mark.parametrize('salvage', [True, False])
@pytest.mark.parametrize('count', [10, 3000], ids=['at the end', 'on the way'])
def test_a_full_disk_is_named_and_what_it_took_can_be_salvaged(tmp_path, name, salvage, count):
    size = 2_500_000 if count > 10 else 2_000
    message = zeroed('std_msgs/msg/String')
    message.data = 'x' * 1000
    with (  # noqa: PT012
        disk_of(size),
        pytest.raises(BagError, match=name) as caught,
        BagWriter(tmp_path / name, salvage=salvage) as bag,
    ):
        bag.add('words', 'std_msgs/msg/String')
        for stamp in range(count):
            bag.write('/words', stamp, message)
    assert not (tmp_path / name).exists()
    left = [f for f in tmp_path.rglob('*') if f.is_file()]
    # SQLite has its tables to write before anything can be salvaged.
    kept = salvage and not (name == 'bag.db3' and count == 10)
    assert bool(left) == kept
    assert ('what was written before is in' in str(caught.value)) == kept
    if salvage and name != 'bag.db3' and count > 10:
        assert left[0].read_bytes().startswith(b'\x89MCAP')
        assert left[0].stat().st_size > 1_000_000


@pytest.mark.parametrize('error', [BagError('no'), ZeroDivisionError('no')])
@pytest.mark.parametrize('count', [0, 3])
def test_an_error_leaves_a_recording_finished_under_its_temporary_name(tmp_path, error, count):
    with (  # noqa: PT012
        pytest.raises(type(error), match='no') as caught,
        BagWriter(tmp_path / 'bag', salvage=True) as bag,
    ):
        bag.add('imu', IMU)
        for k in range(count):
            bag.write('/imu', k, imu(k, (1, 2, 3)))
        raise error
    assert not (tmp_path / 'bag').exists()
    found = [*tmp_path.glob('.bag.*.partial/bag')]
    assert len(found) == bool(count)
    if found:
        with BagReader(found[0]) as reader:
            assert reader.count == 3
        assert str(found[0].parent) in f'{caught.value}{getattr(caught.value, "__notes__", "")}'


def test_a_failed_write_keeps_the_bag_it_would_have_replaced(tmp_path):
    before = content_hash(write_sensors(tmp_path / 'bag'))
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / 'bag', overwrite=True):
        raise ZeroDivisionError
    assert content_hash(tmp_path / 'bag') == before


def test_existing_names_are_not_overwritten_unless_asked_and_only_bags_are(tmp_path):
    write_sensors(tmp_path / 'bag', seconds=0.1)
    with pytest.raises(BagError, match='exists already'):
        BagWriter(tmp_path / 'bag')
    write_sensors(tmp_path / 'bag', seconds=0.2, overwrite=True)
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.topics['/imu/data_raw'].count == 20
    (tmp_path / 'home').mkdir()
    with pytest.raises(BagError, match='is not a bag and is not overwritten'):
        BagWriter(tmp_path / 'home', overwrite=True)


@pytest.mark.parametrize(
    ('name', 'options', 'words'),
    [
        ('bag', {'storage': 'csv'}, 'expected mcap or sqlite3'),
        ('bag', {'compression': 'gzip'}, 'expected none or zstd'),
        ('bag.mcap', {'storage': 'sqlite3'}, 'does not fit'),
        ('bag.db3', {'compression': 'zstd'}, 'cannot be compressed'),
    ],
)
def test_bad_writer_options_name_what_was_expected(tmp_path, name, options, words):
    with pytest.raises(BagError, match=words):
        BagWriter(tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_bad_topics_and_stamps_are_refused(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('imu', IMU)
        with pytest.raises(BagError, match='two types'):
            bag.add('/imu', 'std_msgs/msg/String')
        with pytest.raises(BagError, match="'my_msgs/msg/Odd' of topic '/odd' is unknown"):
            bag.add('odd', 'my_msgs/msg/Odd')
        with pytest.raises(BagError, match='negative bag time -1'):
            bag.write('/imu', -1, imu(SECOND, (0, 0, 0)))


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(BagError, match=r'absent: no such file'):
        BagReader(tmp_path / 'absent')
    (tmp_path / 'notes.txt').write_text('no bag')
    with pytest.raises(BagError, match=r'notes\.txt: not a bag; expected a rosbag2 folder'):
        BagReader(tmp_path / 'notes.txt')
    with pytest.raises(BagError, match=r'no metadata\.yaml'):
        BagReader(tmp_path)


@pytest.mark.parametrize('suffix', ['.mcap', '.db3'])
@pytest.mark.parametrize('keep', [0.0, 0.001, 0.3, 0.7, 0.999])
def test_truncated_files_are_refused_by_name(tmp_path, suffix, keep):
    whole = write_sensors(tmp_path / f'whole{suffix}', seconds=4.0).read_bytes()
    cut = tmp_path / f'cut{suffix}'
    cut.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(BagError, match=rf'cut\{suffix}: '):
        read(cut)


@pytest.mark.parametrize('suffix', ['.mcap', '.db3'])
def test_no_damage_raises_anything_but_bag_error(tmp_path, suffix):
    whole = bytearray(write_sensors(tmp_path / f'whole{suffix}', seconds=1.0).read_bytes())
    rng = np.random.default_rng(3)
    messages = []
    for _ in range(60):
        broken = whole.copy()
        at = rng.integers(0, len(whole), 40)
        for index in at:
            broken[index] ^= int(rng.integers(1, 256))
        path = tmp_path / f'broken{suffix}'
        path.write_bytes(broken)
        try:
            read(path)
        except BagError as error:
            messages.append(str(error))
    assert messages
    assert all(f'broken{suffix}' in m for m in messages)


def test_a_folder_that_lost_its_metadata_is_still_read(tmp_path):
    write_sensors(tmp_path / 'bag', seconds=0.5)
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.topics['/imu/data_raw'].count == 50


def test_definitions_in_the_bag_win_over_jazzys(tmp_path):
    store = get_typestore(Stores.ROS2_FOXY)
    old = store.types['sensor_msgs/msg/Range']  # Jazzy's has a field more
    header = store.types['std_msgs/msg/Header'](store.types['builtin_interfaces/msg/Time'](1, 0), 'sonar')
    with Writer(tmp_path / 'bag', version=9) as bag:
        connection = bag.add_connection('/range', 'sensor_msgs/msg/Range', typestore=store)
        message = old(header, 0, 0.1, 0.2, 9.0, 4.5)
        bag.write(connection, SECOND, store.serialize_cdr(message, 'sensor_msgs/msg/Range'))
    ((_, _, read_back),) = read(tmp_path / 'bag')
    assert read_back.range == 4.5
    assert 'variance' not in dict(flatten(read_back))
    assert 'variance' in dict(flatten(zeroed('sensor_msgs/msg/Range')))


def leaves(message, path=''):
    """Walk an rclpy message as `flatten` walks rosbags'."""
    if hasattr(message, 'get_fields_and_field_types'):
        for name in message.get_fields_and_field_types():
            yield from leaves(getattr(message, name), f'{path}.{name}' if path else name)
    elif isinstance(message, list | tuple | np.ndarray) or type(message).__name__ == 'array':
        for index, element in enumerate(message):
            yield from leaves(element, f'{path}[{index}]')
    else:
        yield path, message


@pytest.mark.parametrize(
    'package', ['std_msgs', 'geometry_msgs', 'sensor_msgs', 'nav_msgs', 'diagnostic_msgs', 'rosgraph_msgs']
)
def test_zeroed_messages_are_what_ros_constructs(package):
    module = importlib.import_module(f'{package}.msg')
    checked = 0
    for name in dir(module):
        type_name = f'{package}/msg/{name}'
        if type_name not in jazzy().fielddefs:
            continue
        ours = {k.rstrip('_'): v for k, v in flatten(zeroed(type_name))}
        for path, value in leaves(getattr(module, name)()):
            expected = value[0] if isinstance(value, bytes) else value
            assert ours[path] == expected, (type_name, path)
        checked += 1
    assert checked


def test_unknown_types_are_named():
    with pytest.raises(BagError, match="'my_msgs/msg/Odd' is unknown"):
        zeroed('my_msgs/msg/Odd')


def test_names_resolve_as_in_ros():
    assert resolve('imu/data') == '/imu/data'
    assert resolve('/imu') == '/imu'
    assert resolve('~/state', 'ns/filter') == '/ns/filter/state'
    assert resolve('imu', namespace='/boat') == '/boat/imu'
