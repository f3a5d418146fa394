# SPDX-License-Identifier: Apache-2.0
"""Runs the commands of the documents, on fixtures, and keeps the outputs that the documents show.

A command is a line of a block fenced as ``sh`` (or without a language) or indented by four spaces. The lines
of one document run in order in one empty folder, in one ROS domain. A line that starts a node runs beside
all that follows in the document; every line has to end with exit code 0. A block fenced as
``text`` right after a block of commands is what these print::

    python -m workspace_harness.documents             # run all; name what fails
    python -m workspace_harness.documents --write     # and put the outputs in
"""

from __future__ import annotations

import argparse
import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from node_core.testing import Probe, Process, probe
from workspace_harness.domain import own_domain
from workspace_harness.make_bags import root

# What cannot run here, each with its reason. A pattern is searched in the command.
EXEMPT: Mapping[str, str] = {
    r'^\./ws (run|test|bench|lint|audit|docs|build|bags|lock|clean)\b': 'the workspace itself; CI runs them',
    r'^\./ws shell$': 'the test is such a shell',
    r'workspace_harness\.documents': 'the test itself',
    r'/opt/ros/jazzy': 'needs a ROS 2 Jazzy installation',
    r'^(sudo|apt|apt-get|rosdep|colcon) ': 'changes the machine, or needs a ROS 2 Jazzy installation',
    r'^ros2 bag ': 'needs rosbag2, which has no wheels',
    r'bag_tools sweep': 'needs the extra packages of ./ws sweep; test_sweep.py runs it',
    r'/dev/|mbpoll|can0|tcp://|ntrip://': 'needs a device or a program beside this workspace',
    r'\bBAG\b|calibration\.yaml': 'needs a recording of the sensor on all sides; the package tests it on one',
}
# What stands for the reader's own files, and the fixture that takes its place.
STAND_INS: Mapping[str, str] = {
    r'\byour_bag\b': 'bags/imu_hand_held.mcap',
    r'/your/imu\b': '/imu/data_raw',
    r'/your/truth\b': '/truth/orientation',
    r'\bmy_bag\b': 'bags/gnss_paper.mcap',
    # Another copy of a page may be open on the machine: any free port will do.
    r'(quad_control web_tuner|ship_inclinometer display)$': r'\1 --ros-args -p port:=0',
}
RECORDINGS = '../shared/data'
LIMIT = 600.0  # s, for one command; a first start compiles kernels, more than this only a fault takes
_FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(r'(?<=\n\n)((?: {4}\S.*\n)+)')
_FIRST_WORDS = (
    'ros2',
    './ws',
    'python',
    'source',
    'sudo',
    'colcon',
    'rosdep',
    'mbpoll',
    'export',
    'cat',
    'printf',
)
# How long it took depends on the machine; what came out does not.
_TIMING = re.compile(r'^[\d.]+ s for .*\n', re.MULTILINE)
_NUMBER = re.compile(r'[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?')


class CommandError(AssertionError):
    """A command of a document does not do what the document says; the message names both."""


@dataclass(frozen=True, slots=True)
class Block:
    """Commands of a document, from `begin` to `end` in its text, and where the output they show stands."""

    commands: tuple[str, ...]
    line: int
    output: tuple[int, int] | None = None


def documents() -> list[Path]:
    """Return every document of the workspace that may hold commands."""
    top = root()
    found = [top / 'README.md', top / 'CONTRIBUTING.md', *top.glob('docs/*.md')]
    return sorted({*found, *top.glob('ros2_ws/src/*/README.md'), *top.glob('ros2_ws/src/*/doc*/*.md')})


def _lines(body: str) -> tuple[str, ...]:
    """Return the commands of a block without comments; ``a & b &`` are two."""
    joined = re.sub(r'\\\n\s*', '', body)
    commands = []
    for line in joined.splitlines():
        # A here-document would be cut apart: documents write files by printf.
        plain = re.sub(r'(^|\s)#\s.*$', '', line).strip()
        commands += [part.strip() for part in re.split(r'\s&(?:\s|$)', plain) if part.strip()]
    return tuple(commands)


def blocks(text: str) -> list[Block]:
    """Return the blocks of commands of a document, in order."""
    fences = list(_FENCE.finditer(text))
    found = []
    for i, fence in enumerate(fences):
        words = fence[2].split(maxsplit=1)
        if fence[1] not in ('sh', 'bash', '') or not words or words[0] not in _FIRST_WORDS:
            continue
        after = fences[i + 1] if i + 1 < len(fences) else None
        shows = after is not None and after[1] == 'text' and not text[fence.end() : after.start()].strip()
        found.append(
            Block(_lines(fence[2]), text.count('\n', 0, fence.start()) + 1, after.span(2) if shows else None)
        )
    inside = [fence.span() for fence in fences]
    for match in _INDENTED.finditer(text):
        if any(begin <= match.start() < end for begin, end in inside):
            continue
        if match[1].split(maxsplit=1)[0] in _FIRST_WORDS:
            found.append(Block(_lines(match[1]), text.count('\n', 0, match.start()) + 1))
    return sorted(found, key=lambda block: block.line)


def exemption(command: str) -> str | None:
    """Return why `command` is not run here, or None."""
    if RECORDINGS in command and not Path(os.environ.get('ESTIMATOR_DATA', '')).is_dir():
        return 'needs the recordings of ESTIMATOR_DATA'
    return next((reason for pattern, reason in EXEMPT.items() if re.search(pattern, command)), None)


def prepared(command: str) -> str:
    """Return `command` with fixtures in place of the reader's own files, and made to end by itself."""
    for pattern, fixture in STAND_INS.items():
        command = re.sub(pattern, fixture, command)
    command = command.replace(RECORDINGS, os.environ.get('ESTIMATOR_DATA', RECORDINGS))
    if command.startswith('ros2 topic echo') and '--once' not in command:
        command += ' --once'
    return command


def stays(command: str) -> bool:
    """Return whether `command` runs until it is stopped."""
    words = shlex.split(command)
    if words[:2] == ['ros2', 'topic'] and words[2:3] == ['hz']:
        return True
    if words[:2] != ['ros2', 'run'] or len(words) < 4:
        return False
    package, name = words[2:4]
    if (package, name) in (('node_core', 'compose'), ('workspace_harness', 'system')):
        return True
    if package == 'bag_tools':
        ends = ('--count', '--idle', '--duration', '--help')
        return (
            (name == 'record' and not any(word in words for word in ends))
            or '--loop' in words
            or (name == 'play' and '--start-paused' in words)
        )
    module = root() / 'ros2_ws' / 'src' / package / package / 'nodes' / f'{name}.py'
    return module.exists() and 'def build(' in module.read_text(encoding='utf-8')


@dataclass
class Runner:
    """Runs the blocks of one document in one folder; `ran` counts, `skipped` holds (command, reason)."""

    folder: Path
    ran: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    done: set[str] = field(default_factory=set)
    nodes: list[Process] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ('bags', 'ws', 'tools', 'docs'):
            (self.folder / name).symlink_to(root() / name)
        (self.folder / 'out').mkdir()

    def run(self, block: Block) -> str:
        """Run a block and return what its commands printed; raise CommandError."""
        printed = []
        for command in block.commands:
            reason = exemption(command)
            if reason is not None:
                self.skipped.append((command, reason))
            elif stays(prepared(command)):
                self.nodes.append(self._start(command))
            else:
                printed.append(self._finish(command))
            self.done.add(command)
        return ''.join(printed)

    def close(self) -> Iterator[str]:
        """Stop all nodes; yield what is wrong with any."""
        try:
            with probe('documents') as eye:
                for node in self.nodes:
                    problem = self._stop(node, eye)
                    if problem:
                        yield problem
        finally:
            for node in self.nodes:
                node.kill()
            self.nodes.clear()

    def _start(self, command: str) -> Process:
        self.ran += 1
        here = f'cd {shlex.quote(str(self.folder))} && exec {prepared(command)}'
        return Process(['bash', '-c', here])

    def _finish(self, command: str) -> str:
        self.ran += 1
        try:
            done = subprocess.run(
                ['bash', '-c', prepared(command)],
                cwd=self.folder,
                capture_output=True,
                text=True,
                timeout=LIMIT,
                stdin=subprocess.DEVNULL,
                check=False,
            )
        except subprocess.TimeoutExpired:
            said = ''.join(node.output for node in self.nodes)
            raise CommandError(f'{command}\nis not done within {LIMIT:g} s\n{said}') from None
        if done.returncode:
            raise CommandError(f'{command}\nended with {done.returncode}:\n{done.stdout}{done.stderr}')
        return _TIMING.sub('', done.stdout)

    def _stop(self, node: Process, eye: Probe) -> str | None:
        command = node.argv[-1].partition('&& exec ')[2]
        try:
            # Until a node is up, Ctrl-C would prove nothing.
            eye.until(lambda: _is_up(eye, command), f'a node of: {command}', process=node)
            code = node.stop(LIMIT)
        except AssertionError as error:
            return str(error)
        # `ros2 topic` of a real Jazzy ends with the number of the signal.
        if code not in ((0, 2) if command.startswith('ros2 topic') else (0,)) or 'Traceback' in node.output:
            return f'{command}\nended with {code}:\n{node.output}'
        return None


def _is_up(eye: Probe, command: str) -> bool:
    words = shlex.split(command)
    names = set(eye.node.get_node_names())
    if words[1] == 'topic':
        return any(name.startswith('_ros2') for name in names)
    wanted = {'play': 'player', 'record': 'recorder'}.get(words[3], words[3])
    if wanted in ('compose', 'system'):
        return len(names) > 1
    return wanted in names


def same_text(shown: str, printed: str, tolerance: float = 0.01) -> bool:
    """Return whether two outputs agree: the same words, numbers within 1 % (or 0.01 around zero)."""
    if _NUMBER.sub('#', shown).split() != _NUMBER.sub('#', printed).split():
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return all(math.isclose(float(a), float(b), rel_tol=tolerance, abs_tol=tolerance) for a, b in pairs)


def check(path: Path, runner: Runner, *, write: bool = False) -> Iterator[str]:
    """Run all blocks of a document and yield what is wrong; with `write` put in the outputs shown.

    All of it has to be taken from the iterator: the nodes are stopped at its end.
    """
    text = path.read_text(encoding='utf-8')
    changes = []
    for block in blocks(text):
        if block.output is None and set(block.commands) <= runner.done:
            continue
        try:
            printed = runner.run(block)
        except AssertionError as error:
            yield f'{path.name}:{block.line}: {error}'
            continue
        if block.output is not None:
            begin, end = block.output
            if not same_text(text[begin:end], printed):
                changes.append((begin, end, printed))
                if not write:
                    yield f'{path.name}:{block.line}: shows\n{text[begin:end]}but prints\n{printed}'
    yield from (f'{path.name}: {problem}' for problem in runner.close())
    if write and changes:
        for begin, end, printed in reversed(changes):
            text = text[:begin] + printed + text[end:]
        path.write_text(text, encoding='utf-8')


def main() -> int:
    """Run the documents named, or all; 1 when a command fails."""
    parser = argparse.ArgumentParser(prog='documents', description='Run the commands of the documents.')
    parser.add_argument('documents', nargs='*', type=Path)
    parser.add_argument('--write', action='store_true', help='put the outputs in')
    o = parser.parse_args()
    wrong = 0
    for path in [p.resolve() for p in o.documents] or documents():
        with own_domain(), tempfile.TemporaryDirectory() as folder:
            runner = Runner(Path(folder))
            for problem in check(path, runner, write=o.write):
                wrong += 1
                print(problem)
        print(f'{path.relative_to(root())}: {runner.ran} commands, {len(runner.skipped)} not run here')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
