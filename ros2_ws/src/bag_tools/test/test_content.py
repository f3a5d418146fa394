# SPDX-License-Identifier: Apache-2.0
"""Equality is that of decoded fields, to the last bit; the first difference is named."""

import json

import numpy as np
import pytest
from bag_samples import IMU, SECOND, imu, write_sensors

from bag_tools import compare as compare_tool
from bag_tools import info, manifest
from bag_tools.bag import BagError, BagReader, BagWriter, jazzy
from bag_tools.content import compare, content_hash


def write(path, rows, topic='imu', overwrite=False):
    with BagWriter(path, overwrite=overwrite) as bag:
        bag.add(topic, IMU)
        for stamp, message in rows:
            bag.write(f'/{topic}', stamp, message)
    return path


def one(path, x, **options):
    return write(path, [(SECOND, imu(SECOND, (x, 0.0, 0.0)))], **options)


def test_padding_does_not_count(tmp_path):
    data = bytearray(jazzy().serialize_cdr(imu(SECOND, (1.0, 2.0, 3.0)), IMU))
    # CDR aligns the first double after a four-byte string length and its one-byte terminator.
    padding = next(i for i in range(16, 24) if not any(data[i:24]))
    for name, byte in (('a', 0x00), ('b', 0xAB)):
        data[padding + 1 : 20] = bytes([byte] * (20 - padding - 1))
        with BagWriter(tmp_path / name) as bag:
            bag.add('imu', IMU)
            bag.write_raw('/imu', SECOND, bytes(data))
    with BagReader(tmp_path / 'a') as a, BagReader(tmp_path / 'b') as b:
        assert next(a.messages())[2] != next(b.messages())[2]
    assert all(r.equal for r in compare(tmp_path / 'a', tmp_path / 'b', stamps=True))
    assert content_hash(tmp_path / 'a') == content_hash(tmp_path / 'b')


@pytest.mark.parametrize(('x', 'y'), [(1.0, np.nextafter(1.0, 2.0)), (0.0, -0.0), (np.nan, 1.0)])
def test_one_bit_is_a_difference_and_is_named(tmp_path, x, y):
    (result,) = compare(one(tmp_path / 'a', float(x)), one(tmp_path / 'b', float(y)))
    assert not result.equal
    assert result.difference.startswith('message 0: angular_velocity.x: ')
    assert content_hash(tmp_path / 'a') != content_hash(tmp_path / 'b')


def test_nan_equals_itself(tmp_path):
    (result,) = compare(one(tmp_path / 'a', float('nan')), one(tmp_path / 'b', float('nan')))
    assert result.equal


def test_tolerance_is_for_other_machines(tmp_path):
    one(tmp_path / 'a', 1.0)
    one(tmp_path / 'b', 1.0 + 1e-10)
    (result,) = compare(tmp_path / 'a', tmp_path / 'b', tolerance=1e-9)
    assert result.equal
    assert result.largest == pytest.approx(1e-10, rel=1e-3)
    assert not compare(tmp_path / 'a', tmp_path / 'b', tolerance=1e-11)[0].equal


def test_bag_times_count_only_when_asked(tmp_path):
    message = imu(SECOND, (1.0, 0.0, 0.0))
    write(tmp_path / 'a', [(SECOND, message)])
    write(tmp_path / 'b', [(SECOND + 5, message)])
    assert compare(tmp_path / 'a', tmp_path / 'b')[0].equal
    assert 'bag time' in compare(tmp_path / 'a', tmp_path / 'b', stamps=True)[0].difference


def test_missing_messages_and_topics_are_differences(tmp_path):
    rows = [(SECOND + k, imu(SECOND + k, (k, 0.0, 0.0))) for k in range(3)]
    write(tmp_path / 'a', rows)
    write(tmp_path / 'b', rows[:2])
    assert compare(tmp_path / 'a', tmp_path / 'b')[0].difference == '3 != 2 messages'
    write(tmp_path / 'c', rows, topic='other')
    assert {r.topic for r in compare(tmp_path / 'a', tmp_path / 'c') if not r.equal} == {'/imu', '/other'}


def test_compare_exits_with_what_it_found(tmp_path, capsys):
    a, b = str(one(tmp_path / 'a', 1.0)), str(one(tmp_path / 'b', 2.0))
    assert compare_tool.main([a, a]) == 0
    assert compare_tool.main([a, b]) == 1
    assert 'angular_velocity.x: 1.0 != 2.0' in capsys.readouterr().out
    assert compare_tool.main([a, str(tmp_path / 'absent')]) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert 'absent: no such file' in err


def test_info_counts_rates_and_gaps(tmp_path, capsys):
    stamps = [SECOND + k * 10_000_000 for k in range(101) if not 40 < k < 50]
    write(tmp_path / 'a', [(s, imu(s, (0.0, 0.0, 1.0))) for s in stamps])
    described = info.describe(tmp_path / 'a')
    (topic,) = described.topics
    assert topic.rate == pytest.approx(100.0)
    assert topic.longest_step == pytest.approx(0.1)
    assert topic.gaps == 1
    assert described.duration == pytest.approx(1.0)
    assert described.hash == content_hash(tmp_path / 'a')
    assert info.main([str(tmp_path / 'a'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)[0]['count'] == 92
    assert info.main([str(tmp_path / 'a'), '--no-hash']) == 0
    text = capsys.readouterr().out
    assert '100.00 Hz' in text
    assert 'sha256' not in text


def test_manifest_finds_every_kind_of_drift(tmp_path):
    for name in ('kept.mcap', 'changed.mcap', 'lost.mcap'):
        write_sensors(tmp_path / name, seconds=0.2)
    names = ('kept.mcap', 'changed.mcap', 'lost.mcap')
    entries = {n: manifest.entry_of(tmp_path / n, './ws bags', seed=1, text='test') for n in names}
    manifest.write(tmp_path, entries)
    assert manifest.read(tmp_path) == entries
    assert manifest.verify(tmp_path) == []
    write_sensors(tmp_path / 'changed.mcap', seconds=0.2, seed=2, overwrite=True)
    (tmp_path / 'lost.mcap').unlink()
    write_sensors(tmp_path / 'stray.mcap', seconds=0.2)
    assert [line.split(':')[0] for line in manifest.verify(tmp_path)] == [
        'changed.mcap',
        'lost.mcap',
        'stray.mcap',
    ]


@pytest.mark.parametrize('text', ['- a list', 'bag.mcap: {seed: 1}', 'bag.mcap: 3', 'a: [', None])
def test_a_bad_manifest_is_named(tmp_path, text):
    if text is not None:
        (tmp_path / manifest.NAME).write_text(text)
    with pytest.raises(BagError, match=r'manifest\.yaml: '):
        manifest.read(tmp_path)
