# SPDX-License-Identifier: Apache-2.0
"""The rules of the tree hold: imports point one way, every file carries its licence."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / 'ros2_ws' / 'src'
PACKAGES = sorted(p.parent.name for p in SOURCE.glob('*/package.xml'))
MODULES = [path for package in PACKAGES for path in (SOURCE / package / package).rglob('*.py')]
# What a package may import of the workspace; nodes of any package may use node_core and bag_tools too.
ALLOWED = {
    'kalman_core': set(),
    'node_core': {'kalman_core'},
    'bag_tools': {'kalman_core', 'node_core'},
    'imu_kalman': {'kalman_core', 'node_core', 'bag_tools'},
    'ship_inclinometer': {'kalman_core', 'node_core', 'bag_tools', 'imu_kalman'},
    'ev_velocity': {'kalman_core', 'node_core', 'bag_tools'},
    'ins_gps': {'kalman_core', 'node_core', 'bag_tools'},
    'quad_control': {'kalman_core', 'node_core', 'bag_tools', 'imu_kalman'},
}


def imported(path):
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split('.')[0])
    return names


def test_there_are_eight_packages():
    assert sorted(ALLOWED) == PACKAGES


@pytest.mark.parametrize('package', sorted(set(PACKAGES) - {'node_core'}))
def test_only_nodes_and_node_core_import_rclpy(package):
    outside = [p for p in (SOURCE / package / package).rglob('*.py') if 'nodes' not in p.parts]
    assert outside
    assert not [str(p.relative_to(SOURCE)) for p in outside if 'rclpy' in imported(p)]


@pytest.mark.parametrize('package', PACKAGES)
def test_imports_between_packages_point_one_way(package):
    others = set(PACKAGES) - {package} - ALLOWED[package]
    wrong = {p.name: imported(p) & others for p in (SOURCE / package / package).rglob('*.py')}
    assert not {name: found for name, found in wrong.items() if found}


def test_what_the_offline_runner_needs_imports_no_ros():
    pure = ['ports', 'messages', 'driver']
    for name in pure:
        assert 'rclpy' not in imported(SOURCE / 'node_core' / 'node_core' / f'{name}.py')


@pytest.mark.parametrize('package', PACKAGES)
def test_every_node_is_an_executable(package):
    setup = (SOURCE / package / 'setup.py').read_text()
    named = {node.value for node in ast.walk(ast.parse(setup)) if isinstance(node, ast.Constant)}
    entries = {str(value).split(' = ')[0] for value in named}
    nodes = {
        p.stem for p in (SOURCE / package / package / 'nodes').glob('*.py') if 'def main(' in p.read_text()
    }
    assert not nodes - entries


def test_every_source_file_names_its_licence():
    files = [
        *MODULES,
        *(ROOT / 'test').rglob('*.py'),
        *SOURCE.glob('*/test/*.py'),
        *SOURCE.glob('*/bench/*.py'),
    ]
    assert len(files) > 50
    assert not [str(p) for p in files if 'SPDX-License-Identifier: Apache-2.0' not in p.read_text()[:200]]


def test_no_module_is_long():
    assert not {str(p): n for p in MODULES if (n := len(p.read_text().splitlines())) > 500}
