# SPDX-License-Identifier: Apache-2.0
"""`./ws mutation [MODULE …]`: changes kalman_core in one small place at a time; do its tests notice?

mutmut and cosmic-ray run each mutant in the tested process tree with the compiler on, where numba's cache
hides changes of a kernel from its callers. Here each mutant is a copy of the package, tested with
NUMBA_DISABLE_JIT=1 by the module's own test file. The sample is drawn by a seed, so two runs agree. Exit code
1 below the bar. The figure of a run over all modules is kept in docs/results/bench.json.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bag_tools.bench import Row, keep

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 'ros2_ws' / 'src' / 'kalman_core'
MODULES = (
    'consistency',
    'earth',
    'error_state',
    'event_time',
    'gates',
    'health',
    'linear',
    'noise',
    'parameters',
    'rotation',
    'smoother',
)
BAR = 85.0  # %
_SAMPLE = 10  # mutants per module
# A mutant that loops for ever is noticed too.
_LIMIT = 600.0  # s
_SWAPS: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}


@dataclass(frozen=True)
class Mutant:
    """A changed source, the line of the change and what it was."""

    source: str
    line: int
    text: str


def _sites(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes that can be changed; docstrings, annotations and defaults of names are none."""
    skipped = set()
    for node in ast.walk(tree):
        for name in ('annotation', 'returns'):
            if (part := getattr(node, name, None)) is not None:
                skipped |= {id(n) for n in ast.walk(part)}
        if isinstance(node, ast.FunctionDef):
            skipped |= {id(n) for d in node.decorator_list for n in ast.walk(d)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        swaps = isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in _SWAPS
        compares = isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPS
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float, bool)
        negates = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not)
        if swaps or compares or number or negates:
            yield node


def _change(node: ast.AST) -> None:
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        node.op = _SWAPS[type(node.op)]()
    elif isinstance(node, ast.Compare):
        node.ops[0] = _SWAPS[type(node.ops[0])]()
    elif isinstance(node, ast.Constant):
        node.value = not node.value if isinstance(node.value, bool) else node.value + 1
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)


def mutants(source: str) -> list[Mutant]:
    """Return every mutant of `source`: one operator, comparison, number or sign changed in each."""
    tree = ast.parse(source)
    found = []
    for index, node in enumerate(list(_sites(tree))):
        changed = copy.deepcopy(tree)
        target = list(_sites(changed))[index]
        before = ast.unparse(target)
        _change(target)
        ast.fix_missing_locations(changed)
        found.append(Mutant(ast.unparse(changed), node.lineno, f'{before} -> {ast.unparse(target)}'))
    return found


def _passes(folder: Path, module: str) -> bool:
    """Return whether the module's tests pass on the copy of the package in `folder`."""
    environment = {
        **os.environ,
        'NUMBA_DISABLE_JIT': '1',
        'PYTHONPATH': os.pathsep.join([str(folder), os.environ.get('PYTHONPATH', '')]),
        'PYTHONDONTWRITEBYTECODE': '1',
    }
    command = [sys.executable, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider']
    try:
        done = subprocess.run(
            [*command, str(PACKAGE / 'test' / f'test_{module}.py')],
            cwd=folder,
            env=environment,
            capture_output=True,
            timeout=_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def measure(module: str, sample: int, seed: int) -> tuple[int, list[Mutant]]:
    """Return (mutants tried, those that no test noticed) of one module."""
    path = PACKAGE / 'kalman_core' / f'{module}.py'
    every = mutants(path.read_text(encoding='utf-8'))
    chosen = random.Random(seed).sample(every, min(sample, len(every)))
    survivors = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copied = folder / 'kalman_core'
        shutil.copytree(path.parent, copied, ignore=shutil.ignore_patterns('__pycache__'))
        if not _passes(folder, module):
            raise SystemExit(f'{module}: its tests fail without any change')
        for mutant in chosen:
            (copied / path.name).write_text(mutant.source, encoding='utf-8')
            if _passes(folder, module):
                survivors.append(mutant)
                print(f'  {module}.py:{mutant.line}: nobody notices {mutant.text}', flush=True)
    return len(chosen), survivors


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog='./ws mutation', description='Do the tests notice small changes?')
    parser.add_argument('modules', nargs='*', help=f'modules of kalman_core, default: {" ".join(MODULES)}')
    parser.add_argument('--sample', type=int, default=_SAMPLE, help='mutants per module')
    parser.add_argument('--seed', type=int, default=0, help='of the sample')
    asked = parser.parse_args()
    if unknown := set(asked.modules) - set(MODULES):
        parser.error(f"no module '{min(unknown)}'; known: {', '.join(MODULES)}")
    tried = alive = 0
    started = time.monotonic()
    for module in asked.modules or MODULES:
        count, survivors = measure(module, asked.sample, asked.seed)
        tried, alive = tried + count, alive + len(survivors)
        print(f'{module}: {count - len(survivors)} of {count} killed', flush=True)
    killed = 100.0 * (tried - alive) / max(tried, 1)
    print(f'{tried - alive} of {tried} mutants killed: {killed:.1f} %')
    if not asked.modules:
        row = Row(
            PACKAGE.name,
            'mutants of a random sample killed by the tests',
            killed,
            '%',
            bar=BAR,
            better='higher',
            reference={'mutants': float(tried)},
        )
        keep([row], time.monotonic() - started)
    return 0 if killed >= BAR else 1


if __name__ == '__main__':
    sys.exit(main())
