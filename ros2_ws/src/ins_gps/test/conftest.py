# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import pytest


@pytest.fixture(scope='session')
def recordings():
    root = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ins'
    if not root.is_dir():
        pytest.skip(f'no recordings at {root} (set ESTIMATOR_DATA)')
    return root
