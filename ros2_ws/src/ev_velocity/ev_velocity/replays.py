# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package, through the joint filter and the paper's fusion."""

from pathlib import Path

from bag_tools.catalogue import Entry, Recorded, Replay
from ev_velocity.params import FusionParams

_VALUE = 'twist.twist.linear.x'
_ENTRIES = (
    Entry('published', 'fusion_estimator', 'fusion/velocity', {'variant': 'published'}, _VALUE),
    Entry('fusion', 'fusion_estimator', 'fusion/velocity', {}, _VALUE),
    Entry('joint', 'velocity_estimator', 'vehicle/velocity', {}, _VALUE),
)
_TRUTH = '/truth/velocity'
_COMPONENTS = ('x',)


def _replay(bag: str, title: str) -> Replay:
    return Replay(bag, title, _TRUTH, _ENTRIES, _COMPONENTS, truth_field='twist.linear.x')


REPLAYS = (
    _replay('ev_good_road', 'good road, GPS late by an unknown 0.15 s'),
    _replay('ev_oil_patch', 'wheel spin on oil'),
    _replay('ev_gps_trouble', 'GPS multipath and outage'),
)


# One step of a 10 Hz accelerometer is as long as fifty of the paper's.
_SLOW = {'sigma_accelerometer': tuple(50.0 * s for s in FusionParams().sigma_accelerometer)}
_RECORDED_ENTRIES = (
    Entry('published', 'fusion_estimator', 'fusion/velocity', {'variant': 'published', **_SLOW}, _VALUE),
    Entry('fusion', 'fusion_estimator', 'fusion/velocity', _SLOW, _VALUE),
    Entry('joint', 'velocity_estimator', 'vehicle/velocity', {}, _VALUE),
)


def _kingston(bag: Path) -> Replay:
    title = 'recorded downtown drive with survey-grade reference'
    return Replay(bag.stem, title, _TRUTH, _RECORDED_ENTRIES, _COMPONENTS, truth_field='twist.linear.x')


RECORDED = (Recorded('ev/kingston_1800s', 'ev_velocity:kingston', _kingston, live_seconds=60.0),)
