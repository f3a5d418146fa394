# SPDX-License-Identifier: Apache-2.0
"""Every row of the package's table, measured; the paper's fusion runs on the same drives in the same run."""

from __future__ import annotations

from collections.abc import Iterable

import ev_live
import ev_recorded
import ev_synthetic

from bag_tools.bench import Options, Row


def measure(options: Options) -> Iterable[Row]:
    """Measure the simulated drives, the recordings if they are there, and the live nodes."""
    if options.still:
        yield from ev_synthetic.rows(options)
        yield from ev_recorded.rows(options)
    if options.live:
        yield from ev_live.rows(options)
