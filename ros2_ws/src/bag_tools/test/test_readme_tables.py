# SPDX-License-Identifier: Apache-2.0
import json
import sys
import textwrap
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from bag_tools import readme_tables
from bag_tools.headline import headlines
from bag_tools.readme_tables import TableError, bench_table, fill, ports_table
from kalman_core.parameters import build, parameter
from node_core.ports import Input, Output, Ports


@dataclass(frozen=True)
class ToyParams:
    """Noise of the toy."""

    noise: float = parameter(0.5, 'white noise', unit='m', minimum=0.0)
    label: str = parameter('a', 'which one', choices=('a', 'b'))


class Estimate(NamedTuple):
    """Position of the toy: what it says. More words."""

    stamp: int


@dataclass
class Bare:
    stamp: int


PORTS = Ports(
    name='toy',
    params=ToyParams,
    estimator=lambda params: params,
    inputs=(
        Input('toy/raw', 'std_msgs/msg/Float64', lambda m: m, 'on_raw', timeout=0.5),
        Input('toy/aid', 'std_msgs/msg/Float64', lambda m: m, 'on_aid'),
    ),
    outputs={
        Estimate: Output('toy/out', 'std_msgs/msg/Float64', lambda e, m: None),
        Bare: Output('toy/bare', 'std_msgs/msg/String', lambda e, m: None, latched=True),
    },
)
ESTIMATORS = {'toy_key': PORTS}

RECORDS = [
    {'package': 'toy', 'name': 'error|max', 'value': 0.123456, 'unit': 'm', 'bar': 0.2, 'better': 'lower',
     'pass': True, 'reference': {'peer': 3.0, 'gone': None}},
    {'package': 'toy', 'name': 'ratio', 'value': 12.0, 'unit': '', 'bar': 20.0, 'better': 'higher',
     'pass': False, 'reference': {}},
    {'package': 'toy', 'name': 'lost', 'value': None, 'unit': 'm', 'bar': None, 'better': 'lower',
     'pass': False, 'reference': {}},
    {'package': 'other', 'name': 'count', 'value': 7.0, 'unit': '', 'bar': None, 'better': 'lower',
     'pass': True, 'reference': {}},
]  # fmt: skip


def test_topics_are_listed_with_direction_type_and_remark():
    rows = ports_table(PORTS).splitlines()
    assert rows[2] == '| `toy/raw` | in | `std_msgs/msg/Float64` | stale after 0.5 s |'
    assert rows[3] == '| `toy/aid` | in | `std_msgs/msg/Float64` | may be absent |'
    assert rows[4] == '| `toy/out` | out | `std_msgs/msg/Float64` | Position of the toy |'
    assert rows[5] == '| `toy/bare` | out | `std_msgs/msg/String` | (latched) |'


def test_figures_are_listed_with_bar_verdict_and_peers():
    rows = bench_table(RECORDS, 'toy').splitlines()
    assert rows[2] == '| error\\|max | 0.1235 m | ≤ 0.2 m | yes | peer 3, gone no result |'
    assert rows[3] == '| ratio | 12 | ≥ 20 | **no** | – |'
    assert rows[4] == '| lost | no result m | – | **no** | – |'
    assert bench_table(RECORDS, 'other').splitlines()[2] == '| count | 7 | – | – | – |'
    assert bench_table(RECORDS, 'none') == 'Not measured yet: `./ws bench none`.'


def test_blocks_are_filled_and_everything_else_is_left_alone():
    text = textwrap.dedent(f"""\
        # Title
        <!-- params:{__name__}:ToyParams -->
        stale
        <!-- end -->
        between `<!-- bench:toy -->` words
        <!-- ports:{__name__}:PORTS -->
        <!-- end -->
        <!-- ports:{__name__}:toy_key -->
        <!-- end -->
        <!-- bench:other -->
        <!-- end -->
        last line
        """)
    filled = fill(text, RECORDS)
    assert 'stale\n' not in filled
    assert '| `noise` | `0.5` | m | >= 0 m | restart | white noise |' in filled
    assert filled.count('| `toy/raw` | in |') == 2
    assert '| count | 7 |' in filled
    assert 'between `<!-- bench:toy -->` words\n' in filled
    assert filled.startswith('# Title\n')
    assert filled.endswith('last line\n')
    assert fill(filled, RECORDS) == filled


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('<!-- params:no_such_module:X -->\n<!-- end -->', 'no_such_module cannot be imported'),
        (f'<!-- params:{__name__}:Missing -->\n<!-- end -->', 'has no class Missing'),
        (f'<!-- ports:{__name__}:ToyParams -->\n<!-- end -->', 'has no Ports named ToyParams'),
        ('<!-- bench:toy -->\nand no end', 'not closed'),
        ('<!-- bench:toy -->\n<!-- bench:other -->\n<!-- end -->', 'bench:toy --> is not closed'),
    ],
)
def test_a_block_that_cannot_be_filled_is_named(text, complaint):
    with pytest.raises(TableError, match=complaint):
        fill(text, RECORDS)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with one package `toykit` whose codec declares the estimator above."""
    (tmp_path / 'ws').touch()
    package = tmp_path / 'ros2_ws' / 'src' / 'toykit'
    (package / 'toykit').mkdir(parents=True)
    (package / 'package.xml').touch()
    (package / 'toykit' / '__init__.py').touch()
    (package / 'toykit' / 'codec.py').write_text(f'from {__name__} import ESTIMATORS\n')
    (package / 'README.md').write_text('<!-- bench:toy -->\n<!-- end -->\n')
    (tmp_path / 'docs' / 'results').mkdir(parents=True)
    (tmp_path / 'docs' / 'results' / 'bench.json').write_text(json.dumps(RECORDS))
    (tmp_path / 'docs' / 'interfaces.md').write_text('<!-- ports:toykit.codec:toy_key -->\n<!-- end -->\n')
    monkeypatch.setenv('WS_ROOT', str(tmp_path))
    monkeypatch.syspath_prepend(str(package))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    yield tmp_path
    for name in ('toykit', 'toykit.codec'):
        sys.modules.pop(name, None)


def test_check_names_what_drifts_and_writes_nothing(project, capsys):
    readme = project / 'ros2_ws' / 'src' / 'toykit' / 'README.md'
    before = readme.read_text()
    assert readme_tables.main(['--check']) == 1
    assert capsys.readouterr().out.splitlines() == [
        'drifts: docs/interfaces.md',
        'drifts: ros2_ws/src/toykit/README.md',
        'drifts: ros2_ws/src/toykit/config/toy.yaml',
    ]
    assert readme.read_text() == before


def test_what_is_written_is_current(project):
    assert readme_tables.main([]) == 0
    assert readme_tables.main(['--check']) == 0
    assert '| ratio | 12 |' in (project / 'ros2_ws' / 'src' / 'toykit' / 'README.md').read_text()
    assert '`toy/raw`' in (project / 'docs' / 'interfaces.md').read_text()


def test_the_written_configuration_is_read_back_as_the_defaults(project):
    readme_tables.main([])
    config = project / 'ros2_ws' / 'src' / 'toykit' / 'config' / 'toy.yaml'
    values = yaml.safe_load(config.read_text())['toy']['ros__parameters']
    assert build(ToyParams, values) == ToyParams()


def test_nodes_that_are_no_estimators_get_a_configuration_by_their_own_table(project):
    codec = project / 'ros2_ws' / 'src' / 'toykit' / 'toykit' / 'codec.py'
    codec.write_text(
        f"from {__name__} import ESTIMATORS, ToyParams\nNODE_PARAMETERS = {{'driver': ToyParams}}\n"
    )
    readme_tables.main([])
    config = codec.parents[1] / 'config'
    assert sorted(path.name for path in config.iterdir()) == ['driver.yaml', 'toy.yaml']
    assert list(yaml.safe_load((config / 'driver.yaml').read_text())) == ['driver']


def test_an_error_names_the_document(project, capsys):
    (project / 'README.md').write_text('<!-- params:gone:X -->\n<!-- end -->\n')
    assert readme_tables.main([]) == 2
    assert 'docs: README.md: <!-- params:gone:X -->' in capsys.readouterr().err


def test_a_damaged_results_file_is_named(project, capsys):
    (project / 'docs' / 'results' / 'bench.json').write_text('{}[')
    assert readme_tables.main(['--check']) == 2
    assert 'bench.json' in capsys.readouterr().err


def source_tree():
    for folder in Path(__file__).resolve().parents:
        if (folder / 'ws').is_file():
            return folder
    return None


@pytest.mark.skipif(source_tree() is None, reason='not run from the source tree: there are no documents')
def test_a_headline_shows_only_the_chosen_figures_and_names_a_missing_one():
    records = [
        {
            'package': 'p',
            'name': n,
            'value': v,
            'unit': 'm',
            'bar': 2.0,
            'pass': v <= 2,
            'reference': {'peer': 9.0},
            'better': 'lower',
        }
        for n, v in (('a', 1.0), ('b', 3.0))
    ]
    wish = {'system': 'S', 'package': 'p', 'name': 'b'}
    table = readme_tables.headline_table(records, [wish])
    assert table.splitlines()[2:] == ['| S | b | – | – | 3 m | ≤ 2 m **missed** |']
    for wrong in ({'name': 'c'}, {'paper': 'c'}, {'peers': ['c']}, {'paper': {'row': 'c'}}):
        with pytest.raises(readme_tables.TableError, match="'c'"):
            readme_tables.headline_table(records, [wish | wrong])


def test_a_headline_sets_the_paper_and_the_best_of_the_peers_beside_it():
    reference = {'printed': 0.8, 'A': 0.5, 'B': 0.4, 'C': None}
    row = {'package': 'p', 'name': 'a', 'value': 0.1, 'unit': 'm', 'bar': None, 'pass': True}
    wish = {'system': 'S', 'package': 'p', 'name': 'a', 'paper': 'printed', 'peers': ['A', 'B', 'C']}
    for better, best in (('lower', 'B 0.4 m'), ('higher', 'A 0.5 m')):
        (line,) = headlines([row | {'reference': reference, 'better': better}], [wish])
        assert (line.paper, line.peer, line.here, line.met) == ('0.8 m', best, '0.1 m', None)
    (line,) = headlines(
        [row | {'reference': {}, 'better': 'lower'}], [wish | {'paper': {'printed': '2 to 3 s'}, 'peers': []}]
    )
    assert line.paper == '2 to 3 s'
    assert headlines([], [wish], partial=True) == []


def test_the_documents_of_this_workspace_are_current():
    root = source_tree()
    assert [str(path.relative_to(root)) for path, _ in readme_tables.drifted(root)] == [], 'run ./ws docs'


@pytest.mark.skipif(source_tree() is None, reason='not run from the source tree: there are no packages')
def test_the_defaults_of_every_node_lie_within_their_own_bounds():
    for path in sorted((source_tree() / 'ros2_ws' / 'src').glob('*/*/codec.py')):
        for node, params in readme_tables.node_parameters(path.parent.name).items():
            defaults = {field.name: field.default for field in fields(params)}
            assert build(params, defaults) == params(), node
