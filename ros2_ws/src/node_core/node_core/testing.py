# SPDX-License-Identifier: Apache-2.0
"""What process-level tests need: node processes that never outlive the test, and a probe in their graph.

Nothing here sleeps: a test waits for a condition, with a limit that only a fault reaches.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python import get_package_prefix
from rclpy.node import Node
from rclpy.qos import QoSProfile

from node_core.executor import DirectExecutor
from node_core.message_types import message_class
from node_core.node import reliable

# Generous: the machine may be loaded and kernels may have to be compiled first.
TIMEOUT = 180.0  # s
_QUIET = 0.3  # s without a message, after the sender's last was acknowledged
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


def _die_with_parent() -> None:
    # The kernel kills the node when the test process ends in any way, a SIGKILL included.
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def executable(package: str, name: str) -> str:
    """Return the path of an installed executable."""
    path = Path(get_package_prefix(package)) / 'lib' / package / name
    if not path.exists():
        raise FileNotFoundError(f"no executable '{name}' in package '{package}' ({path})")
    return str(path)


def parameter_text(value: Any) -> str:
    """Return a parameter value as the YAML that rcl reads after ``name:=``."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return '[' + ', '.join(parameter_text(item) for item in value) + ']'
    if isinstance(value, float) and 'e' in repr(value) and '.' not in repr(value):
        return repr(value).replace('e', '.0e')  # YAML 1.1 takes 5e-06 for a string
    return str(value)


def ros_arguments(
    params: dict[str, Any] | None = None, remaps: dict[str, str] | None = None, name: str | None = None
) -> list[str]:
    """Return the --ros-args of parameters, remaps and a node name."""
    arguments = ['--ros-args']
    for key, value in (params or {}).items():
        arguments += ['-p', f'{key}:={parameter_text(value)}']
    for source, target in (remaps or {}).items():
        arguments += ['-r', f'{source}:={target}']
    if name:
        arguments += ['-r', f'__node:={name}']
    return arguments if len(arguments) > 1 else []


class Process:
    """A child process with its output in a file; `stop` asks politely, leaving the block does not."""

    def __init__(
        self, argv: Sequence[str], env: dict[str, str] | None = None, *, inherit_stderr: bool = False
    ) -> None:
        self.argv = list(argv)
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        self._process = subprocess.Popen(
            self.argv,
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            # A progress bar goes to the terminal, not into the file.
            stderr=None if inherit_stderr else subprocess.STDOUT,
            env={**os.environ, **(env or {})},
            preexec_fn=_die_with_parent,
        )
        self.pid = self._process.pid

    @classmethod
    def node(
        cls,
        package: str,
        executable_name: str,
        *args: str,
        env: dict[str, str] | None = None,
        inherit_stderr: bool = False,
        **ros: Any,
    ) -> Process:
        """Start an executable of a package; `ros` are the arguments of `ros_arguments`."""
        argv = [executable(package, executable_name), *args, *ros_arguments(**ros)]
        return cls(argv, env, inherit_stderr=inherit_stderr)

    @classmethod
    def script(cls, path: Path | str, *args: str, **ros: Any) -> Process:
        """Start a Python file as a node."""
        return cls([sys.executable, str(path), *args, *ros_arguments(**ros)])

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.kill()

    @property
    def output(self) -> str:
        """What the process has printed so far."""
        position = self._output.seek(0, os.SEEK_END)
        return os.pread(self._output.fileno(), position, 0).decode(errors='replace')

    @property
    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    def send(self, number: int) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Wait for the end; return the exit code."""
        return self._process.wait(timeout)

    def stop(self, timeout: float = TIMEOUT) -> int:
        """Send SIGINT, as Ctrl-C does, and return the exit code."""
        if self.running:
            self.send(signal.SIGINT)
        return self.wait(timeout)

    def kill(self) -> None:
        """End the process at once."""
        if self.running:
            self._process.kill()
        self._process.wait()
        self._output.close()


class Probe:
    """A node of the test itself, in a context of its own, that looks into and feeds the graph."""

    def __init__(self, name: str = 'probe') -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node(name, context=self.context, start_parameter_services=False, enable_rosout=False)
        self._collected: list[list[Any]] = []
        self._executor = DirectExecutor(context=self.context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def spin(self, seconds: float = 0.0) -> None:
        """Handle what has arrived, waiting at most `seconds` for the first."""
        self._executor.spin_once(timeout_sec=seconds)

    def until(
        self,
        condition: Callable[[], Any],
        what: str,
        timeout: float = TIMEOUT,
        process: Process | None = None,
    ) -> Any:
        """Spin until `condition` is true and return it; fail when `process` ends or time runs out."""
        end = time.monotonic() + timeout
        while True:
            result = condition()
            if result:
                return result
            if process is not None and not process.running:
                raise AssertionError(f'process ended while waiting for {what}:\n{process.output}')
            if time.monotonic() > end:
                said = f':\n{process.output}' if process is not None else ''
                raise AssertionError(f'gave up waiting for {what}{said}')
            self.spin(0.02)

    def collect(self, type_name: str, topic: str, qos: QoSProfile | None = None) -> list[Any]:
        """Subscribe; the returned list grows as messages arrive."""
        received: list[Any] = []
        cls = message_class(type_name)
        self.node.create_subscription(cls, topic, received.append, qos or reliable(10_000))
        self._collected.append(received)
        return received

    def until_over(self, process: Process) -> None:
        """Spin until `process` has ended and nothing that it had sent is left to be taken."""
        self.until(lambda: not process.running, 'the end of the process')
        taken, quiet_at = -1, 0.0
        while taken != sum(map(len, self._collected)) or time.monotonic() < quiet_at:
            if taken != sum(map(len, self._collected)):
                taken, quiet_at = sum(map(len, self._collected)), time.monotonic() + _QUIET
            self.spin(0.02)

    def publisher(
        self, type_name: str, topic: str, *, match: int = 1, qos: QoSProfile | None = None, process=None
    ) -> Any:
        """Return a publisher that `match` subscribers have found."""
        publisher = self.node.create_publisher(message_class(type_name), topic, qos or reliable(10_000))
        self.until(
            lambda: publisher.get_subscription_count() >= match, f"subscribers of '{topic}'", process=process
        )
        return publisher

    def wait_for_publisher(self, topic: str, process: Process | None = None) -> None:
        """Wait until somebody publishes `topic`."""
        resolved = self.node.resolve_topic_name(topic)
        self.until(lambda: self.node.count_publishers(resolved), f"a publisher of '{topic}'", process=process)

    def call(self, type_name: str, service: str, request: Any = None) -> Any:
        """Call a service and return its response."""
        cls = message_class(type_name)
        client = self.node.create_client(cls, service)
        self.until(client.service_is_ready, f"service '{service}'")
        future = client.call_async(request if request is not None else cls.Request())
        self.until(future.done, f"an answer of '{service}'")
        self.node.destroy_client(client)
        return future.result()

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Set one parameter of another node; return the SetParametersResult."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        response = self.call('rcl_interfaces/srv/SetParameters', f'{node}/set_parameters', request)
        return response.results[0]


@contextmanager
def probe(name: str = 'probe') -> Iterator[Probe]:
    """Yield a Probe and close it."""
    made = Probe(name)
    try:
        yield made
    finally:
        made.close()
