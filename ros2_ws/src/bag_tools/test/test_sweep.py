# SPDX-License-Identifier: Apache-2.0
"""A sweep is a table of pure results: the same on workers as one by one, after a kill as without."""

import math
import re

import numpy as np
import pytest
from bag_samples import write_sensors
from swept.simulations import MARKER

from bag_tools import sweep
from bag_tools.bag import BagError
from bag_tools.sweep_plan import (
    Range,
    Scoring,
    Source,
    Task,
    choices,
    find_bags,
    parse_grid,
    parse_range,
    parse_seeds,
    plan,
)
from bag_tools.sweep_run import complete, on_dask, serial
from bag_tools.sweep_store import Store
from bag_tools.sweep_task import objective, run_task
from bag_tools.sweep_tune import tune

SCORING = Scoring('mixture', 'aux')


def tasks_of(simulation, seeds, leaks=(0.1, 0.9)):
    sources = [Source(simulation=f'swept.simulations:{simulation}', seed=s) for s in seeds]
    return plan('swept', 'mix', sources, choices({'leak': list(leaks)}), SCORING, {})


def table_of(folder):
    from pyarrow import parquet

    return parquet.read_table(folder / 'results.parquet')


def test_the_plan_is_every_combination():
    sets = choices({'a': [1, 2], 'b': ['x']}, [Range('c', 1.0, 100.0, True)], samples=3, seed=4)
    assert len(sets) == 6
    assert sets[:3] == [{**s, 'a': 1} for s in sets[:3]]
    assert [s['c'] for s in sets] == [s['c'] for s in sets[:3]] * 2
    assert all(1.0 <= s['c'] <= 100.0 for s in sets)
    assert parse_grid(['a=1,2.5', 'b=x,true']) == {'a': [1, 2.5], 'b': ['x', True]}
    assert parse_range('q=0.1:10:log').at(0.5) == pytest.approx(1.0)
    assert parse_seeds('3:6') == [3, 4, 5]
    assert parse_seeds('7,1') == [7, 1]


@pytest.mark.parametrize('text', ['q', 'q=1', 'q=2:1', 'q=-1:1:log', 'q=0:inf', 'q=a:b', 'q=1:2:cubic'])
def test_a_malformed_range_is_named(text):
    with pytest.raises(BagError, match='q'):
        parse_range(text)


def test_an_archive_is_searched_for_bags_and_not_for_unfinished_ones(tmp_path):
    write_sensors(tmp_path / 'day' / 'one.mcap')
    write_sensors(tmp_path / 'two')
    (tmp_path / '.three.partial').mkdir()
    (tmp_path / '.three.partial' / 'three.mcap').touch()
    found = find_bags([str(tmp_path), str(tmp_path / 'two')])
    assert [s.bag.removeprefix(str(tmp_path)) for s in found] == ['/day/one.mcap', '/two']
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match='holds no bag'):
        find_bags([str(tmp_path / 'empty')])


def test_the_key_of_a_run_is_all_that_decides_it():
    base = tasks_of('sensors', [0])[0]
    others = [
        tasks_of('sensors', [1])[0],
        tasks_of('sensors', [0], (0.2,))[0],
        tasks_of('deadly', [0])[0],
        Task('swept', 'chain', base.source, base.scoring, base.params),
        Task('swept', 'mix', base.source, Scoring('mixture', 'aux', after=1.0), base.params),
        Task('swept', 'mix', base.source, Scoring('mixture', 'aux', solve=('lag',)), base.params),
    ]
    assert len({base.key, *(t.key for t in others)}) == 7
    assert tasks_of('sensors', [0])[0].key == base.key


def test_a_run_that_cannot_work_is_a_row_with_the_reason(tmp_path):
    row = run_task(tasks_of('sensors', [0], (7.0,))[0])
    assert 'leak' in row['error']
    assert objective(row, 'rmse', 'norm', {}) == math.inf
    base = tasks_of('sensors', [0])[0]
    turned = Task('swept', 'mix', base.source, Scoring('mixture', 'aux', solve=('mounting',)), base.params)
    assert "'/mixture' has no orientation" in run_task(turned)['error']


def test_workers_give_what_one_run_after_the_other_gives_though_one_is_killed(tmp_path, monkeypatch):
    monkeypatch.setenv(MARKER, str(tmp_path / 'killed'))
    tasks = tasks_of('deadly', range(6))
    store = Store(tmp_path / 'dask')
    with on_dask(workers=2) as (run, _):
        rows = complete(tasks, store, run)
    assert (tmp_path / 'killed').exists()
    assert rows == complete(tasks, Store(tmp_path / 'serial'), serial)
    assert not [row['error'] for row in rows if row['error']]
    store.write_table(tasks)
    Store(tmp_path / 'serial').write_table(tasks)
    assert table_of(tmp_path / 'dask').equals(table_of(tmp_path / 'serial'))


def test_a_sweep_that_was_stopped_goes_on_where_it_was(tmp_path):
    tasks = tasks_of('sensors', range(5))

    def stopped(missing):
        for number, row in enumerate(serial(missing)):
            if number == 4:
                raise KeyboardInterrupt
            yield row

    with pytest.raises(KeyboardInterrupt):
        complete(tasks, Store(tmp_path), stopped)
    # What a kill in the middle of writing leaves.
    (tmp_path / 'rows' / f'{tasks[4].key}.tmp').write_text('{"key"')
    ran = []

    def counted(missing):
        ran.extend(missing)
        return serial(missing)

    rows = complete(tasks, Store(tmp_path), counted)
    assert [t.key for t in ran] == [t.key for t in tasks[4:]]
    assert [row['key'] for row in rows] == [t.key for t in tasks]


def test_tuning_finds_the_minimum_of_a_known_function():
    ranges = [Range('x', -2.0, 3.0), Range('y', 0.01, 100.0, True)]

    def evaluate(sets):
        return [
            (s.get('x', 2.0) - 0.5) ** 2 + np.log(s.get('y', 50.0)) ** 2 if s.get('x', 0.0) < 2.9 else np.inf
            for s in sets
        ]

    tuned = tune(ranges, evaluate, 400)
    assert tuned.params['x'] == pytest.approx(0.5, abs=0.1)
    assert tuned.params['y'] == pytest.approx(1.0, abs=0.1)
    assert tuned.value < 0.05 < tuned.before
    assert tuned.evaluations <= 400


def test_nis_objective_is_zero_for_an_honest_filter():
    row = {'error': '', 'nis.a': 3.0, 'nis.b': 2.0 * math.e}
    assert objective(row, 'nis', '', {'a': 3}) == 0.0
    assert objective(row, 'nis', '', {'a': 3, 'b': 2}) == pytest.approx(math.sqrt(0.5))
    with pytest.raises(BagError, match='reports: a, b'):
        objective(row, 'nis', '', {'c': 1})


def test_the_command_ranks_and_resumes(tmp_path, capsys):
    write_sensors(tmp_path / 'in.mcap', seconds=0.5)
    command = ['swept', 'mix', str(tmp_path / 'out'), '--bags', str(tmp_path / 'in.mcap'), '--serial']
    command += ['--estimate', 'mixture', '--truth', 'aux', '--grid', 'leak=0.9,0.05', '--objective', 'rmse']
    assert sweep.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].endswith('leak=0.05')
    assert lines[-1].startswith('2 runs, 0 failed')
    table = table_of(tmp_path / 'out')
    assert table['param.leak'].to_pylist() == [0.9, 0.05]
    assert table['accepted.imu/data_raw'].to_pylist() == [50, 50]
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / 'out' / 'rows').iterdir()}
    assert sweep.main(command) == 0
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / 'out' / 'rows').iterdir()} == before


def test_the_command_tunes(tmp_path, capsys):
    command = ['swept', 'mix', str(tmp_path / 'out'), '--simulate', 'swept.simulations:sensors']
    command += ['--seeds', '0:2', '--serial', '--estimate', 'mixture', '--truth', 'aux']
    command += ['--objective', 'rmse', '--optimise', 'leak=0.01:1', '--evaluations', '18']
    assert sweep.main(command) == 0
    said = capsys.readouterr().out
    before, after = re.search(r'rmse: (\S+) as given, (\S+) tuned', said).groups()
    assert float(after) < float(before)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (['--grid', 'laek=1'], "unknown parameter 'laek'"),
        (['--objective', 'rmse'], '--truth'),
        (['--objective', 'nis'], '--dof'),
        (['--optimise', 'leak=0:1'], '--objective'),
        (['--seeds', 'x'], "seeds 'x'"),
        (['--ros-args', '-p', 'leak:=7'], "'leak'"),
    ],
)
def test_wrong_usage_is_one_line_and_code_2(tmp_path, capsys, options, words):
    command = ['swept', 'mix', str(tmp_path / 'out'), '--simulate', 'swept.simulations:sensors', '--serial']
    assert sweep.main([*command, *options]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / 'out').exists()
