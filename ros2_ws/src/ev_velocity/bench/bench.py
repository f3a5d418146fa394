# SPDX-License-Identifier: Apache-2.0
"""Every row of the package's table, measured; the paper's fusion runs on the same drives in the same run."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from bag_tools.bench import Options, Row

sys.path.insert(0, str(Path(__file__).parent))

import live
import recorded
import synthetic


def measure(options: Options) -> Iterable[Row]:
    """Measure the simulated drives, the recordings if they are there, and the live nodes."""
    yield from synthetic.rows(options)
    yield from recorded.rows(options)
    yield from live.rows(options)
