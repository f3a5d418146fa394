# SPDX-License-Identifier: Apache-2.0
"""Every row of the package's table: simulated, recorded, and through live processes."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from bag_tools.bench import Options, Row

sys.path.insert(0, str(Path(__file__).parent))

import imu_recorded
import imu_synthetic
from live import live_rows
from lockstep import lockstep_rows


def measure(options: Options) -> Iterable[Row]:
    """Measure the simulations, the recordings if they are there, and the live graph."""
    if options.still:
        yield from imu_synthetic.two_state_rows(options)
        yield from imu_synthetic.ship_rows(options)
        yield from imu_synthetic.honesty_rows(options)
        yield from imu_synthetic.fault_rows(options)
        yield from imu_recorded.recorded_rows(options)
    if options.live:
        yield from lockstep_rows(options)
        yield from live_rows(options)
