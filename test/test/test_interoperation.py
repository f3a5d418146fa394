# SPDX-License-Identifier: Apache-2.0
"""What is written here is what rosbag2, Foxglove and PlotJuggler read: checked on the bytes themselves."""

import json
import re
import struct
import xml.etree.ElementTree as ET

import pytest
import yaml
from workspace_harness.make_bags import PACKAGES, fixtures

from bag_tools.bag import BagReader, BagWriter, zeroed
from bag_tools.registry import find_ports

MAGIC = b'\x89MCAP0\r\n'
SCHEMA, CHANNEL, STATISTICS = 3, 4, 11


def text(body, at):
    """Return a string with its length before it, and where it ends."""
    (length,) = struct.unpack_from('<I', body, at)
    return body[at + 4 : at + 4 + length].decode(), at + 4 + length


def summary(path):
    """Yield (opcode, body) of the summary section, read by the MCAP specification alone."""
    raw = path.read_bytes()
    assert raw.startswith(MAGIC)
    assert raw.endswith(MAGIC)
    # Footer: opcode, length, summary start, summary offset start, checksum; then the magic.
    at = struct.unpack_from('<Q', raw, len(raw) - len(MAGIC) - 20)[0]
    assert at > 0
    while at < len(raw) - len(MAGIC):
        (length,) = struct.unpack_from('<Q', raw, at + 1)
        yield raw[at], raw[at + 9 : at + 9 + length]
        at += 9 + length


@pytest.mark.parametrize('name', sorted(fixtures()))
def test_a_fixture_is_an_mcap_of_the_ros2_profile(bags, name):
    path = bags / name
    assert text(path.read_bytes(), 17)[0] == 'ros2'
    schemas, channels = {}, {}
    for opcode, body in summary(path):
        if opcode == SCHEMA:
            schema, at = text(body, 2)
            encoding, at = text(body, at)
            definition, _ = text(body, at)
            assert encoding == 'ros2msg'
            # Types of fields that are messages themselves follow, each under its own name.
            for other in re.findall(r'^([a-z]\w*/[A-Z]\w*)(?:\[.*?\])? \w+$', definition, re.MULTILINE):
                assert f'MSG: {other}' in definition.replace('/msg/', '/'), (schema, other)
            schemas[struct.unpack_from('<H', body)[0]] = schema
        elif opcode == CHANNEL:
            topic, at = text(body, 4)
            encoding, at = text(body, at)
            _, at = text(body, at + 4)
            profiles = yaml.safe_load(text(body, at)[0])
            assert encoding == 'cdr'
            assert {'reliability', 'durability', 'history', 'depth'} <= set(profiles[0])
            channels[topic] = schemas[struct.unpack_from('<H', body, 2)[0]]
    with BagReader(path) as reader:
        assert channels == {topic.name: topic.type for topic in reader.topics.values()}


def test_a_folder_has_the_metadata_that_rosbag2_reads(tmp_path):
    latched = zeroed('std_msgs/msg/String')
    with BagWriter(tmp_path / 'run') as writer:
        writer.add('/said', 'std_msgs/msg/String')
        for stamp in (1_000, 2_000):
            writer.write('/said', stamp, latched)
    about = yaml.safe_load((tmp_path / 'run' / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert about['storage_identifier'] == 'mcap'
    assert about['message_count'] == 2
    assert about['duration']['nanoseconds'] == 1_000
    assert [(tmp_path / 'run' / name).is_file() for name in about['relative_file_paths']] == [True]
    (entry,) = about['topics_with_message_count']
    assert entry['topic_metadata']['name'] == '/said'
    assert entry['topic_metadata']['type'] == 'std_msgs/msg/String'
    assert entry['topic_metadata']['serialization_format'] == 'cdr'


def known_topics(bags):
    """Return the type of every topic of the fixtures and of every estimator's output."""
    found = {'/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray'}
    for name in fixtures():
        with BagReader(bags / name) as reader:
            found |= {topic.name: topic.type for topic in reader.topics.values()}
    for package in PACKAGES:
        for estimator in __import__(f'{package}.codec', fromlist=['ESTIMATORS']).ESTIMATORS:
            outputs = find_ports(package, estimator).outputs.values()
            found |= {f'/{output.topic}': output.type for output in outputs}
    return found


def has(type_name, path):
    message = zeroed(type_name)
    for part in path:
        if not hasattr(message, part):
            return False
        message = getattr(message, part)
    return isinstance(message, float | int) or hasattr(message, '__len__')


def curves(path):
    """Return (topic, field path) of every curve of a layout."""
    if path.suffix == '.xml':
        names = [curve.get('name') for curve in ET.parse(path).getroot().iter('curve')]
        yield from names
        return
    layout = json.loads(path.read_text(encoding='utf-8'))
    assert set(re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout']))) == set(layout['configById'])
    for panel in layout['configById'].values():
        for entry in panel.get('paths', ()):
            yield re.sub(r'\[\d+\]', '', entry['value']).replace('.', '/')
        if 'topicToRender' in panel:
            yield panel['topicToRender'] + '/status'


def test_every_curve_of_a_layout_is_a_field_of_a_topic(bags, root):
    topics = known_topics(bags)
    layouts = sorted((root / 'docs' / 'layouts').iterdir())
    assert len(layouts) == 4
    for layout in layouts:
        for curve in curves(layout):
            topic = max((name for name in topics if curve.startswith(f'{name}/')), key=len, default=None)
            assert topic is not None, (layout.name, curve)
            assert has(topics[topic], curve[len(topic) + 1 :].split('/')), (layout.name, curve)
