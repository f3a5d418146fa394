# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import pytest

# colcon gives every package a domain of its own; a bare pytest run must not meet other graphs either.
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
os.environ.setdefault('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')


@pytest.fixture
def recordings():
    """Return the folder of real recordings, or skip."""
    folder = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data'))
    if not folder.is_dir():
        pytest.skip(f'no recordings: ESTIMATOR_DATA={folder} is not a folder')
    return folder
