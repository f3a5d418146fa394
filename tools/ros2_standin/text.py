# SPDX-License-Identifier: Apache-2.0
"""Messages as YAML text."""

import array
from importlib import import_module
from typing import Any

import numpy as np
import yaml

# `ros2 topic echo` cuts long sequences too.
_MAX_ELEMENTS = 128


def message_class(name: str) -> Any:
    """Return the class of `package/kind/Name` or `package/Name`."""
    parts = name.split('/')
    kind = parts[1] if len(parts) == 3 else 'msg'
    return getattr(import_module(f'{parts[0]}.{kind}'), parts[-1])


def to_plain(value: Any) -> Any:
    """Return a message as dictionaries, lists and numbers."""
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: to_plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, np.ndarray | array.array | list | tuple):
        items = [to_plain(item) for item in list(value)[:_MAX_ELEMENTS]]
        return [*items, '...'] if len(value) > _MAX_ELEMENTS else items
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else list(value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def to_yaml(value: Any) -> str:
    """Return a message as YAML."""
    plain = to_plain(value)
    if not isinstance(plain, dict | list):
        return f'{plain}\n'
    return yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=110)


def set_fields(message: Any, values: dict[str, Any]) -> None:
    """Fill a message from nested dictionaries."""
    for name, value in values.items():
        current = getattr(message, name)
        if isinstance(value, dict):
            set_fields(current, value)
        else:
            setattr(message, name, float(value) if isinstance(current, float) else value)
