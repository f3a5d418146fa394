# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from importlib import import_module

import pytest

import kalman_core


def test_every_public_name_is_the_one_of_its_module():
    for name in kalman_core.__all__:
        module = import_module(f'kalman_core.{kalman_core._MODULE_OF[name]}')
        assert getattr(kalman_core, name) is getattr(module, name)


def test_every_public_name_is_documented():
    for name in kalman_core.__all__:
        value = getattr(kalman_core, name)
        assert name == 'GATES' or (value.__doc__ and value.__doc__.strip()), name


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'kalman_core' has no attribute 'kalmann'"):
        kalman_core.kalmann  # noqa: B018


def test_the_names_are_listed():
    assert set(kalman_core.__all__) <= set(dir(kalman_core))
    assert 'correct_scalar' in dir(kalman_core)


def test_importing_the_package_loads_neither_numba_nor_scipy_and_an_estimator_needs_no_scipy_special():
    code = (
        'import sys, kalman_core\n'
        "assert 'numba' not in sys.modules and 'numpy' not in sys.modules\n"
        'from kalman_core import chi2_gate\n'
        'chi2_gate(5, 1e-4)\n'
        "assert 'scipy' not in sys.modules and 'numba' not in sys.modules\n"
        'import kalman_core.linear, kalman_core.event_time, kalman_core.error_state\n'
        "assert 'scipy.special' not in sys.modules and 'scipy.stats' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
