# SPDX-License-Identifier: Apache-2.0
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from bag_tools import bench
from bag_tools.bench import BenchError, Options, Row

BENCHMARK = """
from helper import VALUE
from bag_tools.bench import Row

def measure(options):
    yield Row('{package}', 'error', VALUE * (options.seeds or 3), 'deg', 2.0, reference={{'peer': 7.1234567}})
    yield Row('{package}', 'ratio', 30.0, '×', bar=20.0, better='higher', seeds=options.seeds)
    {more}
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with two packages whose benchmarks both import a module named `helper`, and one without."""
    (tmp_path / 'ws').touch()
    for package, value in (('alpha', 1.0), ('beta', 0.25), ('silent', None)):
        folder = tmp_path / 'ros2_ws' / 'src' / package
        (folder / 'bench').mkdir(parents=True)
        (folder / 'package.xml').touch()
        if value is not None:
            (folder / 'bench' / 'helper.py').write_text(f'VALUE = {value}\n')
            (folder / 'bench' / 'bench.py').write_text(BENCHMARK.format(package=package, more=''))
    monkeypatch.setenv('WS_ROOT', str(tmp_path))
    return tmp_path


def results(root):
    return json.loads((root / 'docs' / 'results' / 'bench.json').read_text())


@pytest.mark.parametrize(
    ('value', 'bar', 'better', 'passed'),
    [
        (1.0, 1.0, 'lower', True),
        (1.1, 1.0, 'lower', False),
        (1.0, 1.0, 'higher', True),
        (0.9, 1.0, 'higher', False),
        (5.0, None, 'lower', True),
        (math.nan, None, 'lower', False),
        (-math.inf, 1.0, 'lower', False),
    ],
)
def test_a_row_passes_exactly_when_its_bar_is_met_by_a_finite_value(value, bar, better, passed):
    assert Row('p', 'n', value, '', bar=bar, better=better).passed is passed


def test_every_record_has_the_documented_fields(project):
    assert bench.main([]) == 0
    first = results(project)[0]
    assert list(first) == [
        'package', 'name', 'value', 'unit', 'bar', 'better', 'pass', 'reference', 'seeds', 'seconds', 'date',
        'machine',
    ]  # fmt: skip
    assert first['package'] == 'alpha'
    assert first['value'] == 3.0
    assert first['pass'] is False
    assert first['reference'] == {'peer': 7.12346}
    assert first['date'].count('-') == 2


def test_helper_modules_of_one_package_do_not_leak_into_the_next(project):
    bench.main([])
    values = {(entry['package'], entry['name']): entry['value'] for entry in results(project)}
    assert values['alpha', 'error'] == 3.0
    assert values['beta', 'error'] == 0.75
    assert 'helper' not in sys.modules
    assert not any(str(project) in folder for folder in sys.path)


def test_the_machine_is_described_without_its_name(monkeypatch):
    monkeypatch.setattr('platform.node', lambda: pytest.fail('the host name was asked for'))
    assert 'Python' in bench.machine()


def test_seeds_reach_the_benchmark_and_rows_of_other_packages_stay(project):
    bench.main([])
    bench.main(['alpha', '--seeds', '1'])
    values = {(entry['package'], entry['name']): entry for entry in results(project)}
    assert values['alpha', 'error']['value'] == 1.0
    assert values['alpha', 'ratio']['seeds'] == 1
    assert values['beta', 'error']['value'] == 0.75
    assert len(results(project)) == 4


def test_a_quick_run_leaves_the_published_figures_alone(project):
    bench.main([])
    before = results(project)
    assert bench.main(['alpha', '--seeds', '1', '--quick']) == 0
    assert results(project) == before
    quick = json.loads((project / 'out' / 'bench_quick.json').read_text())
    assert quick[0]['value'] == 1.0


def test_missed_bars_fail_only_a_strict_run_and_stay_in_the_file(project):
    assert bench.main(['alpha']) == 0
    assert bench.main(['alpha', '--strict']) == 1
    assert bench.main(['beta', '--strict']) == 0
    assert [entry['pass'] for entry in results(project) if entry['package'] == 'alpha'] == [False, True]


def test_a_package_without_benchmark_is_named(project, capsys):
    assert bench.main(['silent', 'beta']) == 0
    captured = capsys.readouterr()
    assert 'silent has no bench/bench.py' in captured.err
    assert 'ratio' in captured.out


def test_an_unknown_package_is_a_usage_error_that_lists_the_known_ones(project, capsys):
    assert bench.main(['gamma']) == 2
    assert "unknown package 'gamma'; known: alpha, beta, silent" in capsys.readouterr().err


@pytest.mark.parametrize('seeds', ['0', '-3'])
def test_a_count_of_seeds_below_one_is_a_usage_error(project, capsys, seeds):
    assert bench.main(['alpha', f'--seeds={seeds}']) == 2
    assert 'expected 1 or more' in capsys.readouterr().err


def test_a_benchmark_that_breaks_keeps_its_rows_and_does_not_stop_the_others(project, capsys):
    path = project / 'ros2_ws' / 'src' / 'alpha' / 'bench' / 'bench.py'
    path.write_text(BENCHMARK.format(package='alpha', more="raise RuntimeError('peer is gone')"))
    assert bench.main(['alpha', 'beta']) == 1
    assert [entry['package'] for entry in results(project)] == ['alpha', 'alpha', 'beta', 'beta']
    captured = capsys.readouterr()
    assert 'peer is gone' in captured.err
    assert 'alpha: the benchmark stopped after 2 rows' in captured.err


def test_an_interrupted_run_keeps_the_rows_measured_so_far(project):
    path = project / 'ros2_ws' / 'src' / 'alpha' / 'bench' / 'bench.py'
    path.write_text(BENCHMARK.format(package='alpha', more='raise KeyboardInterrupt'))
    assert bench.main(['alpha', 'beta']) == 130
    assert len(results(project)) == 2


def test_values_that_are_not_finite_are_stored_as_null(project):
    path = project / 'ros2_ws' / 'src' / 'beta' / 'bench' / 'bench.py'
    path.write_text(BENCHMARK.format(package='beta', more="yield Row('beta', 'lost', float('nan'), 'm')"))
    bench.main(['beta'])
    lost = results(project)[-1]
    assert lost['value'] is None
    assert lost['pass'] is False


def test_pruning_drops_rows_that_are_measured_no_more_but_only_of_packages_that_ran_through(project):
    path = project / 'ros2_ws' / 'src' / 'alpha' / 'bench' / 'bench.py'
    path.write_text(BENCHMARK.format(package='alpha', more="yield Row('alpha', 'old', 1.0, 'm')"))
    bench.main([])
    path.write_text(BENCHMARK.format(package='alpha', more='raise ValueError'))
    bench.main(['alpha', '--prune'])
    assert 'old' in [entry['name'] for entry in results(project)]
    path.write_text(BENCHMARK.format(package='alpha', more=''))
    bench.main(['alpha'])
    assert 'old' in [entry['name'] for entry in results(project)]
    bench.main(['alpha', '--prune'])
    assert [entry['name'] for entry in results(project)] == ['error', 'ratio', 'error', 'ratio']


def test_a_damaged_results_file_is_found_before_anything_is_measured(project, capsys):
    path = project / 'docs' / 'results' / 'bench.json'
    path.parent.mkdir(parents=True)
    path.write_text('[{"package": "alpha"')
    assert bench.main(['alpha']) == 2
    captured = capsys.readouterr()
    assert 'not a list of benchmark records' in captured.err
    assert 'error' not in captured.out
    assert path.read_text() == '[{"package": "alpha"'


def test_rows_are_printed_aligned_with_bar_and_peers():
    good = bench.line(Row('p', 'roll', 0.5, 'deg', bar=1.0, reference={'vqf': 7.7}), 2.0)
    bad = bench.line(Row('p', 'speed ratio', 12.0, '×', bar=20.0, better='higher'), 12.0)
    plain = bench.line(Row('p', 'count', 3.0, ''), 0.0)
    assert '≤ 1  met ' in good
    assert good.endswith('vqf 7.7')
    assert '≥ 20  MISSED' in bad
    assert 'met' not in plain
    assert good.index('0.5') + 3 == bad.index('12') + 2


def test_the_project_root_is_found_from_a_folder_within(project, monkeypatch):
    monkeypatch.delenv('WS_ROOT')
    inside = project / 'ros2_ws' / 'src' / 'alpha'
    assert bench.project_root(inside) == project.resolve()
    with pytest.raises(BenchError, match='set WS_ROOT'):
        bench.project_root(Path('/'))


def test_the_module_runs_as_a_command(project):
    done = subprocess.run(
        [sys.executable, '-m', 'bag_tools.bench', 'beta', '--strict'],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert '2 figures, 0 below their bar; stored in docs/results/bench.json' in done.stdout


def test_options_default_to_the_full_run():
    assert Options() == Options(seeds=None, quick=False)
