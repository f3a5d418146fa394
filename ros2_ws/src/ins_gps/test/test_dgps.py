# SPDX-License-Identifier: Apache-2.0
"""The base on receivers that do not deliver everything."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ins_gps.dgps import DgpsBase
from ins_gps.orbit import range_and_rate
from ins_gps.params import BaseParams
from ins_gps.samples import OBS, GnssEpoch, PositionSample
from ins_gps.simulation import NOISELESS, Clock, Scenario
from ins_gps.simulation_gnss import simulate
from kalman_core.earth import ecef_from_geodetic

SCENE = Scenario(
    trajectory='constant', duration=20.0, imu_rate=10.0, budget=NOISELESS, clock=Clock(1e4, 30.0, 0.0, 0.0)
)
SITE = ecef_from_geodetic(*SCENE.origin)
PLACE = (math.degrees(SCENE.origin[0]), math.degrees(SCENE.origin[1]), SCENE.origin[2])


@pytest.fixture(scope='module')
def epochs():
    """Epochs of a receiver that stands at the origin: the ranges of the simulated sky from there."""
    out = []
    for epoch in simulate(SCENE, 0).epochs:
        rows = epoch.rows.copy()
        los = np.empty(3)
        for row in rows:
            distance, rate = range_and_rate(row[9:15], SITE, np.zeros(3), los)
            row[3] = distance - 299_792_458.0 * row[15] + 500.0
            row[5] = -(rate - 299_792_458.0 * row[16] + 30.0) / 0.19029367
        out.append(GnssEpoch(epoch.stamp, rows))
    return out


def base(**changes):
    return DgpsBase(BaseParams(**({'position': PLACE, 'elevation_mask': 0.0} | changes)))


def changed(epoch, column, value, rows=slice(None)):
    table = epoch.rows.copy()
    table[rows, OBS[column]] = value
    return epoch._replace(rows=table)


def test_without_errors_there_is_nothing_to_correct(epochs):
    station = base()
    for epoch in epochs:
        corrections = station.on_gnss(epoch).rows
        np.testing.assert_allclose(corrections[:, 2:4], 0.0, atol=1e-6)
    assert station.diagnostics()['offset of own fix (m)'] < 1e-3


def test_a_receiver_without_doppler_and_carrier_still_corrects_ranges(epochs):
    station = base()
    for epoch in epochs[:5]:
        bare = changed(changed(epoch, 'doppler', np.nan), 'carrier_phase', np.nan)
        bare = changed(bare, 'pseudorange', bare.rows[2, 3] + 12.0, 2)
        corrections = station.on_gnss(bare).rows
        assert corrections[2, 2] == pytest.approx(-12.0, abs=1e-6)
        assert not corrections[:, 3].any()


def test_a_rate_that_one_satellite_has_alone_is_corrected_and_noise_is_not(epochs):
    for error, sent in ((1.0, -1.0), (0.1, 0.0)):
        epoch = changed(epochs[0], 'doppler', epochs[0].rows[1, 5] - error / 0.19029367, 1)
        rates = base().on_gnss(epoch).rows[:, 3]
        assert rates[1] == pytest.approx(sent, abs=1e-4)
        assert np.abs(np.delete(rates, 1)).max() < 1e-4


def test_satellites_that_contradict_each_other_are_not_held_against_the_position(epochs):
    # Five codes of which one is off by 100 m: no fix that fits, and nothing that says which is wrong.
    rows = epochs[0].rows[:5].copy()
    rows[2, 3] += 100.0
    station = base()
    assert station.on_gnss(GnssEpoch(epochs[0].stamp, rows)) is not None
    assert station.wrong_position is None


def test_a_position_on_the_topic_does_not_replace_the_parameter(epochs):
    station = base()
    station.on_position(PositionSample(epochs[0].stamp, np.array([0.1, 0.2, 3.0]), np.eye(3)))
    np.testing.assert_allclose(station.position, SITE)
    assert station.on_gnss(epochs[0]) is not None


def test_fewer_than_four_satellites_say_so_and_other_bands_are_left_to_the_rover(epochs):
    station = base()
    assert station.on_gnss(GnssEpoch(epochs[0].stamp, epochs[0].rows[:3])) is None
    assert station.tally.sensor('base/observations').rejected == {'fewer than 4 satellites': 1}
    other = epochs[1].rows.copy()
    other[:, 2] = 5.0
    corrections = station.on_gnss(GnssEpoch(epochs[1].stamp, np.vstack([epochs[1].rows, other])))
    assert len(corrections.rows) == len(epochs[1].rows)


def test_a_slip_at_the_base_does_not_jump_into_the_corrections(epochs):
    clean, slipped = base(), base()
    for k, epoch in enumerate(epochs):
        phase = epoch.rows[0, 4] + (200.0 if k >= 10 else 0.0)
        ours = slipped.on_gnss(changed(epoch, 'carrier_phase', phase, 0)).rows
        np.testing.assert_allclose(ours[:, 2], clean.on_gnss(epoch).rows[:, 2], atol=5.0)


@pytest.mark.parametrize('latitude', [-91.0, 95.0])
def test_a_latitude_that_no_place_has_is_named(latitude):
    with pytest.raises(ValueError, match='latitude'):
        replace(BaseParams(), position=(latitude, 0.0, 0.0))
