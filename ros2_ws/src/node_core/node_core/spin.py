# SPDX-License-Identifier: Apache-2.0
"""Runs a node as a process: arguments, clean exit on Ctrl-C, one clear line for bad parameters."""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

_ROS_FLAGS = ('-p', '--param', '-r', '--remap', '--params-file')
EXIT_USAGE = 2


def ros_arguments(argv: list[str]) -> list[str]:
    """Return `argv` with ``--ros-args`` put before the first ROS flag where the user left it out."""
    if '--ros-args' in argv:
        return argv
    for index, argument in enumerate(argv):
        if argument in _ROS_FLAGS:
            return [*argv[:index], '--ros-args', *argv[index:]]
    return argv


def fail(message: str) -> int:
    """Print one line for a usage error and return the exit code for it."""
    print(f'{Path(sys.argv[0]).name}: {message}', file=sys.stderr)
    return EXIT_USAGE


def missing_params_file(argv: list[str]) -> str | None:
    """Return the first parameter file in `argv` that cannot be opened."""
    named = (value for flag, value in pairwise(argv) if flag == '--params-file')
    return next((value for value in named if not os.access(value, os.R_OK)), None)


class Interrupt:
    """The handler of Ctrl-C in a process with a ROS context; install it before ``rclpy.init``.

    rclpy's handler calls it, then ends the context. An exception raised here comes up wherever the process
    is, also within rclpy's C++, which makes another one of it and loses the message it was converting. So
    once the process watches its context, as executors do, set `watched`: only a second Ctrl-C raises then.
    """

    def __init__(self) -> None:
        self.received, self.watched = False, False
        self.leave: list[Callable[[], Any]] = []

    def __call__(self, _number: int, _frame: Any) -> None:
        """Take note; under construction leave, and raise KeyboardInterrupt where nobody sees the context."""
        if self.leave:
            try:
                for clean in self.leave:
                    clean()
            finally:
                os._exit(0)
        again, self.received = self.received, True
        if again or not self.watched:
            raise KeyboardInterrupt

    def install(self) -> Interrupt:
        """Take over SIGINT; return self."""
        signal.signal(signal.SIGINT, self)
        return self


def leave_at_once(clean: Callable[[], Any]) -> None:
    """From now on until the node spins, Ctrl-C calls `clean` and ends the process with code 0.

    For nodes under construction, which load kernels: LLVM calls back into Python there, where an exception is
    printed and dropped.
    """
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interrupt):
        handler.leave.append(clean)


def run(build: Callable[[], Any], argv: list[str] | None = None) -> int:
    """Build a node, or a list of nodes, and spin until told to stop; return the exit code.

    `build` does its imports itself: loading compiled kernels takes a second, and Ctrl-C in that second has
    to be as clean as later. A node may have ``exit_code`` to end with another code than 0.
    """
    # Nothing has to be cleaned up before rclpy is there, and an interrupted import of a compiled module does
    # not always surface as KeyboardInterrupt.
    signal.signal(signal.SIGINT, lambda _number, _frame: os._exit(0))
    try:
        return _run(build, sys.argv if argv is None else argv)
    except KeyboardInterrupt:
        return 0


def _run(build: Callable[[], Any], argv: list[str]) -> int:
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException

    from kalman_core.parameters import ParameterError
    from node_core.executor import DirectExecutor

    interrupt = Interrupt().install()
    missing = missing_params_file(argv)
    if missing is not None:
        return fail(f"parameter file '{missing}' cannot be read; expected a YAML file")
    try:
        rclpy.init(args=ros_arguments(argv))
    except (RCLError, RuntimeError) as error:
        return fail(_one_line(error))
    nodes: list[Any] = []
    try:
        executor = DirectExecutor()
        built = build()
        nodes = built if isinstance(built, list) else [built]
        # The kernels and message types live as long as the process: the collector need not walk them.
        gc.collect()
        gc.freeze()
        for node in nodes:
            executor.add_node(node)
        interrupt.watched = True
        interrupt.leave.clear()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        if interrupt.received or not rclpy.ok():  # whatever call met the signal failed in its own way
            return 0
        if isinstance(error, ParameterError | ParameterException | RCLError):
            return fail(_one_line(error))
        raise
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((int(getattr(node, 'exit_code', 0)) for node in nodes), default=0)


def _one_line(error: BaseException) -> str:
    # rcl ends its messages with the places in its own source, which say nothing to a user.
    return re.sub(r', at /\S+:\d+', '', ' '.join(str(error).split()))
