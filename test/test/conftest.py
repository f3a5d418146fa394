# SPDX-License-Identifier: Apache-2.0
import os
import shutil
from pathlib import Path

import pytest
from workspace_harness.domain import own_domain


@pytest.fixture(scope='session', autouse=True)
def domain():
    with own_domain() as number:
        yield number


@pytest.fixture(scope='session')
def root():
    return Path(os.environ['WS_ROOT'])


@pytest.fixture(scope='session')
def bags(root):
    return root / 'bags'


@pytest.fixture
def program():
    """Return the path of a Debian program, or skip; CI installs them and must not skip."""

    def find(name):
        path = shutil.which(name)
        if path is None:
            assert 'WS_REQUIRE_PROGRAMS' not in os.environ, f'{name} is not installed'
            pytest.skip(f'{name} is not installed')
        return path

    return find
