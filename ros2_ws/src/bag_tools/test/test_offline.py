# SPDX-License-Identifier: Apache-2.0
"""The offline runner does what the estimator says, the same each time, and refuses what cannot work."""

import sys
import types

import numpy as np
import pytest
from bag_samples import ESTIMATORS, IMU, MIX, SECOND, MixParams, imu, write_sensors

from bag_tools import offline as tool
from bag_tools.bag import BagError, BagReader, BagWriter
from bag_tools.content import content_hash
from bag_tools.offline import offline
from bag_tools.registry import find_importer, find_ports
from bag_tools.rosargs import estimator_parameters, file_parameters, parse, remapped, split
from kalman_core.parameters import ParameterError


@pytest.fixture
def package(monkeypatch):
    """A package 'mixer' with the estimators of bag_samples."""
    codec = types.ModuleType('mixer.codec')
    codec.ESTIMATORS = ESTIMATORS
    monkeypatch.setitem(sys.modules, 'mixer', types.ModuleType('mixer'))
    monkeypatch.setitem(sys.modules, 'mixer.codec', codec)
    return 'mixer'


def vectors(path, topic):
    with BagReader(path) as reader:
        rows = [(s, reader.decode(d, reader.topics[t].type)) for t, s, d in reader.messages([topic])]
    return [s for s, _ in rows], np.array([[m.vector.x, m.vector.y, m.vector.z] for _, m in rows])


def test_outputs_are_the_estimators_at_the_time_of_their_cause(tmp_path):
    rng = np.random.default_rng(5)
    rates = rng.normal(size=(20, 3))
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', IMU)
        for k, rate in enumerate(rates):
            # Received a second after it was measured.
            bag.write('/imu/data_raw', 2 * SECOND + k, imu(SECOND + k, rate))
    result = offline(MIX, {'leak': 0.5}, tmp_path / 'in', tmp_path / 'out.mcap')
    state, expected = np.zeros(3), []
    for rate in rates:
        state = state + 0.5 * (rate - state)
        expected.append(state)
    stamps, got = vectors(tmp_path / 'out.mcap', '/mixture')
    assert stamps == [2 * SECOND + k for k in range(20)]
    assert got.tobytes() == np.array(expected).tobytes()
    assert result.inputs == {'/imu/data_raw': 20}
    assert result.outputs == {'/mixture': 20, '/slow': 0}
    assert result.tally.sensors['imu/data_raw'].accepted == 20


def test_twenty_runs_give_one_content(tmp_path):
    write_sensors(tmp_path / 'in', seconds=1.0)
    hashes = set()
    for k in range(20):
        offline(MIX, {}, tmp_path / 'in', tmp_path / f'out{k}')
        hashes.add(content_hash(tmp_path / f'out{k}'))
    assert len(hashes) == 1


def test_copies_remaps_and_latched_outputs(tmp_path):
    write_sensors(tmp_path / 'in', seconds=1.0)
    remaps = {'mixture': 'a/mixture', '/slow': '~/slow'}
    offline(MIX, MixParams(), tmp_path / 'in', tmp_path / 'out', remaps, copy=['note', '/imu/mag'])
    with BagReader(tmp_path / 'out') as reader:
        assert {n: t.count for n, t in reader.topics.items()} == {
            '/a/mixture': 125,
            '/mix/slow': 25,
            '/note': 1,
            '/imu/mag': 25,
        }
        assert reader.topics['/mix/slow'].latched
        assert reader.topics['/note'].latched
    offline(MIX, {}, tmp_path / 'out', tmp_path / 'back', {'imu/data_raw': 'absent'}, copy=['*'])
    with BagReader(tmp_path / 'back') as reader:
        assert reader.topics['/a/mixture'].count == 125
        assert reader.topics['/mixture'].count == 25


def test_rejected_messages_are_counted_with_their_reason(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', IMU)
        bag.write('/imu/data_raw', SECOND, imu(SECOND, (float('nan'), 0.0, 0.0)))
        bag.write('/imu/data_raw', SECOND, imu(0, (0.0, 0.0, 0.0)))
        bag.write('/imu/data_raw', SECOND, imu(SECOND, (1.0, 0.0, 0.0)))
    result = offline(MIX, {}, tmp_path / 'in', tmp_path / 'out')
    assert result.outputs['/mixture'] == 1
    assert dict(result.tally.sensors['imu/data_raw'].rejected) == {'rate not finite': 1, 'zero stamp': 1}


def test_nis_is_noted_once_a_second(tmp_path):
    write_sensors(tmp_path / 'in', seconds=5.0)
    health = offline(MIX, {}, tmp_path / 'in', tmp_path / 'out').health['imu/data_raw']
    assert np.diff(health.stamps) == pytest.approx(SECOND)
    assert health.nis == pytest.approx([3.0] * 4)
    assert health.gate == pytest.approx([16.3] * 4)


def test_wrong_types_and_missing_inputs_are_named_and_nothing_is_left(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', 'std_msgs/msg/String')
    with pytest.raises(BagError, match=rf"'/imu/data_raw' is std_msgs/msg/String, mix expects {IMU}"):
        offline(MIX, {}, tmp_path / 'in', tmp_path / 'out')
    with pytest.raises(BagError, match=r'none of the inputs of mix .*it has: /imu/data_raw'):
        offline(MIX, {}, tmp_path / 'in', tmp_path / 'out', {'imu/data_raw': 'x', 'imu/mag': 'y'})
    assert [p.name for p in tmp_path.iterdir()] == ['in']


def test_a_damaged_message_leaves_no_output(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', IMU)
        bag.write('/imu/data_raw', SECOND, imu(SECOND, (0.0, 0.0, 0.0)))
        bag.write_raw('/imu/data_raw', SECOND, b'\x00\x01\x00\x00\x05')
    with pytest.raises(BagError, match="message 2 of '/imu/data_raw' is damaged"):
        offline(MIX, {}, tmp_path / 'in', tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def test_an_output_cannot_be_copied(tmp_path):
    write_sensors(tmp_path / 'in', seconds=0.1)
    with pytest.raises(BagError, match="'/note' cannot be copied"):
        offline(MIX, {}, tmp_path / 'in', tmp_path / 'out', {'slow': 'note'}, copy=['note'])


def test_command_line_takes_ros_arguments(tmp_path, package, capsys):
    write_sensors(tmp_path / 'in', seconds=1.0)
    (tmp_path / 'p.yaml').write_text(
        '/**: {ros__parameters: {leak: 0.1}}\nmix: {ros__parameters: {leak: 1}}\n'
    )
    base = [package, 'mix', str(tmp_path / 'in')]
    ros = ['--ros-args', '--params-file', str(tmp_path / 'p.yaml'), '-r', 'mixture:=m']
    assert tool.main([*base, str(tmp_path / 'a'), *ros]) == 0
    assert '125 out  /m' in capsys.readouterr().out
    _, values = vectors(tmp_path / 'a', '/m')
    offline(MIX, {'leak': 1.0}, tmp_path / 'in', tmp_path / 'b')
    assert values.tobytes() == vectors(tmp_path / 'b', '/mixture')[1].tobytes()


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['-p', 'leak:=-1'], "'leak' is -1, allowed: 0 … 1"),
        (['-p', 'leak:=fast'], "'leak' is 'fast', expected float"),
        (['-p', 'mux:leak:=0.5'], "'mux:leak' is for node 'mux', but 'mix' is run"),
        (['-p', 'leek:=1'], "unknown parameter 'leek'; known: leak"),
        (['-p', 'leak=1'], "parameter 'leak=1' is malformed; expected name:=value"),
        (['-x', '1'], "'-x' is not supported"),
        (['-p'], "'-p' lacks its value"),
        (['-r', '__ns:=/boat'], "'__ns:=/boat' is not supported offline"),
        (['--params-file', 'absent.yaml'], 'absent.yaml: cannot be read'),
        (
            ['-r', 'imu:=imu/data_raw'],
            "remap of 'imu': mix has no such topic; it has: /imu/data_raw, /imu/mag",
        ),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(tmp_path, package, capsys, arguments, words):
    write_sensors(tmp_path / 'in', seconds=0.1)
    call = [package, 'mix', str(tmp_path / 'in'), str(tmp_path / 'out'), '--ros-args', *arguments]
    assert tool.main(call) == 2
    err = capsys.readouterr().err
    assert err.startswith('offline: ')
    assert err.count('\n') == 1
    assert words in err
    assert not (tmp_path / 'out').exists()


def test_unknown_packages_and_estimators_name_what_there_is(package):
    with pytest.raises(BagError, match="no estimator 'mux'; it has: chain, mix"):
        find_ports(package, 'mux')
    with pytest.raises(BagError, match='has no module nowhere'):
        find_ports('nowhere', 'mix')
    with pytest.raises(BagError, match=r'declares no ESTIMATORS in json\.codec|has no module json\.codec'):
        find_ports('json', 'mix')
    with pytest.raises(BagError, match=r'has no module mixer\.importers'):
        find_importer(package, 'x')


def test_parameters_of_the_node_base_mean_nothing_offline():
    _, ros = split(['a', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'leak:=0.5', '--', 'b'])
    assert estimator_parameters(parse(ros), 'mix') == {'leak': 0.5}


def test_ros_flags_work_without_the_ros_args_marker():
    given = ['a', '-r', 'b:=c', '-p', 'd:=1']
    assert split(given, implied=True) == (['a'], given[1:])
    assert split(['bag', '--remap', 'b:=c']) == (['bag', '--remap', 'b:=c'], [])


def test_a_renamed_node_reads_its_own_section(tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text('mix: {ros__parameters: {leak: 0.1}}\nport: {ros__parameters: {leak: 0.9}}\n')
    arguments = parse(['-r', '__node:=port', '--params-file', str(path)])
    assert estimator_parameters(arguments, arguments.node) == {'leak': 0.9}
    assert arguments.remaps == {}


@pytest.mark.parametrize(
    ('section', 'read'),
    [('/**', 1), ('*', 1), ('/mix', 1), ('/**/mix', 1), ('/mix/**', 1),
     ('/*/mix', 0), ('/boat/mix', 0), ('/mixer', 0)],
)  # fmt: skip
def test_sections_of_parameter_files_are_matched_as_rcl_does(tmp_path, section, read):
    path = tmp_path / 'p.yaml'
    path.write_text(
        f"'{section}': {{ros__parameters: {{leak: 0.9}}}}\nboat: {{mix: {{ros__parameters: {{leak: 2}}}}}}\n"
    )
    assert len(file_parameters(path, 'mix')) == read
    path.write_text(f"'{section}': {{leak: 0.9}}\n")
    with pytest.raises(BagError, match=r"lacks 'ros__parameters:'"):
        file_parameters(path, 'mix')


def test_the_summary_names_inputs_that_the_bag_does_not_have(tmp_path, package, capsys):
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', IMU)
        for k in range(3):
            bag.write('/imu/data_raw', (1 + k) * SECOND, imu((1 + k) * SECOND, (0.0, 0.0, 0.0)))
    assert tool.main([package, 'mix', str(tmp_path / 'in'), str(tmp_path / 'out')]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ['3 in   /imu/data_raw', '0 in   /imu/mag (not in the bag)']
    assert 'mean NIS of imu/data_raw: 3' in lines


def test_remaps_apply_to_relative_private_and_absolute_names():
    remaps = {'imu': 'port/imu', '~/state': '/state'}
    assert remapped('/imu', remaps, 'mix') == '/port/imu'
    assert remapped('~/state', remaps, 'mix') == '/state'
    assert remapped('gps', remaps, 'mix') == '/gps'


def test_parameters_are_checked_in_code_too(tmp_path):
    with pytest.raises(ParameterError, match='allowed: 0 … 1'):
        offline(MIX, {'leak': 2.0}, tmp_path / 'in', tmp_path / 'out')


@pytest.mark.parametrize(
    ('text', 'value'),
    [('1e-3', 1e-3), ('1E5', 1e5), ('1.7e9', 1.7e9), ('.5', 0.5), ('-2.', -2.0), ('.inf', float('inf')),
     ('3', 3), ('true', True), ('1e', '1e'), ('[1e-3, 2]', [1e-3, 2]), ('text', 'text')],
)  # fmt: skip
def test_parameters_are_read_as_a_node_reads_them(text, value):
    read = parse(['-p', f'a:={text}']).parameters[0][1]
    assert (type(read), read) == (type(value), value)
