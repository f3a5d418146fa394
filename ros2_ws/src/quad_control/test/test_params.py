# SPDX-License-Identifier: Apache-2.0
import dataclasses

import pytest

from kalman_core.parameters import ParameterError
from quad_control.params import EscParams, MixerParams, WebParams


@pytest.mark.parametrize(
    ('params', 'change', 'word'),
    [
        (MixerParams, {'pulse_min': 1500.0, 'pulse_max': 1500.0}, "'pulse_max'"),
        (EscParams, {'bus': '/dev/ttyUSB0'}, "'bus'"),
        (EscParams, {'channels': (0.0, 1.0, 1.0, 3.0)}, "'channels'"),
        (EscParams, {'channels': (0.0, 1.5, 2.0, 3.0)}, "'channels' .* whole numbers"),
        (WebParams, {'host': '0.0.0.0'}, "'token'"),
        (WebParams, {'token': 'short'}, "'token'"),
        (WebParams, {'proxy_host': 'https://quad.example/'}, "'proxy_host'"),
    ],
)
def test_rules_that_span_fields_refuse_by_name(params, change, word):
    with pytest.raises(ParameterError, match=word):
        dataclasses.replace(params(), **change)


def test_a_page_open_to_the_network_needs_a_token_of_its_own():
    assert WebParams(host='0.0.0.0', token='x' * 16).token == 'x' * 16
