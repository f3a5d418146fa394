# SPDX-License-Identifier: Apache-2.0
"""Ports: what an estimator listens to and says, declared once and free of ROS.

The live node, the offline runner, the recorder, the interface documents and the harness are all derived
from the same table. Message types are named by string, so that no ROS is needed to read the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any


class BadMessage(ValueError):
    """A decoder rejects a message; the text is the reason counted in diagnostics."""


@dataclass(frozen=True, slots=True)
class Input:
    """A topic the estimator listens to.

    `decode` turns a message into a typed sample with an integer ``stamp`` (ns) and raises BadMessage for
    what no estimator can use; `handler` names the estimator's method that takes the sample.
    `timeout` (s) is the age beyond which diagnostics call the input stale; 0 means it may be absent.
    """

    topic: str
    type: str
    decode: Callable[[Any], Any]
    handler: str
    timeout: float = 0.0


@dataclass(frozen=True, slots=True)
class Output:
    """A topic the estimator publishes. `encode(estimate, message)` fills a message in place."""

    topic: str
    type: str
    encode: Callable[[Any, Any], None]
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Ports:
    """All inputs and, by class of estimate, all outputs of one estimator.

    `estimator` builds it from its parameters: ``estimator(params)``. Handlers return None, one estimate, or
    a list of estimates; each estimate goes to the output of its class. `warm` compiles or loads the kernels
    before a node subscribes, so that the first sample does not wait for a compiler.
    """

    name: str
    params: type
    estimator: Callable[[Any], Any]
    inputs: tuple[Input, ...]
    outputs: Mapping[type, Output]
    warm: Callable[[], None] | None = None
