# SPDX-License-Identifier: Apache-2.0
"""`ros2 param`."""

import sys

import yaml
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter as RclpyParameter
from rclpy.parameter import parameter_value_to_python

from ros2_standin.graph import call, node_names, split_name

_LABELS = {
    0: 'Parameter not set.',
    1: 'Boolean value is',
    2: 'Integer value is',
    3: 'Double value is',
    4: 'String value is',
    5: 'Byte values are',
    6: 'Boolean values are',
    7: 'Integer values are',
    8: 'Double values are',
    9: 'String values are',
}
_TYPES = (
    'not set', 'boolean', 'integer', 'double', 'string',
    'byte array', 'boolean array', 'integer array', 'double array', 'string array',
)  # fmt: skip


def _names(node: Node, name: str) -> list[str] | None:
    response = call(node, ListParameters, f'{name}/list_parameters', ListParameters.Request())
    return None if response is None else sorted(response.result.names)


def _missing(name: str) -> int:
    print('Node not found' if name else 'no nodes', file=sys.stderr)
    return 1


def param_list(node: Node, arguments) -> int:
    """Print the parameters of one node, or of all."""
    if arguments.node:
        names = _names(node, '/' + arguments.node.lstrip('/'))
        if names is None:
            return _missing(arguments.node)
        print('\n'.join(f'  {name}' for name in names))
        return 0
    for name in node_names(node):
        names = _names(node, name)
        if names is not None:
            print(f'{name}:')
            print('\n'.join(f'  {entry}' for entry in names))
    return 0


def param_get(node: Node, arguments) -> int:
    """Print one parameter."""
    name = '/' + arguments.node.lstrip('/')
    request = GetParameters.Request(names=[arguments.name])
    response = call(node, GetParameters, f'{name}/get_parameters', request)
    if response is None:
        return _missing(name)
    if not response.values:
        print('Parameter not set', file=sys.stderr)
        return 1
    value = response.values[0]
    if value.type == 0:
        print(_LABELS[0])
        return 0
    print(f'{_LABELS[value.type]}: {parameter_value_to_python(value)}')
    return 0


def param_describe(node: Node, arguments) -> int:
    """Print type, meaning and range of parameters."""
    name = '/' + arguments.node.lstrip('/')
    request = DescribeParameters.Request(names=arguments.names)
    response = call(node, DescribeParameters, f'{name}/describe_parameters', request)
    if response is None:
        return _missing(name)
    for descriptor in response.descriptors:
        print(f'Parameter name: {descriptor.name}')
        print(f'  Type: {_TYPES[descriptor.type]}')
        if descriptor.description:
            print(f'  Description: {descriptor.description}')
        print('  Constraints:')
        if descriptor.read_only:
            print('    Read only: true')
        for bounds in (*descriptor.floating_point_range, *descriptor.integer_range):
            print(f'    Min value: {bounds.from_value}\n    Max value: {bounds.to_value}')
            if bounds.step:
                print(f'    Step: {bounds.step}')
        if descriptor.additional_constraints:
            print(f'    Additional constraints: {descriptor.additional_constraints}')
    return 0


def param_set(node: Node, arguments) -> int:
    """Change one parameter."""
    name = '/' + arguments.node.lstrip('/')
    value = RclpyParameter(arguments.name, value=yaml.safe_load(arguments.value)).get_parameter_value()
    request = SetParameters.Request(parameters=[Parameter(name=arguments.name, value=value)])
    response = call(node, SetParameters, f'{name}/set_parameters', request)
    if response is None:
        return _missing(name)
    result = response.results[0]
    if not result.successful:
        print(f'Setting parameter failed: {result.reason}', file=sys.stderr)
        return 1
    print('Set parameter successful' + (f': {result.reason}' if result.reason else ''))
    return 0


def param_dump(node: Node, arguments) -> int:
    """Print all parameters of a node as a parameter file."""
    name = '/' + arguments.node.lstrip('/')
    names = _names(node, name)
    if names is None:
        return _missing(name)
    response = call(node, GetParameters, f'{name}/get_parameters', GetParameters.Request(names=names))
    if response is None:
        return _missing(name)
    values = {key: parameter_value_to_python(value) for key, value in zip(names, response.values)}
    plain = {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}
    base, space = split_name(name)
    print(
        yaml.safe_dump({f'{space.rstrip("/")}/{base}': {'ros__parameters': plain}}, default_flow_style=None)
    )
    return 0
