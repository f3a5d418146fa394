# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from ins_gps.codec import INS_GPS_PORTS
from ins_gps.params import (
    BaseParams,
    FilterParams,
    NmeaParams,
    RinexParams,
    RtcmParams,
    SimulatorParams,
    UbloxParams,
)
from kalman_core.parameters import ParameterError, build, default_yaml

NODES = {
    'ins_gps_estimator': FilterParams,
    'dgps_base': BaseParams,
    'uav_simulator': SimulatorParams,
    'rinex_driver': RinexParams,
    'ublox_driver': UbloxParams,
    'nmea_driver': NmeaParams,
    'rtcm_driver': RtcmParams,
}


@pytest.mark.parametrize('node', NODES)
def test_the_default_yaml_is_up_to_date(node):
    path = Path(__file__).parent.parent / 'config' / f'{node}.yaml'
    assert path.read_text() == default_yaml(NODES[node], node)


def test_bad_parameters_are_named():
    with pytest.raises(ParameterError, match="'mode' is 'magic'"):
        build(FilterParams, {'mode': 'magic'})
    with pytest.raises(ParameterError, match='latitude 95'):
        build(BaseParams, {'position': [95.0, 0.0, 0.0]})
    for date in ('29.2.2024', '2023-02-29', 'today'):
        with pytest.raises(ParameterError, match=f"'date' is '{date}'"):
            build(NmeaParams, {'date': date})


@pytest.mark.parametrize('driver', [UbloxParams, RtcmParams, RinexParams])
def test_no_driver_of_raw_observations_sends_a_fix_to_the_estimator_beside_them(driver):
    """A receiver's fix is made of its observations: taken too, they would count twice."""
    heard = {port.topic for port in INS_GPS_PORTS.inputs}
    defaults = driver()
    spoken = {
        getattr(defaults, name)
        for name in ('topic', 'fix_topic', 'position_topic')
        if hasattr(defaults, name)
    }
    assert spoken & heard == {'gnss/observations'}
