# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ins_gps.constants import GPS_EPOCH_UNIX
from ins_gps.fix import (
    INCONSISTENT,
    NOT_CONVERGED,
    OK,
    TOO_FEW,
    protection_level,
    solve_position,
    solve_velocity,
)
from ins_gps.orbit import range_and_rate
from ins_gps.simulation import Scenario
from ins_gps.simulation_gnss import OPEN_SKY, _observe_exactly, constellation, constellation_through
from kalman_core.earth import ecef_from_geodetic, mat_ecef_from_ned


@pytest.fixture
def sky():
    scenario = Scenario(duration=10.0)
    nav = np.r_[scenario.origin, 10.0, -5.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    exact = _observe_exactly(constellation(scenario), scenario, scenario.start, nav, np.zeros(3))
    site = ecef_from_geodetic(*scenario.origin)
    velocity = mat_ecef_from_ned(nav[0], nav[1]) @ nav[3:6]
    return exact, site, velocity


def test_exact_ranges_give_position_and_clock_from_the_earths_centre(sky):
    exact, site, _ = sky
    fix = solve_position(exact[:, :6], exact[:, 8] + 12_345.0, np.ones(6), np.zeros(6))
    assert fix.status == OK
    assert np.linalg.norm(fix.position - site) < 1e-4
    assert fix.clock == pytest.approx(12_345.0, abs=1e-4)


def test_exact_rates_give_velocity_and_drift(sky):
    exact, site, velocity = sky
    fix = solve_velocity(exact[:, :6], exact[:, 10] + 7.0, np.ones(6), np.zeros(6), site)
    assert np.linalg.norm(fix.position - velocity) < 1e-5
    assert fix.clock == pytest.approx(7.0, abs=1e-5)


def test_intersystem_bias_is_solved_with_both_systems(sky):
    exact, site, _ = sky
    system = np.array([0, 0, 0, 1, 1, 1])
    fix = solve_position(exact[:, :6], exact[:, 8] + 25.0 * system, np.ones(6), system)
    assert np.linalg.norm(fix.position - site) < 1e-4
    assert fix.intersystem == pytest.approx(25.0, abs=1e-4)


@pytest.mark.parametrize('satellite', range(6))
def test_raim_excludes_the_one_wrong_satellite(sky, satellite):
    exact, site, _ = sky
    ranges = exact[:, 8] + np.random.default_rng(satellite).normal(0.0, 0.3, 6)
    ranges[satellite] += 500.0
    fix = solve_position(exact[:, :6], ranges, np.full(6, 0.3), np.zeros(6))
    assert fix.status == OK
    assert not fix.used[satellite]
    assert fix.used.sum() == 5
    assert np.linalg.norm(fix.position - site) < 10.0


def test_five_satellites_detect_but_cannot_exclude(sky):
    exact, _, _ = sky
    ranges = exact[:5, 8].copy()
    ranges[2] += 500.0
    fix = solve_position(exact[:5, :6], ranges, np.full(5, 0.3), np.zeros(5))
    assert fix.status == INCONSISTENT
    assert not fix.checked


def test_three_satellites_and_nan_rows_give_no_fix(sky):
    exact, _, _ = sky
    ranges = exact[:, 8].copy()
    ranges[3:] = np.nan
    assert solve_position(exact[:, :6], ranges, np.ones(6), np.zeros(6)).status == TOO_FEW


def test_covariance_is_that_of_the_errors(sky):
    exact, site, _ = sky
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(200):
        fix = solve_position(
            exact[:, :6], exact[:, 8] + rng.normal(0.0, 1.0, 6), np.ones(6), np.zeros(6), site
        )
        error = fix.position - site
        squares.append(error @ np.linalg.solve(fix.covariance[:3, :3], error))
    assert 2.5 < np.mean(squares) < 3.5


def test_spirent_code_fix_is_exact_to_five_millimetres(recordings):
    from ins_gps.observations import EpochBuilder
    from ins_gps.recordings import gnss_epochs

    folder = recordings / 'spirent_iono_none'
    navigation = (folder / 'RINEX_GN_Spirent.23N', folder / 'RINEX_EN_Spirent.23L')
    epochs = gnss_epochs(folder / 'Rover-dynamic_MO_Spirent.obs', navigation, atmosphere=False)
    truth = np.loadtxt(folder / 'Rover-dynamic_PVA_Spirent.csv', delimiter=',', skiprows=1)[::10, 4:7]
    assert EpochBuilder is not None
    errors = []
    for epoch, site in zip(epochs, truth):
        rows = epoch.rows
        ranges = rows[:, 3] + 299_792_458.0 * rows[:, 15]
        fix = solve_position(rows[:, 9:15], ranges, np.ones(len(rows)), rows[:, 0])
        errors.append(np.linalg.norm(fix.position - site))
    assert len(errors) == 601
    assert max(errors) < 5e-3


def test_line_of_sight_points_to_the_satellite(sky):
    exact, site, _ = sky
    los = np.zeros(3)
    distance, _ = range_and_rate(exact[0], site, np.zeros(3), los)
    assert np.linalg.norm(los) == pytest.approx(1.0)
    # The Earth turns by up to 35 m at this range during the flight.
    assert np.linalg.norm(site + distance * los - exact[0, :3]) < 200.0


def test_protection_level_grows_with_integrity():
    assert protection_level(1.0, 1e-7) == pytest.approx(5.33, abs=0.01)


def test_satellites_in_one_direction_give_no_fix(sky):
    exact, _, _ = sky
    rows = np.repeat(exact[:1], 5, axis=0)
    fix = solve_position(rows[:, :6], rows[:, 8], np.ones(5), np.zeros(5))
    assert fix.status == NOT_CONVERGED
    assert not fix.checked


def test_ranges_that_no_place_has_end_without_a_fix(sky):
    exact, _, _ = sky
    ranges = np.array([1.0, 5e8, 3.0, 4e8])
    assert solve_position(exact[:4, :6], ranges, np.ones(4), np.zeros(4)).status != OK


@pytest.mark.parametrize('wrong', range(7))
def test_the_only_satellite_of_a_system_is_never_the_one_that_is_found_wrong(wrong):
    """It alone tells the inter-system bias, so its code fits whatever it says."""
    scenario = Scenario(duration=10.0)
    nav = np.r_[scenario.origin, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    time = scenario.start / 1e9 - GPS_EPOCH_UNIX
    eph = constellation_through((*OPEN_SKY, (160, 60), (280, 50)), scenario.origin, time)
    exact = _observe_exactly(eph, scenario, scenario.start, nav, np.zeros(3))
    system = np.array([0, 0, 0, 0, 0, 0, 0, 1])
    ranges = exact[:, 8].copy()
    ranges[wrong] += 400.0
    fix = solve_position(exact[:, :6], ranges, np.full(8, 0.3), system)
    assert fix.status == OK
    assert np.flatnonzero(~fix.used).tolist() == [wrong]
    assert np.linalg.norm(fix.position - ecef_from_geodetic(*scenario.origin)) < 1e-3
    # Without one to spare the error is seen, but whose it is cannot be.
    fix = solve_position(exact[2:, :6], ranges[2:] + (np.arange(6) == 1) * 400.0, np.full(6, 0.3), system[2:])
    assert fix.status == INCONSISTENT
