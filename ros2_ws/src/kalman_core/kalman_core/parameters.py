# SPDX-License-Identifier: Apache-2.0
"""Parameters as frozen dataclasses whose fields carry unit, bounds and meaning.

One declaration serves the algorithm, the ROS descriptors, the default YAML and the README table.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

P = TypeVar('P')


class ParameterError(ValueError):
    """A parameter is unknown, of the wrong type or out of its range; the message names all three."""


def parameter(
    default: Any,
    text: str,
    *,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare one field of a parameter dataclass.

    `live` says that a running node may take a new value without a restart of the filter.
    Lists default to a tuple of floats; their bounds hold for every element.
    """
    metadata = {
        'unit': unit,
        'min': minimum,
        'max': maximum,
        'choices': choices,
        'text': text,
        'live': live,
    }
    return dataclasses.field(default=default, metadata=metadata)


def allowed(field: dataclasses.Field) -> str:
    """Return the allowed range of `field` in words, for messages and tables."""
    meta = field.metadata
    if meta.get('choices'):
        return ' | '.join(meta['choices'])
    low, high = meta.get('min'), meta.get('max')
    unit = f' {meta["unit"]}' if meta.get('unit') not in (None, '', '1') else ''
    if low is None and high is None:
        return 'any'
    if high is None:
        return f'>= {low:g}{unit}'
    if low is None:
        return f'<= {high:g}{unit}'
    return f'{low:g} … {high:g}{unit}'


def _coerce_number(field: dataclasses.Field, value: Any, kind: type) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"parameter '{field.name}' is {value!r}, expected {kind.__name__}")
    if kind is int:
        if value != int(value):
            raise ParameterError(f"parameter '{field.name}' is {value!r}, expected a whole number")
        value = int(value)
    else:
        value = float(value)
    low, high = field.metadata.get('min'), field.metadata.get('max')
    finite = math.isfinite(value)
    if not finite or (low is not None and value < low) or (high is not None and value > high):
        raise ParameterError(f"parameter '{field.name}' is {value:g}, allowed: {allowed(field)}")
    return value


def coerce(field: dataclasses.Field, value: Any) -> Any:
    """Return `value` as the type of `field`'s default, or raise ParameterError.

    A whole number is taken for a float (YAML writes 100 for 100.0), never the other way round.
    """
    default = field.default
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise ParameterError(f"parameter '{field.name}' is {value!r}, expected true or false")
        return value
    if isinstance(default, str):
        choices = field.metadata.get('choices') or ()
        if not isinstance(value, str) or (choices and value not in choices):
            expected = allowed(field) if choices else 'a string'
            raise ParameterError(f"parameter '{field.name}' is {value!r}, allowed: {expected}")
        return value
    if isinstance(default, tuple):
        if isinstance(value, str | bytes) or not hasattr(value, '__iter__'):
            raise ParameterError(f"parameter '{field.name}' is {value!r}, expected a list of numbers")
        items = tuple(_coerce_number(field, item, float) for item in value)
        if len(items) != len(default):
            raise ParameterError(
                f"parameter '{field.name}' has {len(items)} elements, expected {len(default)}"
            )
        return items
    return _coerce_number(field, value, type(default))


def build(cls: type[P], values: dict[str, Any]) -> P:
    """Return ``cls(**values)`` with every value coerced and checked.

    Raises ParameterError for unknown names, wrong types and values out of range; cross-field rules belong
    into ``cls.__post_init__`` and raise ParameterError too.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(fields))
    if unknown:
        raise ParameterError(f"unknown parameter '{unknown[0]}'; known: {', '.join(fields)}")
    return cls(**{name: coerce(fields[name], value) for name, value in values.items()})


def markdown_table(cls: type) -> str:
    """Return the README table of the parameters of `cls`, one row each, in order of declaration."""
    rows = ['| parameter | default | unit | allowed | live | meaning |', '|---|---|---|---|---|---|']
    for field in dataclasses.fields(cls):
        meta = field.metadata
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        cells = (
            f'`{field.name}`',
            f'`{default}`',
            meta.get('unit') or '–',
            allowed(field).replace('|', '\\|'),
            'yes' if meta.get('live') else 'restart',
            meta.get('text', ''),
        )
        rows.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(rows)


def default_yaml(cls: type, node_name: str) -> str:
    """Return a ROS parameter file with the defaults of `cls` for `node_name`, one comment a line."""
    lines = ['# SPDX-License-Identifier: Apache-2.0', f'{node_name}:', '  ros__parameters:']
    for field in dataclasses.fields(cls):
        value = field.default
        if isinstance(value, bool):
            text = 'true' if value else 'false'
        elif isinstance(value, tuple):
            text = '[' + ', '.join(repr(float(v)) for v in value) + ']'
        elif isinstance(value, str):
            text = f"'{value}'"
        elif isinstance(value, float):
            # YAML 1.1 readers take 1e-06 for a string: a mantissa with a point keeps it a number.
            text = repr(value) if 'e' not in repr(value) or '.' in repr(value) else f'{value:.1e}'
        else:
            text = repr(value)
        unit = f' [{field.metadata["unit"]}]' if field.metadata.get('unit') else ''
        lines.append(f'    {field.name}: {text}  # {field.metadata.get("text", "")}{unit}')
    return '\n'.join(lines) + '\n'
