# SPDX-License-Identifier: Apache-2.0
import pytest

from quad_control.fault_injection import STATED, inject


@pytest.mark.parametrize('fault', STATED)
@pytest.mark.parametrize('seed', [0, 1])
def test_every_fault_ends_in_idle_or_a_landing_in_its_stated_time(fault, seed):
    reaction = inject(fault, seed)
    assert reaction.seconds <= STATED[fault]
    assert reaction.well_ended
