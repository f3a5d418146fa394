# SPDX-License-Identifier: Apache-2.0
"""The generated lists are complete: no pin without a licence, no importer that nobody can find."""

import pytest

from bag_tools.licences import LicenceError, licence_of, licence_table, pins
from bag_tools.recordings import RecordingsError, importers, recordings_table

LOCK = """numpy==2.4.6 \\
    --hash=sha256:00
pywin32==312 ; sys_platform == 'win32' \\
    --hash=sha256:00
contourpy==1.3.3 ; python_full_version < '3.12' \\
    --hash=sha256:00
contourpy==1.4.0 ; python_full_version >= '3.12' \\
    --hash=sha256:00
no-such-package==1.0
"""


@pytest.fixture
def lock(tmp_path):
    path = tmp_path / 'lock.txt'
    path.write_text(LOCK)
    return path


def test_pins_are_those_that_some_supported_python_installs_on_linux(lock):
    assert pins(lock) == {'numpy': ['2.4.6'], 'contourpy': ['1.3.3', '1.4.0'], 'no-such-package': ['1.0']}


def test_a_pin_that_is_not_installed_keeps_its_row_and_a_new_one_is_named(lock):
    with pytest.raises(LicenceError, match='no-such-package'):
        licence_table(lock)
    table = licence_table(lock, '| no-such-package | 0.9 | MIT |\n')
    assert '| no-such-package | 1.0 | MIT |' in table.splitlines()
    assert licence_table(lock, table) == table


def test_a_licence_is_what_the_installed_version_states():
    from importlib.metadata import version

    assert 'BSD' in licence_of('numpy', [version('numpy')])
    assert licence_of('numpy', ['0.0']) is None
    assert licence_of('no-such-package', ['1.0']) is None


def test_an_importer_that_is_not_listed_is_named_and_so_is_one_that_is_not_there(tmp_path):
    entry = {'recording': 'R', 'licence': 'MIT', 'source': 'S', 'command': 'x A B'}
    names = sorted(importers([]))
    assert 'broad' in names
    whole = {**entry, 'importers': names}
    assert '`ros2 run bag_tools import x A B`' in recordings_table([whole], tmp_path)
    with pytest.raises(RecordingsError, match=names[0]):
        recordings_table([{**entry, 'importers': names[1:]}], tmp_path)
    for wrong, named in (('no_mapping', 'no_mapping'), ('bag_tools:nothing', 'bag_tools')):
        with pytest.raises(RecordingsError, match=named):
            recordings_table([whole, {**entry, 'importers': [wrong]}], tmp_path)


def test_importers_of_packages_are_found():
    pytest.importorskip('ev_velocity')
    assert 'ev_velocity:kingston' in importers(['ev_velocity'])
