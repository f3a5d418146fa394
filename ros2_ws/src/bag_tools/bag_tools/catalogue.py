# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays: each package declares it as ``PKG.replays.REPLAYS`` and ``RECORDED``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Entry:
    """One estimator on one bag: `estimator` is its name in ``PKG.codec.ESTIMATORS``.

    `output` is the declared topic that is scored, `field` a path in it where the whole is not comparable.
    """

    label: str
    estimator: str
    output: str
    params: Mapping[str, Any] = field(default_factory=dict)
    field: str | None = None
    package: str | None = None


@dataclass(frozen=True, slots=True)
class Replay:
    """One bag through the live graph, with all its estimators at once.

    `bag` is a fixture's name in bags/. The outputs are scored against `truth` (a topic of the bag, or
    `truth_field` in it) from `after` (s) on and while the Bool topic `where` is true; `components` of the
    score stand in the table. `printed` holds the paper's own figures by component, in the score's unit,
    where it has them. `solve` names what the truth's device need not agree on (`bag_tools.align`).
    """

    bag: str
    title: str
    truth: str
    entries: tuple[Entry, ...]
    components: tuple[str, ...]
    truth_field: str | None = None
    where: str | None = None
    after: float = 0.0
    printed: Mapping[str, float] = field(default_factory=dict)
    solve: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Recorded:
    """Public recordings that are replayed where they are found.

    `pattern` is a glob below the folder of recordings, `importer` what ``bag_tools import`` is given;
    `replay` makes the replay of an imported bag. The graph gets the first `live_seconds` (s).
    """

    pattern: str
    importer: str
    replay: Callable[[Path], Replay]
    live_seconds: float
