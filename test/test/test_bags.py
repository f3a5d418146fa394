# SPDX-License-Identifier: Apache-2.0
"""The fixtures in bags/ are what their seeds make."""

import pytest
from workspace_harness.make_bags import check, fixtures

from bag_tools import manifest

FIXTURES = sorted(fixtures())


def test_every_fixture_has_the_content_that_the_manifest_declares(bags):
    assert manifest.verify(bags) == []
    assert sorted(manifest.read(bags)) == FIXTURES


# One per package: ./ws bags --check makes all of them.
@pytest.mark.parametrize('name', sorted({fixtures()[n][0]: n for n in FIXTURES}.values()))
def test_a_fixture_made_anew_equals_the_recorded_one(bags, name):
    assert check(bags, [name]) == []


def test_the_fixtures_stay_small(bags):
    assert sum(path.stat().st_size for path in bags.glob('*')) < 10_000_000
