# SPDX-License-Identifier: Apache-2.0
"""The faults: each function breaks a live graph of one system and checks what is stated about it.

A function returns what was seen, for the table; it fails by AssertionError.
"""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from faults.checks import Listener, back_after, farthest, stamps_between, values
from faults.graph import Graph
from faults.relay import CORRUPTIONS
from faults.systems import (
    IMU_TOPIC,
    SYSTEMS,
    NodeSpec,
    System,
    imu_count,
    index_at,
    offline_outputs,
    recorded,
)
from node_core.messages import NANOSECONDS
from node_core.testing import Process, parameter_text, probe

# More than twice what a queue holds (node_core.node.NodeParams.queue_depth).
_BURST = 600  # messages
_PARAMETER_EVERY = 20  # messages
# A few hundred messages fill this, and no less than the head of a bag goes in before.
_DISK = 20_000  # bytes
_GARBAGE = ('no_such_parameter', 'queue_depth')


@dataclass(frozen=True)
class Case:
    """One fault in one system. `stated` is what must hold; `run` returns what was seen."""

    system: str
    fault: str
    stated: str
    run: Callable[[Path], str]

    @property
    def name(self) -> str:
        """System and fault, as one word each."""
        return f'{self.system}-{self.fault.replace(" ", "_")}'


Run = Callable[[System, Path], str]
_FAULTS: list[tuple[str, str, Run]] = []


def fault(name: str, stated: str) -> Callable[[Run], Run]:
    """Register a fault that every system is put to."""

    def register(run: Run) -> Run:
        _FAULTS.append((name, stated, run))
        return run

    return register


def _times(system: System) -> tuple[float, float, float]:
    """Return when the fault begins, ends, and the estimator has to be back (s of the bag)."""
    return system.warm, system.warm + system.fault, system.warm + system.fault + system.recovery


# --- processes ----------------------------------------------------------------------------------------


def _kill(system: System, node: NodeSpec) -> str:
    warm, end, back = _times(system)
    with probe() as p, Graph(system, p) as graph:
        graph.feed(warm)
        graph.kill(node.name)
        graph.feed(end)
        first = graph.position
        graph.start(node.name)
        graph.wait_until_linked()
        before = dict(graph.outputs)
        graph.feed(back)
        count = back_after(graph, end, back)
        graph.stop()
    if node != system.main:
        assert graph.outputs == offline_outputs(system, 0, graph.position)
        return 'the estimator answers as if nothing had happened, to the last bit'
    fresh = {s: v for s, v in graph.outputs.items() if s not in before}
    assert fresh == offline_outputs(system, first, graph.position)
    return f'back after {count} outputs; equal to a fresh offline run from there to the last bit'


@fault('stop and continue', 'takes up again; back within tolerance')
def _stop_and_continue(system: System, _folder: Path) -> str:
    warm, end, back = _times(system)
    with probe() as p, Graph(system, p, lockstep=False) as graph:
        graph.feed(warm)
        main = graph.processes[system.main.name]
        main.send(signal.SIGSTOP)
        graph.stopped = system.main.name
        graph.feed(end)
        graph.stopped = ''
        main.send(signal.SIGCONT)
        # A player that went on at once, faster than any sensor, would fill the queue behind a message that
        # the network lost while nobody read, until that is sent again.
        newest = stamps_between(system.name, warm, end)[-1]
        p.until(lambda: newest in graph.outputs, 'the newest output', process=main)
        graph.feed(back)
        count = back_after(graph, end, back)
        graph.stop()
    return f'back after {count} outputs'


@fault('duplicate node name', 'the first node misses no message; the leaving of the second disturbs nobody')
def _duplicate_name(system: System, _folder: Path) -> str:
    warm, end, back = _times(system)
    with probe() as p, Graph(system, p, lockstep=False) as graph:
        graph.feed(warm)
        with graph.twin(system.main.name) as twin:
            before, first = graph.heard, graph.position
            graph.feed(end)
            sent = imu_count(system.name, first, graph.position)
            p.until(lambda: graph.heard - before >= sent, 'an output per message', process=twin)
            twin.send(signal.SIGKILL)
            twin.wait()
        graph.feed(back)
        count = back_after(graph, end, back)
        graph.stop()
    return f'{sent} messages answered at least once; back after {count} outputs'


# --- a topic in trouble -------------------------------------------------------------------------------


def _relayed(name: str, system: System, check: Callable[[Graph, Listener], str]) -> str:
    warm, end, back = _times(system)
    first, last = (imu_count(system.name, 0, index_at(system.name, s)) for s in (warm, end))
    with probe() as p:
        listener = Listener(p)
        with Graph(system, p, relay=(name, first, last)) as graph:
            graph.feed(end)
            seen = check(graph, listener)
            graph.feed(back)
            count = back_after(graph, end, back)
            graph.stop()
    return f'{seen}back after {count} outputs'


def _nothing(_graph: Graph, _listener: Listener) -> str:
    return ''


for _name, _stated in (
    ('drop', '30 % of the IMU lost'),
    ('delay', 'IMU 20 messages late'),
    ('duplicate', 'every IMU message twice'),
    ('reorder', 'blocks of 5 IMU messages shuffled'),
):

    def _lossy(system: System, _folder: Path, name: str = _name) -> str:
        return _relayed(name, system, _nothing)

    _FAULTS.append((f'{_name} ({_stated})', 'nothing but finite outputs; back within tolerance', _lossy))


@fault('silent sensor', 'declared stale on /diagnostics; back within tolerance')
def _silent(system: System, _folder: Path) -> str:
    def stale(graph: Graph, listener: Listener) -> str:
        status = listener.wait(
            f'{system.main.name}: {IMU_TOPIC[1:]}',
            lambda s: s.level == DiagnosticStatus.ERROR and 'stale' in s.message,
            'a stale sensor',
        )
        return f'{status.message.split(":")[0]}; '

    return _relayed('silence', system, stale)


for _name in CORRUPTIONS:

    def _corrupt(system: System, _folder: Path, name: str = _name) -> str:
        def named(_graph: Graph, listener: Listener) -> str:
            if name == 'zero_force' and system.one_axis:
                return 'a reading like any other; '
            return f"'{listener.rejections(system.main.name, IMU_TOPIC[1:])}'; "

        return _relayed(name, system, named)

    _FAULTS.append(
        (
            f'one IMU message in three {_name.replace("_", " ")}',
            'rejected with a reason on /diagnostics, nothing but finite outputs; back within tolerance',
            _corrupt,
        )
    )


# --- clock --------------------------------------------------------------------------------------------


@fault('clock and bag jump back', 'restart declared on /diagnostics; back within tolerance')
def _clock_back(system: System, _folder: Path) -> str:
    _, end, back = _times(system)
    with probe() as p:
        listener = Listener(p)
        with Graph(system, p, sim_time=True) as graph:
            graph.tick(0.0)
            graph.feed(end)
            graph.tick(end)
            graph.tick(0.0)
            graph.position = 0
            graph.outputs.clear()
            graph.feed(back)
            count = back_after(graph, 0.0, back)
            status = listener.wait(
                system.main.name, lambda s: values(s).get('restarts', '0') != '0', 'a restart'
            )
            reason = values(status)['last_restart']
            assert 'back' in reason, reason
            graph.stop()
    return f"'{reason}'; back after {count} outputs"


@fault('clock and bag leap ahead', 'back within tolerance')
def _clock_ahead(system: System, _folder: Path) -> str:
    warm, _, _ = _times(system)
    leap = warm + 2.0 * system.fault
    back = leap + system.recovery
    with probe() as p, Graph(system, p, sim_time=True) as graph:
        graph.tick(0.0)
        graph.feed(warm)
        graph.skip(leap)
        graph.tick(leap)
        graph.feed(back)
        count = back_after(graph, leap, back)
        graph.stop()
    return f'back after {count} outputs'


# --- load ---------------------------------------------------------------------------------------------


@fault('burst', f'{_BURST} messages at once: nobody ends; back within tolerance')
def _burst(system: System, _folder: Path) -> str:
    warm = system.warm
    rows = recorded(system.name).messages
    with probe() as p, Graph(system, p, lockstep=False) as graph:
        graph.feed(warm)
        graph.burst(_BURST)
        end = (rows[graph.position][1] - rows[0][1]) / NANOSECONDS
        back = end + system.recovery
        graph.feed(back)
        count = back_after(graph, end, back)
        graph.stop()
    return f'back after {count} outputs'


@fault('parameters changed under load', 'bad values and fixed parameters refused by name; no message missed')
def _parameters(system: System, _folder: Path) -> str:
    warm, end, _ = _times(system)
    node, name, good, bad = system.live
    accepted: list[bool] = []
    with probe() as p, Graph(system, p) as graph:
        graph.feed(warm)

        def change(number: int) -> None:
            if number % _PARAMETER_EVERY:
                return
            result = p.set_parameter(graph.full(node), name, good)
            accepted.append(result.successful)
            assert result.successful or name in result.reason, result.reason
            refused = p.set_parameter(graph.full(node), name, bad)
            assert not refused.successful
            assert name in refused.reason, refused.reason

        graph.feed_rows(index_at(system.name, end), change)
        count = back_after(graph, warm, end)
        apart = farthest(graph, warm, end)
        graph.stop()
    assert accepted, 'no parameter was changed'
    assert len(set(accepted)) == 1
    expected = offline_outputs(system, 0, graph.position)
    assert set(graph.outputs) == set(expected)
    if not accepted[0]:
        assert graph.outputs == expected
        return f'{len(accepted)} changes refused (fixed); outputs the same to the last bit'
    assert count == 0
    return f'{len(accepted)} changes; at most {apart:.2g} {system.unit} from the undisturbed run'


# --- peers --------------------------------------------------------------------------------------------


@fault('best-effort peers of depth 1', 'publishers are heard, listeners served; back within tolerance')
def _wrong_qos(system: System, _folder: Path) -> str:
    poor = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    _, _, back = _times(system)
    with probe() as p:
        heard = p.collect(system.output_type, system.output, poor)
        p.collect(system.output_type, system.output, latched)
        with Graph(system, p, lockstep=False, qos=poor) as graph:
            graph.feed(back)
            count = back_after(graph, 0.0, back)
            p.until(lambda: heard, 'an output at the best-effort listener')
            graph.stop()
    return f'{len(heard)} outputs at the best-effort listener; back after {count} outputs'


@fault('a peer of another type on the same topic', 'ignored; outputs the same to the last bit')
def _other_type(system: System, _folder: Path) -> str:
    warm, end, _ = _times(system)
    with probe('stranger') as stranger, probe() as p:
        publisher = stranger.publisher('std_msgs/msg/String', IMU_TOPIC, match=0)
        with Graph(system, p) as graph:

            def talk(_number: int) -> None:
                from std_msgs.msg import String

                publisher.publish(String(data='no Imu'))

            graph.feed(warm)
            graph.feed_rows(index_at(system.name, end), talk)
            graph.stop()
    assert graph.outputs == offline_outputs(system, 0, graph.position)
    return f'{len(graph.outputs)} outputs equal to the offline runner'


@fault('two graphs in one domain', 'each equals its own offline run to the last bit')
def _two_graphs(system: System, _folder: Path) -> str:
    _, end, _ = _times(system)
    late = index_at(system.name, system.fault)
    last = index_at(system.name, end)
    with probe() as p, Graph(system, p, namespace='one') as one, Graph(system, p, namespace='two') as two:
        two.position = late
        one.wait_until_linked()
        while two.position < last:
            one.feed_rows(one.position + 1)
            two.feed_rows(two.position + 1)
        one.stop()
        two.stop()
    assert one.outputs == offline_outputs(system, 0, one.position)
    assert two.outputs == offline_outputs(system, late, two.position)
    return f'{len(one.outputs)} and {len(two.outputs)} outputs'


# --- disk and start -----------------------------------------------------------------------------------


@fault(
    'disk full while recording',
    'the recorder says so and where it was in one line, code 2; nothing looks whole; others go on',
)
def _disk_full(system: System, folder: Path) -> str:
    warm, end, _ = _times(system)
    out = folder / 'out.mcap'
    with probe() as p, Graph(system, p) as graph:
        topics = [graph.full(system.output), *recorded(system.name).types]
        with Process.node('bag_tools', 'record', str(out), *topics) as recorder:
            p.until(lambda: 'recording' in recorder.output, 'the recorder', process=recorder)
            resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (_DISK, _DISK))
            graph.feed(warm)
            if recorder.running:  # a chunk that is not full is written at the end
                recorder.send(signal.SIGINT)
            code = recorder.wait()
            said = recorder.output.strip().splitlines()
        graph.feed(end)
        graph.stop()
    assert code == 2, f'code {code}: {said}'
    assert 'Traceback' not in '\n'.join(said), '\n'.join(said)
    # What reached the disk stays, under the name of an unfinished recording.
    whole = [f.name for f in folder.iterdir() if f.suffix != '.partial']
    assert not whole, f'looks whole: {whole}'
    assert graph.outputs == offline_outputs(system, 0, graph.position)
    text, _, kept = said[-1].removeprefix('record: ').replace(f'{folder}/', '').partition(';')
    assert any(f.name in kept for f in folder.iterdir()), said[-1]
    return f"'{text}', and where the rest is"


@fault('garbage parameters at the start', 'one line that names the parameter, code 2')
def _garbage(system: System, _folder: Path) -> str:
    for node in system.nodes:
        for name, value in zip(_GARBAGE, (1.0, 'abc')):
            params: dict[str, Any] = {name: value}
            with Process.node(node.package, node.executable, params=params) as process:
                assert process.wait() == 2, process.output
                last = process.output.splitlines()[-1]
                assert name in last, process.output
                assert 'Traceback' not in process.output
    return f'{len(system.nodes)} nodes, {len(_GARBAGE)} parameters each ({parameter_text("abc")})'


# --- the list -----------------------------------------------------------------------------------------


def cases() -> list[Case]:
    """Return every fault × system case, system by system."""
    found = []
    for system in SYSTEMS.values():
        for node in system.nodes:
            stated = (
                'a fresh start: equal to an offline run from there, to the last bit; back within tolerance'
                if node == system.main
                else 'the estimator goes on as if nothing had happened, to the last bit'
            )
            found.append(
                Case(
                    system.name,
                    f'kill -9 and restart {node.name}',
                    stated,
                    lambda _folder, s=system, n=node: _kill(s, n),
                )
            )
        for name, stated, run in _FAULTS:
            found.append(Case(system.name, name, stated, lambda folder, s=system, r=run: r(s, folder)))
    return found


# In the tests: the faults that differ most in what they touch, in the systems that start fastest.
SHORT_SYSTEMS = ('imu_kalman', 'quad_control')
SHORT = (
    'kill -9 and restart',
    'one IMU message in three nan',
    'stop and continue',
)


def short_cases() -> list[Case]:
    """Return the cases of the tests: the estimator killed, corrupted and stopped."""
    chosen = []
    for case in cases():
        main = SYSTEMS[case.system].main.name
        if case.system in SHORT_SYSTEMS and case.fault in (f'{SHORT[0]} {main}', *SHORT[1:]):
            chosen.append(case)
    return chosen
