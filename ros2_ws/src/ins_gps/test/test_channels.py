# SPDX-License-Identifier: Apache-2.0
"""Which satellite lies where in the state, how much its code weighs, and what is plausible at all."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ins_gps import layout as at
from ins_gps.channels import (
    channel_of,
    clear_error,
    correction_of,
    decay_multipath,
    store_corrections,
    wavelength,
    weight_of,
)
from ins_gps.configuration import config_array
from ins_gps.params import FilterParams
from ins_gps.plausibility import (
    all_plausible,
    imu_fault,
    navigation_fault,
    plausible_rows,
    valid_satellites,
)
from ins_gps.prediction import covariance_of
from ins_gps.samples import OBS, OBSERVATION_COLUMNS, ImuSample

PARAMS = FilterParams(channels=4)
CONFIG = config_array(PARAMS)


def empty(second=1000.0):
    state = np.zeros(at.state_size(PARAMS.channels))
    state[at.SEC] = second
    return state


def seen(state, satellite, corrected=False, config=CONFIG):
    """Give satellite (GPS, L1) its channel now, as an epoch does; return the channel."""
    channel = channel_of(state, PARAMS.channels, config, 1.0 + 10.0 * satellite + 1.0, corrected)
    if channel >= 0:
        start = at.HEAD + channel * at.CHANNEL_WIDTH
        state[start + at.C_SEC], state[start + at.C_NSEC] = state[at.SEC], state[at.NSEC]
    return channel


def test_a_satellite_keeps_its_channel_and_the_one_unseen_longest_gives_way():
    state = empty()
    channels = []
    for satellite in (1, 2, 3, 4):
        channels.append(seen(state, satellite))
        state[at.SEC] += 1.0
    assert sorted(channels) == [0, 1, 2, 3]
    assert seen(state, 1) == channels[0]
    state[at.SEC] += 1.0
    assert seen(state, 5) == channels[1]
    assert seen(state, 6) == channels[2]


def test_a_satellite_of_this_epoch_is_not_put_out_by_one_too_many():
    state = empty()
    channels = [seen(state, satellite) for satellite in (1, 2, 3, 4, 5)]
    assert channels[:4] == [0, 1, 2, 3]
    assert channels[4] == -1


@pytest.mark.parametrize(('away', 'kept'), [(599.0, True), (601.0, False)])
def test_a_satellite_that_was_away_for_long_starts_its_errors_anew(away, kept):
    state = empty()
    start = at.HEAD + seen(state, 7) * at.CHANNEL_WIDTH
    state[start + at.C_SLOW] = 3.0
    state[at.SEC] += away
    assert at.HEAD + seen(state, 7) * at.CHANNEL_WIDTH == start
    assert (state[start + at.C_SLOW] == 3.0) == kept


def test_a_correction_that_comes_or_goes_starts_the_slow_error_anew():
    state = empty()
    variances = []
    for corrected in (False, True, True, False):
        channel = seen(state, 7, corrected)
        index = at.CHANNEL + at.PER_CHANNEL * channel
        variances.append(covariance_of(state, PARAMS.channels)[index, index])
        state[at.SEC] += 1.0
    alone, with_base = PARAMS.code_slow_alone**2, PARAMS.code_slow**2
    assert variances == pytest.approx([alone, with_base, with_base, alone])


def test_an_error_that_is_cleared_has_nothing_to_do_with_others():
    state = empty()
    P = covariance_of(state, PARAMS.channels)
    A = np.random.default_rng(1).normal(size=P.shape)
    P[:] = A @ A.T
    before = P.copy()
    clear_error(state, PARAMS.channels, 5, 2.0)
    others = np.arange(len(P)) != 5
    assert P[5, 5] == 2.0
    assert not P[5, others].any()
    assert not P[others, 5].any()
    np.testing.assert_array_equal(P[np.ix_(others, others)], before[np.ix_(others, others)])


def test_multipath_fades_to_its_own_spread_and_where_there_is_none_to_model_nothing_does():
    state = empty()
    channel = seen(state, 7)
    index, start = at.CHANNEL + at.PER_CHANNEL * channel + 1, at.HEAD + channel * at.CHANNEL_WIDTH
    P = covariance_of(state, PARAMS.channels)
    P[index, index] = 0.0
    state[start + at.C_MULTIPATH] = 5.0
    time, size = PARAMS.multipath_time, PARAMS.code_multipath
    # Gauss-Markov: in one step as in ten.
    for _ in range(10):
        decay_multipath(state, PARAMS.channels, CONFIG, 0.1 * time)
    assert state[start + at.C_MULTIPATH] == pytest.approx(5.0 / math.e)
    assert P[index, index] == pytest.approx(size**2 * (1.0 - math.exp(-2.0)))
    published = config_array(replace(PARAMS, states='published'))
    decay_multipath(state, PARAMS.channels, published, 100.0)
    assert state[start + at.C_MULTIPATH] == pytest.approx(5.0 / math.e)


def test_low_and_weak_signals_weigh_less():
    elevations = np.radians([90.0, 45.0, 20.0, 10.0, 5.0, 0.0, -5.0])
    weights = [weight_of(CONFIG, e, math.nan) for e in elevations]
    assert weights[0] == pytest.approx(1.0)
    assert weights == sorted(weights)
    assert weight_of(CONFIG, math.pi / 2, PARAMS.cn0_reference) == pytest.approx(1.0)
    assert weight_of(CONFIG, math.pi / 2, PARAMS.cn0_reference - 10.0) == pytest.approx(10.0)
    plain = config_array(replace(PARAMS, elevation_weighting=False))
    assert weight_of(plain, 0.1, 20.0) == 1.0


def test_corrections_move_with_their_rate_and_grow_old():
    state = empty()
    row = np.full(OBSERVATION_COLUMNS, np.nan)
    row[:3] = 1.0, 12.0, 1.0
    assert not correction_of(state, PARAMS.channels, CONFIG, row)[2]
    store_corrections(state, PARAMS.channels, np.array([[1.0, 12.0, -7.0, 0.5, 0.0]]), 990.0, 5e8)
    value, rate, valid = correction_of(state, PARAMS.channels, CONFIG, row)
    assert valid
    assert (value, rate) == pytest.approx((-7.0 + 9.5 * 0.5, 0.5))
    state[at.SEC] += PARAMS.correction_age
    assert not correction_of(state, PARAMS.channels, CONFIG, row)[2]


def test_wavelengths_are_those_of_the_interface_documents():
    frequencies = {1.0: 154.0, 2.0: 120.0, 5.0: 115.0, 7.0: 118.0}
    for band, multiple in frequencies.items():
        assert wavelength(band) == pytest.approx(299_792_458.0 / (multiple * 10.23e6), rel=1e-14)


def test_what_no_imu_measures_is_named():
    good = np.array([0.1, 0.0, -0.1]), np.array([0.0, 0.0, -9.8])
    assert not imu_fault(ImuSample(1, *good))
    for rate, force, reason in (
        ((math.nan, 0.0, 0.0), good[1], 'not finite'),
        (good[0], (0.0, math.inf, 0.0), 'not finite'),
        ((200.0, 0.0, 0.0), good[1], 'implausible value'),
        (good[0], (0.0, 0.0, -6e3), 'implausible value'),
        (good[0], (0.0, 0.0, 0.0), 'zero specific force'),
    ):
        sample = ImuSample(1, np.array(rate), np.array(force))
        assert imu_fault(sample) == reason
        assert not all_plausible(np.array([good[0], rate]), np.array([good[1], force]))
    assert all_plausible(np.array([good[0]] * 2), np.array([good[1]] * 2))


@pytest.mark.parametrize(
    ('values', 'covariance', 'reason'),
    [
        ((1.0, 2.0, 3.0), np.eye(3), ''),
        ((math.nan, 2.0, 3.0), np.eye(3), 'not finite'),
        ((1.0, 2.0, 3.0), np.diag([1.0, math.inf, 1.0]), 'not finite'),
        ((1.0, 2.0, 1e9), np.eye(3), 'implausible value'),
        ((1.0, 2.0, 3.0), 1e15 * np.eye(3), 'implausible value'),
        ((1.0, 2.0, 3.0), np.diag([1.0, 0.0, 1.0]), 'covariance not positive definite'),
    ],
)
def test_what_no_position_or_velocity_is_has_a_reason(values, covariance, reason):
    assert navigation_fault(np.array(values), covariance) == reason


def test_a_cell_that_cannot_be_is_not_measured_and_an_orbit_goes_as_a_whole():
    row = np.full(OBSERVATION_COLUMNS, np.nan)
    row[:7] = 0.0, 7.0, 1.0, 2.2e7, 1.1e8, -500.0, 44.0
    row[OBS['satellite_x'] : OBS['satellite_x'] + 8] = 2.0e7, 1.5e7, 1.0e7, 1e3, 2e3, 1e3, 1e-4, 1e-12
    whole, changed = plausible_rows(row[None].copy())
    assert not changed
    np.testing.assert_array_equal(whole[0], row)
    for name, value in (('pseudorange', 5.0), ('cn0', 700.0), ('satellite_clock', 3.0)):
        bad = row.copy()
        bad[OBS[name]] = value
        kept, changed = plausible_rows(bad[None])
        assert changed
        assert np.isnan(kept[0, OBS[name]])
        assert np.isnan(kept).sum() == np.isnan(row).sum() + 1
    ground = row.copy()
    ground[OBS['satellite_x'] : OBS['satellite_x'] + 3] = 6.4e6, 0.0, 0.0
    kept, _ = plausible_rows(ground[None])
    assert np.isnan(kept[0, 9:17]).all()
    assert kept[0, 3] == 2.2e7


def test_names_of_satellites_and_signals_that_there_are():
    rows = np.full((7, OBSERVATION_COLUMNS), np.nan)
    rows[:, :3] = [(0, 7, 1), (1, 36, 7), (2, 7, 1), (0, 0, 1), (0, 7.5, 1), (0, 40, 1), (0, 7, 3)]
    assert valid_satellites(rows).tolist() == [True, True, False, False, False, False, False]
    assert valid_satellites(rows[:6, :5]).tolist() == [True, True, False, False, False, False]
