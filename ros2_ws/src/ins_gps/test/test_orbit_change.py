# SPDX-License-Identifier: Apache-2.0
"""A new ephemeris between two epochs is no motion: not of the craft, not of a code, not of a correction."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ins_gps import layout as at
from ins_gps.carrier import reclone, remember_carrier
from ins_gps.channels import (
    RATE_USED,
    REPORT_CODE_W,
    REPORT_RATE,
    REPORT_RATE_W,
    assign,
    corrected_range,
    store_corrections,
)
from ins_gps.configuration import config_array
from ins_gps.constants import SPEED_OF_LIGHT, WAVELENGTH_L1
from ins_gps.evaluation import evaluate, filter_params
from ins_gps.loose import epoch_fix
from ins_gps.observations import EpochBuilder
from ins_gps.orbit import ephemeris_row, range_and_rate, satellite_state
from ins_gps.orbit_change import follow_orbit, keep_orbit
from ins_gps.params import FilterParams
from ins_gps.rinex import RawEpoch
from ins_gps.samples import OBS, GnssEpoch
from ins_gps.simulation import STANDALONE, Scenario
from ins_gps.simulation_gnss import simulate
from kalman_core.earth import ecef_from_geodetic, mat_ecef_from_ned

TOE = 1_400_000_400.0
SITE = ecef_from_geodetic(0.8, 0.2, 300.0)
OLD = {
    'system': 0, 'satellite': 7, 'toe': TOE - 3600.0, 'toc': TOE, 'sqrt_a': 5153.6, 'eccentricity': 0.01,
    'inclination': 0.96, 'week_second': (TOE - 3600.0) % 604_800.0, 'af0': 1e-4, 'af1': 1e-11,
}  # fmt: skip
START = at.CHANNEL_WIDTH  # where the satellite's corrections lie in the small state of these tests


def overhead():
    """Return the mean anomaly and node of an orbit whose satellite is above the site at TOE."""
    best = (0.0, 0.0, 0.0)
    out = np.empty(8)
    for mean in np.linspace(0.0, 2.0 * math.pi, 60):
        for node in np.linspace(0.0, 2.0 * math.pi, 60):
            satellite_state(ephemeris_row(**OLD, mean_anomaly=mean, ascending_node=node), TOE, out)
            up = out[:3] @ SITE / np.linalg.norm(out[:3]) / np.linalg.norm(SITE)
            best = max(best, (up, mean, node))
    return best[1:]


@pytest.fixture(scope='module')
def orbit():
    mean, node = overhead()
    return OLD | {'mean_anomaly': mean, 'ascending_node': node}


def observed(ephemeris, truth, time):
    """Return the row of an epoch at `time` whose range is that of `truth`, placed by `ephemeris`."""
    out, los = np.empty(8), np.empty(3)
    distance = 2.2e7
    for _ in range(4):
        satellite_state(truth, time - distance / SPEED_OF_LIGHT, out)
        distance = range_and_rate(out, SITE, np.zeros(3), los)[0]
    pseudorange = distance - SPEED_OF_LIGHT * out[6] + 4000.0  # the receiver's clock
    raw = np.array([[0.0, 7.0, 1.0, pseudorange, pseudorange / WAVELENGTH_L1, math.nan, 45.0, 0.0]])
    return EpochBuilder(ephemeris[None], atmosphere=False).build(RawEpoch(round(time * 1e9), raw)).rows[0]


def followed(before, now, dt):
    """Return the step and the small state of one channel over two rows."""
    state = np.zeros(at.CHANNEL_WIDTH + at.CORRECTION_WIDTH)
    keep_orbit(state, 0, before)
    return follow_orbit(state, 0, START, True, now, SITE, dt), state


def modelled(row):
    return range_and_rate(row[9:15], SITE, np.zeros(3), np.empty(3))[0] - SPEED_OF_LIGHT * row[15]


@pytest.mark.parametrize('dt', [0.1, 1.0, 5.0])
@pytest.mark.parametrize(('along', 'clock'), [(2.0, 0.0), (-2.0, 1.0), (0.0, -0.3), (10.0, 5.0)])
def test_the_step_is_the_difference_of_the_ephemerides(orbit, dt, along, clock):
    """By both ephemerides at the earlier epoch; along (m) the orbit and clock (m)."""
    old = ephemeris_row(**orbit)
    changes = {
        'mean_anomaly': orbit['mean_anomaly'] + along / 26.56e6,
        'crs': 1.5,
        'af0': orbit['af0'] + clock / SPEED_OF_LIGHT,
    }
    new = ephemeris_row(**(orbit | changes))
    before, now = observed(old, old, TOE), observed(new, old, TOE + dt)
    expected = modelled(observed(new, old, TOE)) - modelled(before)
    step, state = followed(before, now, dt)
    assert abs(expected) > 0.1
    assert step == pytest.approx(expected, abs=1e-3 * max(dt, 1.0))
    assert state[at.C_SLOW] == -step


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-7200.0, 7200.0), st.floats(0.05, 30.0), st.floats(0.0, 0.025), st.floats(0.0, 6.28),
    st.floats(0.0, 6.28),
)  # fmt: skip
def test_an_orbit_that_goes_on_makes_no_step(time, dt, eccentricity, mean, node):
    eph = ephemeris_row(
        **(OLD | {'eccentricity': eccentricity, 'mean_anomaly': mean, 'ascending_node': node})
    )
    before, now = (observed(eph, eph, OLD['toe'] + t) for t in (time, time + dt))
    assert followed(before, now, dt)[0] == 0.0


def test_nothing_is_changed_where_nothing_can_be_told(orbit):
    old = ephemeris_row(**orbit)
    new = ephemeris_row(**(orbit | {'af0': orbit['af0'] + 2.0 / SPEED_OF_LIGHT}))
    before, now = observed(old, old, TOE), observed(new, old, TOE + 1.0)
    assert followed(before, now, 1.0)[0] != 0.0
    for dt in (0.0, -1.0, 31.0):
        assert followed(before, now, dt)[0] == 0.0
    for column in (3, 12, 16):
        for k in (0, 1):
            rows = [before.copy(), now.copy()]
            rows[k][column] = math.nan
            step, state = followed(*rows, 1.0)
            assert step == 0.0
            assert np.isfinite(state).all()
    still = before.copy()
    still[12:15] = 0.0  # a driver that does not know velocities
    assert followed(still, now, 1.0)[0] == 0.0
    jumped = now.copy()
    jumped[3] += 1e-3 * SPEED_OF_LIGHT
    assert followed(before, jumped, 1.0)[0] == 0.0
    far = now.copy()
    far[15] += 200.0 / SPEED_OF_LIGHT
    assert followed(before, far, 1.0)[0] == 0.0


def test_a_correction_made_with_the_old_ephemeris_is_brought_to_the_new_one(orbit):
    """Base and rover change at TOE + 1 s; the corrections on the way are still of the old ephemeris."""
    params = FilterParams(channels=4)
    config = config_array(params)
    old = ephemeris_row(**orbit)
    new = ephemeris_row(**(orbit | {'af0': orbit['af0'] + 2.0 / SPEED_OF_LIGHT, 'crs': 1.5}))
    mat_en = mat_ecef_from_ned(0.8, 0.2)
    state = np.zeros(at.state_size(4))

    def received(ephemeris, time):
        state[at.SEC], state[at.NSEC] = math.floor(time), round(time % 1.0 * 1e9)
        row = observed(ephemeris, old, time)
        use, report = np.empty(1, np.int64), np.zeros((1, 5))
        assign(state, 4, config, row[None], SITE, mat_en, use, report)
        reclone(state, 4, config, row[None], use, SITE, np.zeros(3), report)
        value, _, corrected = corrected_range(state, 4, config, row)
        assert corrected
        assert state[at.HEAD + use[0] * at.CHANNEL_WIDTH + at.C_SLOW] == 0.0
        return value - range_and_rate(row[9:15], SITE, np.zeros(3), np.empty(3))[0]

    def sent(ephemeris, time):
        row = observed(ephemeris, old, time)
        correction = -(row[3] + SPEED_OF_LIGHT * row[15])
        correction += range_and_rate(row[9:15], SITE, np.zeros(3), np.empty(3))[0]
        return np.array([[0.0, 7.0, correction, 0.0, 0.0]])

    # Base and rover share all errors, so nothing is left but millimetres by which the orbits diverge.
    store_corrections(state, 4, sent(old, TOE), TOE, 0.0)
    assert received(old, TOE) == pytest.approx(0.0, abs=5e-3)
    for later in (1.0, 1.25):
        assert received(new, TOE + later) == pytest.approx(0.0, abs=5e-3)
    store_corrections(state, 4, sent(old, TOE + 0.5), TOE, 5e8)
    assert received(new, TOE + 1.5) == pytest.approx(0.0, abs=5e-3)
    store_corrections(state, 4, sent(new, TOE + 1.0), TOE + 1.0, 0.0)
    assert received(new, TOE + 1.75) == pytest.approx(0.0, abs=5e-3)


def replaced(run, first, signs):
    """Return a run whose orbits are 2 m higher or lower from epoch `first` on; signs: by satellite number."""
    epochs = []
    for k, epoch in enumerate(run.epochs):
        rows = epoch.rows.copy()
        if k >= first:
            shift = 2.0 * signs[rows[:, 1].astype(int)]
            rows[:, 9:15] *= 1.0 + (shift / np.linalg.norm(rows[:, 9:12], axis=1))[:, None]
        epochs.append(GnssEpoch(epoch.stamp, rows))
    return replace(run, epochs=epochs)


@pytest.mark.parametrize('how_many', ['one', 'all'])
@pytest.mark.parametrize('seed', [1000, 1001])
def test_the_filter_goes_on_as_if_nothing_had_happened(how_many, seed):
    """Without it most carriers were taken for slips and the position moved by up to 0.7 m."""
    budget = replace(STANDALONE, white=False)
    run = simulate(Scenario(trajectory='s_turns', duration=50.0, imu_rate=20.0, budget=budget), seed)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 40)
    if how_many == 'one':
        signs[np.arange(40) != 3] = 0.0
    plain, changed = (evaluate(r, filter_params(budget), seed) for r in (run, replaced(run, 30, signs)))
    assert np.abs(changed.errors - plain.errors)[:, :3].max() < 0.1
    assert np.abs(changed.errors - plain.errors)[:, 3:6].max() < 1e-3
    for before, after in zip(plain.fates[29:33], changed.fates[29:33], strict=True):
        assert (after[:, 2 + REPORT_RATE] == RATE_USED).all()
        for column in (REPORT_RATE_W, REPORT_CODE_W):
            np.testing.assert_allclose(after[:, 2 + column], before[:, 2 + column], atol=0.1)


def test_a_carrier_taken_as_a_rate_does_not_see_the_clock_step():
    """Loose coupling without Doppler: every satellite's clock steps by metres, velocity stays as it is."""
    run = simulate(
        Scenario(trajectory='s_turns', duration=12.0, imu_rate=20.0, budget=replace(STANDALONE, white=False)),
        1000,
    )
    steps = np.random.default_rng(1000).normal(0.0, 2.0, 40) / SPEED_OF_LIGHT
    params = FilterParams(mode='gps', channels=8)
    velocities = []
    for change in (False, True):
        state, config = np.zeros(at.state_size(8)), config_array(params)
        for k, epoch in enumerate(run.epochs[5:7]):
            rows = epoch.rows.copy()
            rows[:, OBS['doppler']] = math.nan
            if change and k == 1:
                rows[:, OBS['satellite_clock']] += steps[rows[:, 1].astype(int)]
            fix = epoch_fix(state, 8, config, params, rows, 1.0)
            remember_carrier(state, 8, config, rows)
        velocities.append(fix.velocity.position)
    assert np.linalg.norm(velocities[1] - velocities[0]) < 1e-3
