# SPDX-License-Identifier: Apache-2.0
"""ROS command-line arguments without ROS: ``--ros-args -p name:=value --params-file f.yaml -r a:=b``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from bag_tools.bag import BagError, resolve
from node_core.spin import ros_arguments


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: 1e-3 is a number, which YAML 1.1 takes for text."""


_Loader.yaml_implicit_resolvers = {
    first: [r for r in resolvers if r[0] != 'tag:yaml.org,2002:float']
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(
        r'(?:[-+]?(?:\.\d+|\d+\.\d*|\d+(?=[eE]))(?:[eE][-+]?\d+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$'
    ),
    list('-+0123456789.'),
)


def load_yaml(text: str) -> Any:
    """Return the document in `text`; raise yaml.YAMLError."""
    return yaml.load(text, Loader=_Loader)


# rclpy declares these on every node, WorkspaceNode the rest: accepted offline, where they mean nothing.
_NODE_ONLY = ('use_sim_time', 'lockstep', 'queue_depth', 'start_type_description_service')


@dataclass(slots=True)
class RosArguments:
    """What followed ``--ros-args``: parameter overrides, parameter files and remaps, in order.

    The name of a parameter may begin with that of its node (``node:name``). `node` is the
    name from ``-r __node:=name``: it chooses the sections of parameter files.
    """

    parameters: list[tuple[str, Any]] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    remaps: dict[str, str] = field(default_factory=dict)
    node: str = ''


def split(argv: list[str], *, implied: bool = False) -> tuple[list[str], list[str]]:
    """Return (own arguments, ROS arguments); the latter lie between ``--ros-args`` and ``--``.

    With `implied`, for tools that have no such flags of their own, ``--ros-args`` may be left out as on the
    nodes: the first ROS flag then begins them.
    """
    own: list[str] = []
    ros: list[str] = []
    inside = False
    argv = ros_arguments(argv) if implied else argv
    for argument in argv:
        if argument == '--ros-args':
            inside = True
        elif inside and argument == '--':
            inside = False
        else:
            (ros if inside else own).append(argument)
    return own, ros


def assignment(text: str, what: str) -> tuple[str, str]:
    """Return (name, value) of ``name:=value``; raise BagError when it is not one."""
    name, mark, value = text.partition(':=')
    if not mark or not name or not value:
        raise BagError(f"{what} '{text}' is malformed; expected name:=value")
    return name, value


def parse(arguments: list[str]) -> RosArguments:
    """Parse ROS arguments; raise BagError for what is malformed or not supported offline."""
    result = RosArguments()
    rest = iter(arguments)
    for flag in rest:
        if flag not in ('-p', '--param', '-r', '--remap', '--params-file', '--log-level'):
            raise BagError(f"ROS argument '{flag}' is not supported; expected -p, -r or --params-file")
        value = next(rest, None)
        if value is None:
            raise BagError(f"ROS argument '{flag}' lacks its value")
        if flag in ('-p', '--param'):
            name, text = assignment(value, 'parameter')
            try:
                result.parameters.append((name, load_yaml(text)))
            except yaml.YAMLError:
                raise BagError(f"parameter '{name}' has the value '{text}'; expected YAML") from None
        elif flag == '--params-file':
            result.files.append(Path(value))
        elif flag in ('-r', '--remap'):
            name, target = assignment(value, 'remap')
            if name == '__node':
                result.node = target
            elif name.startswith('__'):
                raise BagError(f"remap '{value}' is not supported offline; expected topics or __node")
            else:
                result.remaps[name] = target
    return result


def _sections(tree: dict[Any, Any], above: str = '') -> Iterator[tuple[str, Any]]:
    """Yield (full name, parameters) of each section; namespaces may be nested. LookupError: none is there."""
    for key, body in tree.items():
        name = f'{above}/{str(key).lstrip("/")}'
        if not isinstance(body, dict):
            raise LookupError(name)
        if key == 'ros__parameters':
            yield above, body
        else:
            yield from _sections(body, name)


def _is_for(section: str, node: str) -> bool:
    """Whether rcl gives `section` to `node`: ``*`` stands for one part of a name, ``**`` for any number."""
    pattern = re.escape(section).replace(r'/\*\*', r'(/\w+)*').replace(r'/\*', r'/\w+')
    return re.fullmatch(pattern, f'/{node.lstrip("/")}') is not None


def file_parameters(path: Path, node: str) -> dict[str, Any]:
    """Return what `path` holds for `node`: sections such as ``/**``, ``/name``, ``/**/name``."""
    try:
        document = load_yaml(path.read_text())
    except OSError as error:
        raise BagError(f'{path}: cannot be read ({error.strerror}); expected a ROS parameter file') from error
    except (yaml.YAMLError, UnicodeDecodeError):
        raise BagError(f'{path}: is not YAML; expected a ROS parameter file') from None
    if not isinstance(document, dict):
        raise BagError(f'{path}: is empty; expected node_name: ros__parameters: ...')
    values: dict[str, Any] = {}
    try:
        for section, body in _sections(document):
            if _is_for(section, node):
                values.update(body)
    except LookupError as error:
        raise BagError(f"{path}: section '{error.args[0]}' lacks 'ros__parameters:'") from None
    return values


def estimator_parameters(arguments: RosArguments, node: str) -> dict[str, Any]:
    """Return the values for an estimator's dataclass: files first, then -p; node-only names are dropped."""
    values: dict[str, Any] = {}
    for path in arguments.files:
        values.update(file_parameters(path, node))
    for name, value in arguments.parameters:
        owner, _, own = name.rpartition(':')
        if owner not in ('', node):
            raise BagError(f"parameter '{name}' is for node '{owner}', but '{node}' is run")
        values[own] = value
    return {name: value for name, value in values.items() if name not in _NODE_ONLY}


def remapped(topic: str, remaps: dict[str, str], node: str = '/') -> str:
    """Return the full name of `topic` after `remaps` (relative or absolute names on either side)."""
    full = resolve(topic, node)
    for source, target in remaps.items():
        if resolve(source, node) == full:
            return resolve(target, node)
    return full
