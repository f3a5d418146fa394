# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package: its fixtures, through the joint filter and the paper's fusion."""

from bag_tools.catalogue import Entry, Replay

_VALUE = 'twist.twist.linear'
_ENTRIES = (
    Entry('published', 'fusion_estimator', 'fusion/velocity', {'variant': 'published'}, _VALUE),
    Entry('fusion', 'fusion_estimator', 'fusion/velocity', {}, _VALUE),
    Entry('joint', 'velocity_estimator', 'vehicle/velocity', {}, _VALUE),
)
_TRUTH = '/truth/velocity'
_COMPONENTS = ('x',)


def _replay(bag: str, title: str) -> Replay:
    return Replay(bag, title, _TRUTH, _ENTRIES, _COMPONENTS, truth_field='twist.linear')


REPLAYS = (
    _replay('ev_good_road', 'good road, GPS late by an unknown 0.15 s'),
    _replay('ev_oil_patch', 'wheel spin on oil'),
    _replay('ev_gps_trouble', 'GPS multipath and outage'),
)
