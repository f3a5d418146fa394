# SPDX-License-Identifier: Apache-2.0
"""Command line of the stand-in."""

import argparse
import sys

from ros2_standin import package


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='ros2', description=__doc__)
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

    pkg = commands.add_parser('pkg', help='packages').add_subparsers(dest='verb', required=True)
    pkg.add_parser('list', help='list packages')
    executables = pkg.add_parser('executables', help='list executables')
    executables.add_argument('package', nargs='?')
    pkg.add_parser('prefix', help='print the prefix of a package').add_argument('package')

    node = commands.add_parser('node', help='nodes').add_subparsers(dest='verb', required=True)
    node.add_parser('list', help='list running nodes')
    node.add_parser('info', help='print what a node subscribes to, publishes and serves').add_argument('node')

    topic = commands.add_parser('topic', help='topics').add_subparsers(dest='verb', required=True)
    listing = topic.add_parser('list', help='list topics')
    listing.add_argument('-t', '--show-types', action='store_true')
    echo = topic.add_parser('echo', help='print messages')
    echo.add_argument('topic')
    echo.add_argument('type', nargs='?')
    echo.add_argument('--once', action='store_true', help='print the first message and end')
    echo.add_argument('--field', help='print one field only')
    hz = topic.add_parser('hz', help='print the rate of a topic')
    hz.add_argument('topic')
    hz.add_argument('-w', '--window', type=int, default=10_000)
    topic.add_parser('info', help='print type, publishers and subscribers').add_argument('topic')

    param = commands.add_parser('param', help='parameters').add_subparsers(dest='verb', required=True)
    param.add_parser('list', help='list parameters').add_argument('node', nargs='?')
    for verb, text in (('get', 'print a parameter'), ('set', 'change a parameter')):
        entry = param.add_parser(verb, help=text)
        entry.add_argument('node')
        entry.add_argument('name')
        if verb == 'set':
            entry.add_argument('value')
    describe = param.add_parser('describe', help='print type, meaning and range of parameters')
    describe.add_argument('node')
    describe.add_argument('names', nargs='+')
    param.add_parser('dump', help='print all parameters as YAML').add_argument('node')

    service = commands.add_parser('service', help='services').add_subparsers(dest='verb', required=True)
    listing = service.add_parser('list', help='list services')
    listing.add_argument('-t', '--show-types', action='store_true')
    call = service.add_parser('call', help='call a service')
    call.add_argument('service')
    call.add_argument('type')
    call.add_argument('values', nargs='?', default='{}', help='YAML of the request')

    run = commands.add_parser('run', help='run an executable of a package')
    run.add_argument('package')
    run.add_argument('executable')
    run.add_argument('argv', nargs=argparse.REMAINDER)
    return parser


def main() -> int:
    """Dispatch one command; return its exit code."""
    arguments = _parser().parse_args()
    if arguments.command == 'run':
        return package.run(arguments.package, arguments.executable, arguments.argv)
    if arguments.command == 'pkg':
        return getattr(package, f'pkg_{arguments.verb}')(arguments)
    from rclpy.executors import ExternalShutdownException

    from ros2_standin import graph, parameters, topics

    modules = {'node': graph, 'service': graph, 'topic': topics, 'param': parameters}
    verb = getattr(modules[arguments.command], f'{arguments.command}_{arguments.verb}')
    try:
        with graph.temporary_node() as node:
            return verb(node, arguments)
    except ExternalShutdownException:
        return 0


if __name__ == '__main__':
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(0)
    except BrokenPipeError:
        sys.exit(0)
