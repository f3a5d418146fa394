# SPDX-License-Identifier: Apache-2.0
"""Runs fault cases and writes the table of what was stated and what was seen.

``python -m faults.campaign [WORD …]`` in ``./ws shell`` runs the cases whose name holds every WORD;
``./ws bench faults`` runs all of them and writes docs/results/faults.md.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from workspace_harness.domain import own_domain

from bag_tools.bag import BagError
from faults.cases import Case, cases

TABLE = Path('docs', 'results', 'faults.md')
_HEAD = """# Faults put into the live graphs

Written by `./ws bench faults`. Each case starts the nodes of one system as processes, feeds them with the
system's fixture, breaks something and checks the stated result. *Back* means: within the tolerance of a run
without any fault, and staying there; counted in outputs of the estimator from the end of the fault.
"""


@dataclass(frozen=True)
class Outcome:
    """Whether a case held, and what was seen or why it did not."""

    case: Case
    held: bool
    seen: str


def run_case(case: Case) -> Outcome:
    """Run one case in a ROS domain and a folder of its own."""
    with tempfile.TemporaryDirectory() as folder, own_domain():
        try:
            return Outcome(case, True, case.run(Path(folder)))
        except (AssertionError, BagError, OSError) as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            text = str(error) or f'{Path(where.filename).name}: {where.line}'
            return Outcome(case, False, text)


def run_all(chosen: Iterable[Case], say: Callable[[str], None] = print) -> list[Outcome]:
    """Run cases one after the other and say each result."""
    outcomes = []
    for case in chosen:
        outcome = run_case(case)
        say(f'{"held  " if outcome.held else "BROKEN"} {case.system}: {case.fault}: {outcome.seen}')
        outcomes.append(outcome)
    return outcomes


def table(outcomes: list[Outcome]) -> str:
    """Return the table as Markdown, one section per system."""
    held = sum(o.held for o in outcomes)
    lines = [_HEAD, f'{held} of {len(outcomes)} cases held.']
    for system in dict.fromkeys(o.case.system for o in outcomes):
        lines += ['', f'## {system}', '', '| fault | stated | held | seen |', '|---|---|---|---|']
        for o in outcomes:
            if o.case.system == system:
                seen = ' '.join(o.seen.split()).replace('|', '\\|')
                lines.append(f'| {o.case.fault} | {o.case.stated} | {"yes" if o.held else "NO"} | {seen} |')
    return '\n'.join(lines) + '\n'


def main() -> int:
    """Entry point."""
    words = sys.argv[1:]
    chosen = [c for c in cases() if all(w in c.name for w in words)]
    if not chosen:
        print(f'faults: no case holds {" ".join(words)}', file=sys.stderr)
        return 2
    outcomes = run_all(chosen, lambda text: print(text, flush=True))
    held = sum(o.held for o in outcomes)
    print(f'{held} of {len(outcomes)} cases held')
    return 0 if held == len(outcomes) else 1


if __name__ == '__main__':
    sys.exit(main())
