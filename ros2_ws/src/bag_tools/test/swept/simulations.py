# SPDX-License-Identifier: Apache-2.0
"""Simulations for sweeps; one of them ends the worker that runs it, once."""

import os
import signal
from pathlib import Path

from bag_samples import write_sensors

MARKER = 'SWEPT_MARKER'
DEADLY_SEED = 3


def sensors(seed, path):
    write_sensors(path, seconds=0.5, seed=seed)


def deadly(seed, path):
    marker = Path(os.environ[MARKER])
    if seed == DEADLY_SEED and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    sensors(seed, path)
