# SPDX-License-Identifier: Apache-2.0
"""The compiled codec against rosbags' own, for every type of Jazzy and for damaged bytes."""

import dataclasses

import numpy as np
import pytest
from bag_samples import IMU, SECOND, imu
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError

from bag_tools.bag import jazzy, zeroed
from bag_tools.cdr import decoder, encoder
from bag_tools.content import first_difference

DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
INTEGERS = {'byte': 'int8', 'char': 'uint8'}


def number(rng, name):
    if name == 'bool':
        return bool(rng.integers(2))
    if name in ('string', 'wstring'):
        return ''.join(rng.choice(list('aß√0'), int(rng.integers(6))))
    if name.startswith('float'):
        return float(np.dtype(name).type(rng.normal()))
    info = np.iinfo(INTEGERS.get(name, name))
    return int(rng.integers(info.min, info.max, endpoint=True, dtype=info.dtype))


def value(rng, kind, detail):
    if kind == Nodetype.BASE:
        return number(rng, detail[0])
    if kind == Nodetype.NAME:
        return random_message(rng, detail)
    (element_kind, element), length = detail
    count = length if kind == Nodetype.ARRAY else int(rng.integers(4))
    items = [value(rng, element_kind, element) for _ in range(count)]
    if element_kind == Nodetype.BASE and element[0] not in ('string', 'wstring'):
        return np.array(items, dtype=INTEGERS.get(element[0], element[0]))
    return items


def random_message(rng, type_name):
    fields = jazzy().fielddefs[type_name][1]
    return jazzy().types[type_name](*(value(rng, kind, detail) for _, (kind, detail) in fields))


@pytest.mark.parametrize('package', sorted({name.split('/')[0] for name in jazzy().fielddefs}))
def test_every_type_of_jazzy_is_coded_as_rosbags_codes_it(package):
    rng = np.random.default_rng(0)
    checked = 0
    for type_name in jazzy().fielddefs:
        if not type_name.startswith(f'{package}/'):
            continue
        decode, encode = decoder(jazzy(), type_name), encoder(jazzy(), type_name)
        for _ in range(8):
            message = random_message(rng, type_name)
            data = bytes(jazzy().serialize_cdr(message, type_name))
            assert encode(message) == data, type_name
            for padding in (b'', b'\x7f\x7f\x7f'):
                ours, theirs = decode(data + padding), jazzy().deserialize_cdr(data + padding, type_name)
                assert first_difference(ours, theirs) == '', type_name
                assert type(ours) is type(theirs)
        checked += 1
    assert checked


def kinds(message):
    return [type(getattr(message, f.name)) for f in dataclasses.fields(message)]


def test_fields_have_the_types_of_rosbags():
    message = random_message(np.random.default_rng(1), 'sensor_msgs/msg/PointCloud2')
    data = bytes(jazzy().serialize_cdr(message, 'sensor_msgs/msg/PointCloud2'))
    ours = decoder(jazzy(), 'sensor_msgs/msg/PointCloud2')(data)
    theirs = jazzy().deserialize_cdr(data, 'sensor_msgs/msg/PointCloud2')
    assert kinds(ours) == kinds(theirs)
    assert ours.data.dtype == theirs.data.dtype


def test_big_endian_bytes_are_read_too():
    message = imu(SECOND + 5, (1.0, -2.0, 3.0))
    data = bytes(jazzy().serialize_cdr(message, IMU, little_endian=False))
    assert first_difference(decoder(jazzy(), IMU)(data), message) == ''


def outcome(decode, data):
    """Return the message, or what the refusal says."""
    try:
        return decode(data)
    except SerdeError as error:
        return str(error)


@pytest.mark.parametrize('type_name', [IMU, 'sensor_msgs/msg/JointState', DIAGNOSTICS])
def test_damaged_bytes_are_taken_or_refused_as_rosbags_does(type_name):
    rng = np.random.default_rng(2)
    decode = decoder(jazzy(), type_name)
    refused = 0
    for _ in range(300):
        data = bytearray(jazzy().serialize_cdr(random_message(rng, type_name), type_name))
        if rng.integers(2):
            data = data[: rng.integers(len(data))]
        for _ in range(rng.integers(1, 4)):
            if data:
                data[rng.integers(len(data))] = rng.integers(256)
        ours = outcome(decode, bytes(data))
        theirs = outcome(lambda d: jazzy().deserialize_cdr(d, type_name), bytes(data))
        if isinstance(theirs, str):
            refused += 1
            assert ours == theirs
        else:
            assert first_difference(ours, theirs) == ''
    assert 0 < refused < 300


@pytest.mark.parametrize('wrong', [np.zeros(8), np.zeros(10), np.zeros(9, dtype=np.float32)])
def test_arrays_of_the_wrong_size_are_refused(wrong):
    message = zeroed(IMU)
    message.orientation_covariance = wrong
    with pytest.raises((SerdeError, ValueError)):
        encoder(jazzy(), IMU)(message)
