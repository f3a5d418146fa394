# SPDX-License-Identifier: Apache-2.0
"""What the comparison of systems says of the paper's claims, on short runs."""

from dataclasses import replace

import numpy as np
import pytest

from ins_gps.evaluation import ablation, evaluate, filter_params, paper_scenario
from ins_gps.simulation import DGPS, NOISELESS, STANDALONE, Scenario
from ins_gps.simulation_gnss import simulate


@pytest.fixture(scope='module')
def table():
    """The mean of the ablation over four seeds, 40 s each."""
    runs = [ablation(seed, 40.0) for seed in range(1000, 1004)]
    return {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}


def test_the_ablation_has_every_combination_once(table):
    assert len(table) == 4 * 2 * 3
    assert all(np.isfinite(error) and error > 0.0 for error in table.values())


@pytest.mark.parametrize('mode', ['tight_code', 'tight_doppler', 'tight_tdcp'])
def test_corrections_of_a_base_help_every_filter_and_sa_hurts(table, mode):
    for states in ('published', 'full'):
        assert table[False, True, mode, states] < table[False, False, mode, states]
        assert table[True, False, mode, states] > table[False, False, mode, states]
        # The base sees the same dither.
        assert table[True, True, mode, states] == table[False, True, mode, states]


def test_an_exact_start_is_exact_and_without_gates_nothing_is_refused():
    scenario = Scenario(
        trajectory='s_turns', duration=20.0, imu_rate=20.0, budget=replace(NOISELESS, receiver=0.01)
    )
    params = filter_params(replace(DGPS, white=True))
    result = evaluate(simulate(scenario, 1), params, 1, exact=True, gates=False)
    assert result.position[0] < 0.05
    assert not any(sum(s.rejected.values()) for s in result.navigation.tally.sensors.values())
    assert result.within(3.0) == 1.0
    assert result.nees(slice(0, 3)).shape == result.times.shape == result.velocity.shape
    assert result.after(10.0).sum() == (result.times >= 10.0).sum()


def test_the_papers_scene_shows_the_satellites_of_its_table():
    run = simulate(paper_scenario(duration=2.0, budget=STANDALONE), 1)
    assert all(len(epoch.rows) == 5 for epoch in run.epochs), 'satellite 4 is below the horizon'
