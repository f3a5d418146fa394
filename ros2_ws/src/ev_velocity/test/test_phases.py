# SPDX-License-Identifier: Apache-2.0
from hypothesis import given, settings
from hypothesis import strategies as st

from ev_velocity.phases import Phase, classify, classify_printed

PEDAL = st.one_of(st.just(0.0), st.floats(0.0, 1.0))
ACCELERATION = st.floats(-20.0, 20.0)
# A previous phase that no rule can return.
NONE = -1


@settings(max_examples=200, deadline=None)
@given(PEDAL, PEDAL, ACCELERATION, st.sampled_from((-1.0, 1.0)))
def test_every_input_has_a_phase(accelerator, brake, acceleration, direction):
    assert classify(accelerator, brake, acceleration, direction, 0.15) in list(Phase)


@settings(max_examples=300, deadline=None)
@given(PEDAL, PEDAL, ACCELERATION)
def test_the_printed_rules_hold_wherever_one_of_them_applies(accelerator, brake, acceleration):
    printed = classify_printed(accelerator, brake, acceleration, 0.15, 0.2, NONE)
    if printed != NONE:
        assert classify(accelerator, brake, acceleration, 1.0, 0.15) == printed


def test_the_holes_of_the_printed_rules_are_named():
    assert classify_printed(0.0, 0.0, 0.0, 0.15, 0.2, NONE) == NONE
    assert classify(0.0, 0.0, 0.0, 1.0, 0.15) == Phase.COASTING
    assert classify_printed(0.3, 0.0, -1.0, 0.15, 0.2, NONE) == NONE
    assert classify(0.3, 0.0, -1.0, 1.0, 0.15) == Phase.COASTING
    assert classify_printed(0.0, 0.4, 0.0, 0.15, 0.2, NONE) == NONE
    assert classify(0.0, 0.4, 0.0, 1.0, 0.15) == Phase.BRAKING


def test_reverse_mirrors_the_acceleration():
    assert classify(0.3, 0.0, -1.0, -1.0, 0.15) == Phase.ACCELERATING
    assert classify(0.3, 0.0, 1.0, -1.0, 0.15) == Phase.COASTING
