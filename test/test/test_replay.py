# SPDX-License-Identifier: Apache-2.0
"""Graph and offline runner say the same, to the last bit, however the bag is played."""

import os
from pathlib import Path

import numpy as np
import pytest
from workspace_harness.make_bags import PACKAGES
from workspace_harness.replay import Estimator, cut, differences, live, offline_all
from workspace_harness.systems import fixtures, recordings

from bag_tools.bag import BagReader, BagWriter
from bag_tools.content import compare

SECONDS = 3.0


def jobs(bags):
    return {job.bag.stem: job for job in fixtures(bags, list(PACKAGES))}


def names():
    from workspace_harness.make_bags import root

    return sorted(jobs(root() / 'bags'))


@pytest.mark.parametrize('name', names())
def test_lock_step_equals_offline_on_every_fixture(bags, tmp_path, name):
    job = jobs(bags)[name]
    bag = cut(job.bag, SECONDS, tmp_path / 'in.mcap')
    live(bag, job.estimators(), tmp_path / 'live.mcap')
    results = offline_all(bag, job.estimators(), tmp_path)
    assert all(sum(r.outputs.values()) > 0 for r in results.values())
    assert differences(tmp_path / 'live.mcap', tmp_path, job.estimators()) == []


def test_recordings_that_are_there_are_imported_and_replayed(tmp_path, monkeypatch):
    data = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')).resolve()
    monkeypatch.setenv('ESTIMATOR_DATA', str(tmp_path))
    assert recordings(list(PACKAGES), tmp_path / 'bags') == []
    names = ['ev/kingston_1800s', 'imu/broad_02.npz', 'ins/gnss_imu_walk_60s']
    there = [name for name in names if (data / name).exists()]
    if not there:
        pytest.skip(f'no recordings at {data} (set ESTIMATOR_DATA)')
    for name in there:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(data / name)
    found = recordings(list(PACKAGES), tmp_path / 'bags')
    assert sorted(job.bag.stem for job in found) == sorted(Path(name).stem for name in there)
    for job in found:
        with BagReader(job.bag) as reader:
            assert job.replay.truth in reader.topics
            assert {job.replay.where} <= {*reader.topics, None}


@pytest.mark.parametrize('rate', [1.0, 5.0])
def test_lock_step_does_not_depend_on_the_rate(bags, tmp_path, rate):
    bag = cut(bags / 'imu_hand_held.mcap', 4.0, tmp_path / 'in.mcap')
    estimators = [Estimator('imu_kalman', 'attitude_estimator', 'attitude', {'settled_output': True})]
    live(bag, estimators, tmp_path / 'live.mcap', rate=rate)
    offline_all(bag, estimators, tmp_path)
    assert differences(tmp_path / 'live.mcap', tmp_path, estimators) == []


def shuffled(bag, out, seed, largest_delay=0.3):
    """Rewrite `bag` with every message arriving up to `largest_delay` (s) late."""
    rng = np.random.default_rng(seed)
    with BagReader(bag) as reader:
        rows = list(reader.messages())
        arrival = np.array([stamp for _, stamp, _ in rows]) + rng.integers(
            0, int(largest_delay * 1e9), len(rows)
        )
        with BagWriter(out, overwrite=True) as writer:
            for topic in reader.topics.values():
                writer.add(topic.name, topic.type)
            for i in np.argsort(arrival, kind='stable'):
                topic, _, data = rows[i]
                writer.write_raw(topic, int(arrival[i]), data)
    return out


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', ['angle_estimator', 'attitude_estimator'])
def test_order_of_arrival_within_the_window_changes_no_settled_output(bags, tmp_path, name, seed):
    bag = cut(bags / 'imu_hand_held.mcap', 12.0, tmp_path / 'in.mcap')
    estimators = [Estimator('imu_kalman', name, 'filter', {'settled_output': True})]
    ordered = offline_all(bag, estimators, tmp_path / 'ordered')['filter']
    late = offline_all(shuffled(bag, tmp_path / 'late.mcap', seed), estimators, tmp_path / 'late')['filter']
    (result,) = compare(
        tmp_path / 'ordered' / 'filter.mcap', tmp_path / 'late' / 'filter.mcap', ['/filter/imu/data_settled']
    )
    assert result.count_a > 1000
    assert result.equal, result.difference
    np.testing.assert_array_equal(ordered.estimator.state, late.estimator.state)
