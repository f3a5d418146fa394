# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays: the fixtures that the packages declare, and recordings where they are found."""

from __future__ import annotations

import importlib
import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path

from bag_tools.catalogue import Entry, Replay
from bag_tools.import_data import import_data
from workspace_harness.make_bags import PACKAGES
from workspace_harness.replay import Estimator

# In lock-step every message waits for every node, so minutes of a fast sensor take minutes. By default the
# graph gets the beginning of a bag (s); the offline runner, which the table shows to be equal, the whole.
LIVE_SECONDS = 15.0


@dataclass(frozen=True)
class Job:
    """A replay with the bag it runs on; `live_seconds` 0 means the whole bag goes through the graph."""

    system: str
    replay: Replay
    bag: Path
    live_seconds: float = 0.0

    def estimators(self) -> list[Estimator]:
        """Return the nodes of the graph, one per entry."""
        return [
            Estimator(entry.package or self.system, entry.estimator, space(entry), dict(entry.params))
            for entry in self.replay.entries
        ]


def space(entry: Entry) -> str:
    """Return the name space of an entry: its label as a topic name."""
    return ''.join(c if c.isalnum() else '_' for c in entry.label.lower()).strip('_')


def fixtures(bags: Path, systems: list[str], live_seconds: float = 0.0) -> list[Job]:
    """Return the jobs on fixtures of the chosen systems."""
    jobs = []
    for system in systems:
        if importlib.util.find_spec(f'{system}.replays') is None:
            continue
        replays = importlib.import_module(f'{system}.replays').REPLAYS
        jobs += [Job(system, replay, bags / f'{replay.bag}.mcap', live_seconds) for replay in replays]
    return jobs


def recordings(systems: list[str], folder: Path, *, whole: bool = False) -> list[Job]:
    """Import the public recordings found below ESTIMATOR_DATA; return their jobs."""
    data = Path(os.environ['ESTIMATOR_DATA'])
    jobs = []
    for system in systems:
        if importlib.util.find_spec(f'{system}.replays') is None:
            continue
        for recorded in getattr(importlib.import_module(f'{system}.replays'), 'RECORDED', ()):
            for source in sorted(data.glob(recorded.pattern)):
                bag = folder / f'{source.stem}.mcap'
                if not bag.exists():
                    import_data(recorded.importer, source, bag)
                seconds = 0.0 if whole else recorded.live_seconds
                jobs.append(Job(system, recorded.replay(bag), bag, seconds))
    return jobs


def choose(names: list[str]) -> list[str]:
    """Return the systems to run, all by default; raise ValueError for an unknown one."""
    for name in names:
        if name not in PACKAGES:
            raise ValueError(f"no system '{name}'; known: {', '.join(PACKAGES)}")
    return names or list(PACKAGES)
