# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields

import pytest

from kalman_core.parameters import ParameterError
from ship_inclinometer.bridge_params import ModbusParams, NmeaParams
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.simulation_params import PlayParams, ShipSimulatorParams, SimulatorParams


@pytest.mark.parametrize('allowed', ['', '10.1.2.3', '10.0.0.0/8 ::1/128', '10.0.0.1/8'])
def test_networks_that_may_connect_are_addresses_or_prefixes(allowed):
    assert ModbusParams(tcp_allowed=allowed).tcp_allowed == allowed


@pytest.mark.parametrize('allowed', ['nonsense', '10.0.0.0/33', '127.0.0.1,127.0.0.2'])
def test_what_is_no_network_is_refused_by_the_name_of_its_parameter(allowed):
    with pytest.raises(ParameterError, match='tcp_allowed'):
        ModbusParams(tcp_allowed=allowed)


@pytest.mark.parametrize('talker', ['', 'I', 'ii', 'III', 'I,', 'ÄÖ', 'A1'])
def test_a_talker_that_would_spoil_the_sentence_is_refused(talker):
    with pytest.raises(ParameterError, match='talker'):
        NmeaParams(talker=talker)


def test_what_is_played_and_the_ship_share_no_parameter():
    # The node declares both: a name in common would set the ship's speed and the playback at once.
    played, ship = ({f.name for f in fields(kind)} for kind in (PlayParams, SimulatorParams))
    assert not played & ship
    assert len(fields(ShipSimulatorParams)) == len(played) + len(ship)


@pytest.mark.parametrize(
    ('change', 'name'),
    [({'manufacturer': 'ab'}, 'manufacturer'), ({'command_port': 60000}, 'command_port')],
)
def test_alert_commands_need_the_code_of_a_manufacturer(change, name):
    with pytest.raises(ParameterError, match=name):
        NmeaParams(**change)
    assert NmeaParams(manufacturer='ABC', command_port=60000).command_port == 60000


def test_a_gnss_delay_that_the_window_cannot_repair_is_refused():
    with pytest.raises(ParameterError, match="'gnss_delay' is larger than 'window'"):
        AttitudeParams(gnss_delay=1.0, window=0.5)
