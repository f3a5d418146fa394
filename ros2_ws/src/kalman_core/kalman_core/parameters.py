# SPDX-License-Identifier: Apache-2.0
"""Parameters as frozen dataclasses whose fields carry unit, bounds and meaning.

One declaration serves the algorithm, the ROS descriptors, the default YAML and the README table.
"""

from __future__ import annotations

import dataclasses
import math
from numbers import Real
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
        return f'>= {_short(low)}{unit}'
    if low is None:
        return f'<= {_short(high)}{unit}'
    return f'{_short(low)} … {_short(high)}{unit}'


def _short(value: Any) -> str:
    """Return a number in its shortest form that keeps all its digits."""
    text = f'{value:g}'
    return text if float(text) == value else repr(value)


def _coerce_number(field: dataclasses.Field, value: Any, kind: type) -> Any:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ParameterError(f"parameter '{field.name}' is {value!r}, expected {kind.__name__}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    low, high = field.metadata.get('min'), field.metadata.get('max')
    if not math.isfinite(number) or (low is not None and value < low) or (high is not None and value > high):
        raise ParameterError(f"parameter '{field.name}' is {_short(number)}, allowed: {allowed(field)}")
    if kind is float:
        return number
    if number != int(number):
        raise ParameterError(f"parameter '{field.name}' is {_short(number)}, expected a whole number")
    return int(value)  # type: ignore[call-overload]


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
        try:
            values = () if isinstance(value, str | bytes) else tuple(value)
        except TypeError:
            values = ()
        if not values and default:
            raise ParameterError(f"parameter '{field.name}' is {value!r}, expected a list of numbers")
        items = tuple(_coerce_number(field, item, float) for item in values)
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
            allowed(field),
            'yes' if meta.get('live') else 'restart',
            meta.get('text', ''),
        )
        rows.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(rows)


def default_yaml(cls: type, node_name: str) -> str:
    """Return a ROS parameter file with the defaults of `cls` for `node_name`, one comment a line."""
    lines = ['# SPDX-License-Identifier: Apache-2.0', f'{node_name}:', '  ros__parameters:']
    for field in dataclasses.fields(cls):
        unit = f' [{field.metadata["unit"]}]' if field.metadata.get('unit') else ''
        comment = f'{field.metadata.get("text", "")}{unit}'
        lines.append(f'    {field.name}: {_yaml(field.default)}  # {comment}')
    return '\n'.join(lines) + '\n'


def _yaml(value: Any) -> str:
    """Return a parameter's value as YAML that every reader takes for the same type."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, tuple):
        return '[' + ', '.join(_yaml(float(item)) for item in value) + ']'
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    text = repr(value)
    # YAML 1.1 readers take 1e-06 for a string: a mantissa with a point keeps it a number.
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text
