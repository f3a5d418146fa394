# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from numba import njit
from scipy.stats import chi2

from kalman_core.gates import GATES, chi2_gate, chi2_gates, chi2_tail


@pytest.mark.parametrize('dof', [1, 2, 3, 4, 5, 8, 15, 40, 199, 200])
@pytest.mark.parametrize('value', [1e-9, 0.3, 1.0, 7.0, 60.0, 500.0])
def test_the_tail_equals_scipy(dof, value):
    assert chi2_tail(value, dof) == pytest.approx(chi2.sf(value, dof), rel=1e-11, abs=1e-300)


@pytest.mark.parametrize('value', [0.0, -1.0])
def test_the_tail_of_nothing_is_everything(value):
    assert chi2_tail(value, 3) == 1.0


@pytest.mark.parametrize('dof', [1, 2, 3, 6, 17, 50, 200])
@pytest.mark.parametrize('probability', [0.9, 0.5, 0.05, 1e-3, 1e-6, 1e-10, 1e-30])
def test_the_gate_equals_scipy(dof, probability):
    assert chi2_gate(dof, probability) == pytest.approx(chi2.isf(probability, dof), rel=1e-12)


def test_the_documented_gates_are_those_of_one_in_a_thousand():
    assert round(chi2_gate(2), 1) == 13.8
    assert round(chi2_gate(3), 1) == 16.3


def test_tables_hold_the_gates_by_degrees_of_freedom():
    assert chi2_gates(3, 0.05) == pytest.approx([0.0, *chi2.isf(0.05, [1, 2, 3])])
    assert pytest.approx([0.0, *chi2.isf(1e-3, np.arange(1, 17))]) == GATES


def test_kernels_can_use_the_table_as_a_constant():
    @njit
    def gate(dof):
        return GATES[dof]

    assert gate(3) == GATES[3]


@pytest.mark.parametrize(
    ('dof', 'probability', 'message'),
    [
        (0, 0.1, 'dof is 0'),
        (201, 0.1, 'dof is 201'),
        (2, 0.9e-30, 'probability is 9e-31'),
        (2, 1.0, 'probability is 1.0'),
        (2, float('nan'), 'probability is nan'),
    ],
)
def test_impossible_gates_are_refused(dof, probability, message):
    with pytest.raises(ValueError, match=message):
        chi2_gate(dof, probability)
