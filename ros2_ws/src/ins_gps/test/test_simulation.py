# SPDX-License-Identifier: Apache-2.0
"""The simulator against what its scenarios promise, without the filter."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ins_gps.constants import GPS_EPOCH_UNIX, SPEED_OF_LIGHT, WAVELENGTH_L1
from ins_gps.orbit import COLUMN
from ins_gps.params import SimulatorParams
from ins_gps.samples import OBS
from ins_gps.scenarios import restamped, scenario_of, truth_estimate
from ins_gps.simulation import DGPS, NOISELESS, STANDALONE, Fault, Outage, Scenario, make_truth
from ins_gps.simulation_gnss import constellation, range_errors, selective_availability, simulate
from ins_gps.solution import error_of
from ins_gps.strapdown import mechanise_series

BRIEF = Scenario(duration=5.0, imu_rate=20.0)


@pytest.mark.parametrize('name', ['constant', 's_turns', 'flight', 'literal'])
def test_the_imu_of_a_trajectory_leads_along_it(name):
    truth, rate, force = make_truth(name, BRIEF.origin, 5.0, 100.0)
    ours = mechanise_series(truth[0].copy(), rate, force, 0.01)
    error = error_of(ours[-1], truth[-1])
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.linalg.norm(error[6:]) < 1e-4


def test_what_is_not_known_is_named():
    with pytest.raises(ValueError, match="unknown trajectory 'loop'; known: constant"):
        make_truth('loop', BRIEF.origin, 1.0, 10.0)
    with pytest.raises(ValueError, match="unknown fault 'fade'; known: jump"):
        simulate(replace(BRIEF, faults=(Fault('fade', 1, 0.0, 1.0),)))


@pytest.mark.parametrize('budget', [DGPS, STANDALONE, replace(STANDALONE, selective_availability=100.0)])
def test_range_errors_have_the_spread_of_their_budget(budget):
    rng = np.random.default_rng(1)
    white = range_errors(budget, 200, 100, 1.0, rng)
    assert white.std() == pytest.approx(budget.total, rel=0.03)
    lasting = range_errors(replace(budget, white=False, selective_availability=0.0), 200, 400, 1.0, rng)
    expected = replace(budget, selective_availability=0.0)
    assert lasting.std() == pytest.approx(expected.total, rel=0.06)
    # What lasts is the same at the end of the run as at its start.
    assert lasting.mean(axis=0).std() == pytest.approx(math.hypot(expected.slow, 0.4), rel=0.15)


def test_selective_availability_is_the_satellites_clock():
    sa = replace(NOISELESS, selective_availability=100.0, white=False)
    dither = selective_availability(sa, 50, 400, 1.0, np.random.default_rng(2))
    assert dither.std() == pytest.approx(100.0 / math.sqrt(3.0), rel=0.1)
    assert np.diff(dither, axis=0).std() < 2.0  # it moves over minutes
    assert not selective_availability(NOISELESS, 3, 2, 1.0, np.random.default_rng(2)).any()
    run = simulate(replace(BRIEF, budget=sa), 3)
    for before, now in zip(run.epochs, run.epochs[1:]):
        code = now.rows[:, OBS['pseudorange']] - before.rows[:, OBS['pseudorange']]
        phase = now.rows[:, OBS['carrier_phase']] - before.rows[:, OBS['carrier_phase']]
        np.testing.assert_allclose(phase * WAVELENGTH_L1, code, atol=1e-4)


def test_faults_and_outages_come_when_they_should():
    faults = (Fault('jump', 1, 2.0, 50.0, 4.0), Fault('ramp', 2, 2.0, 10.0), Fault('slip', 3, 3.0, 7.0))
    clean = simulate(replace(BRIEF, budget=NOISELESS), 1)
    hurt = simulate(replace(BRIEF, budget=NOISELESS, faults=faults), 1)
    code = [h.rows[:, 3] - c.rows[:, 3] for h, c in zip(hurt.epochs, clean.epochs)]
    phase = [h.rows[:, 4] - c.rows[:, 4] for h, c in zip(hurt.epochs, clean.epochs)]
    assert [round(c[0]) for c in code] == [0, 0, 50, 50, 0, 0]
    assert [round(c[1]) for c in code] == [0, 0, 0, 10, 20, 30]
    assert [round(p[2]) for p in phase] == [0, 0, 0, 7, 7, 7]
    few = simulate(replace(BRIEF, outages=(Outage(2.0, 4.0, 2),)), 1)
    assert [len(e.rows) for e in few.epochs] == [6, 6, 2, 2, 6, 6]
    # Those that were away are locked on anew, the two others go on.
    assert sorted(few.epochs[4].rows[:, OBS['lock_time']].tolist()) == [1.0, 1.0, 1.0, 1.0, 5.0, 5.0]


def test_satellites_of_a_navigation_file_serve_at_any_time(recordings, tmp_path):
    path = recordings / 'spirent_iono_none' / 'RINEX_GN_Spirent.23N'
    for start in (BRIEF.start, BRIEF.start + 400 * 86_400 * 10**9):
        scenario = replace(BRIEF, satellites=str(path), start=start, mask=math.radians(5.0))
        rows = constellation(scenario)
        assert len(np.unique(rows[:, :2], axis=0)) == len(rows) > 8
        time = start / 1e9 - GPS_EPOCH_UNIX
        assert np.median(rows[:, COLUMN['toe']]) == pytest.approx(time)
        radius = [np.linalg.norm(r[9:12]) for r in simulate(scenario, 0).epochs[0].rows]
        assert all(2.5e7 < r < 2.8e7 for r in radius)
    empty = tmp_path / 'none.nav'
    empty.write_text(
        '     2.01           GLONASS NAV DATA                        RINEX VERSION / TYPE\n'
        f'{"":60}END OF HEADER\n'
        ' 3 98  2 15  0 15  0.0 0.163525342941D-03 0.363797880709D-11 0.108000000000D+05\n'
        '    0.106275903320D+05-0.348924636841D+00 0.931322574615D-09 0.000000000000D+00\n'
        '   -0.944422070313D+04 0.288163375854D+01 0.931322574615D-09 0.210000000000D+02\n'
        '    0.212257280273D+05 0.144599342346D+01-0.186264514923D-08 0.300000000000D+01\n'
    )
    with pytest.raises(ValueError, match='no ephemeris of GPS or Galileo'):
        constellation(replace(BRIEF, satellites=str(empty)))


def test_parameters_describe_a_scenario():
    params = SimulatorParams(
        outage_start=10.0, outage_end=20.0, outage_left=3, imu='mems', budget='standalone'
    )
    scenario = scenario_of(params, 1_700_000_000 * 10**9)
    assert scenario.start == 1_700_000_000 * 10**9
    assert scenario.outages == (Outage(10.0, 20.0, 3),)
    assert scenario.budget.slow == STANDALONE.slow
    assert not scenario_of(SimulatorParams(), 1).outages
    paper = scenario_of(SimulatorParams(satellites='paper'), 1)
    assert paper.start != 1, 'its orbits belong to one second of the week'
    assert len(simulate(replace(paper, duration=1.0), 0).epochs[0].rows) >= 4


def test_a_run_that_took_time_to_make_is_stamped_from_when_it_starts():
    run = simulate(BRIEF, 1)
    later = restamped(run, int(run.stamps[0]) + 7_000_000_001)
    assert set(later.stamps - run.stamps) == {7_000_000_001}
    assert {b.stamp - a.stamp for a, b in zip(run.epochs, later.epochs)} == {7_000_000_001}
    assert later.epochs[1].rows is run.epochs[1].rows
    truth = truth_estimate(later, 0)
    assert truth.stamp == later.stamps[0]
    np.testing.assert_allclose(truth.enu, 0.0, atol=1e-9)


def test_a_still_receivers_code_is_range_and_clock():
    run = simulate(replace(BRIEF, budget=NOISELESS), 1)
    from ins_gps.fix import OK, solve_position

    for epoch, clock in zip(run.epochs, run.clock):
        rows = epoch.rows
        fix = solve_position(
            rows[:, 9:15], rows[:, 3] + SPEED_OF_LIGHT * rows[:, 15], np.ones(len(rows)), rows[:, 0]
        )
        assert fix.status == OK
        assert fix.clock == pytest.approx(clock[0], abs=1e-3)
