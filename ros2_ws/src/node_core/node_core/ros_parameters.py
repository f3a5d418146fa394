# SPDX-License-Identifier: Apache-2.0
"""Declares a parameter dataclass on a node and keeps it up to date."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from kalman_core.parameters import ParameterError, allowed, build, coerce

# Declared by rclpy itself on every node.
_BUILT_IN = ('use_sim_time', 'start_type_description_service')
_INT64_MAX = 2**63 - 1


def _descriptor(field: dataclasses.Field) -> ParameterDescriptor:
    meta = field.metadata
    unit = f' [{meta["unit"]}]' if meta.get('unit') else ''
    descriptor = ParameterDescriptor(
        name=field.name,
        description=f'{meta.get("text", "")}{unit}',
        additional_constraints=f'allowed: {allowed(field)}',
        read_only=not meta.get('live', False),
        # `ros2 param set node gain 2` sends an integer: coerce() takes it for a float and checks the rest.
        dynamic_typing=True,
    )
    low, high = meta.get('min'), meta.get('max')
    if low is None and high is None:
        return descriptor
    if type(field.default) is int:
        descriptor.integer_range = [
            IntegerRange(
                from_value=int(low) if low is not None else -_INT64_MAX,
                to_value=int(high) if high is not None else _INT64_MAX,
                step=1,
            )
        ]
    elif isinstance(field.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=float(low) if low is not None else -math.inf,
                to_value=float(high) if high is not None else math.inf,
            )
        ]
    return descriptor


class NodeParameters:
    """The parameters of a node: one or several dataclasses, declared, checked and changed atomically.

    The node must have been made with ``automatically_declare_parameters_from_overrides=True``: only so can a
    misspelt name on the command line be told from one that is not given. Raises ParameterError.
    """

    def __init__(self, node: Node, *classes: type) -> None:
        self._node = node
        self._fields = {f.name: (cls, f) for cls in classes for f in dataclasses.fields(cls)}
        self._listeners: list[Callable[[], None]] = []
        given = self._take_overrides()
        self._values: dict[type, Any] = {
            cls: build(cls, {k: v for k, v in given.items() if self._fields[k][0] is cls}) for cls in classes
        }
        for name, (cls, field) in self._fields.items():
            value = getattr(self._values[cls], name)
            value = list(value) if isinstance(value, tuple) else value
            node.declare_parameter(name, value, _descriptor(field), ignore_override=True)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _take_overrides(self) -> dict[str, Any]:
        given = {}
        for name in list(self._node.get_parameters_by_prefix('')):
            if name in _BUILT_IN or name.startswith('qos_overrides.'):
                continue
            if name not in self._fields:
                known = ', '.join(sorted(self._fields))
                raise ParameterError(f"unknown parameter '{name}'; known: {known}")
            given[name] = self._node.get_parameter(name).value
            self._node.undeclare_parameter(name)
        return given

    def __getitem__(self, cls: type) -> Any:
        """Return the current instance of the parameter dataclass `cls`."""
        return self._values[cls]

    def on_change(self, listener: Callable[[], None]) -> None:
        """Call `listener` after parameters have changed."""
        self._listeners.append(listener)

    def _merged(self, parameters: list[Parameter]) -> dict[type, Any]:
        changes: dict[type, dict[str, Any]] = {}
        for parameter in parameters:
            if parameter.name in self._fields:
                cls, field = self._fields[parameter.name]
                changes.setdefault(cls, {})[parameter.name] = coerce(field, parameter.value)
        return {cls: dataclasses.replace(self._values[cls], **new) for cls, new in changes.items()}

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._merged(parameters)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        merged = self._merged(parameters)
        changed = any(value != self._values[cls] for cls, value in merged.items())
        self._values.update(merged)
        if changed:
            for listener in self._listeners:
                listener()
        # A whole number given for a float is stored as the float, so that others read the declared type.
        floats = [
            Parameter(p.name, Parameter.Type.DOUBLE, float(p.value))
            for p in parameters
            if p.type_ == Parameter.Type.INTEGER
            and p.name in self._fields
            and isinstance(self._fields[p.name][1].default, float)
        ]
        if floats:
            # Comes back here and changes nothing.
            self._node.set_parameters(floats)
