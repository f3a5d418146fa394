# SPDX-License-Identifier: Apache-2.0
"""A pytest plugin for `./ws coverage`: a test that is not done within TEST_LIMIT seconds is skipped."""

import os
import signal
from collections.abc import Iterator
from types import FrameType

import pytest

LIMIT = float(os.environ['TEST_LIMIT'])  # s
SKIPPED = f'not done within {LIMIT:g} s'


def _stop(_signal: int, _frame: FrameType | None) -> None:
    pytest.skip(SKIPPED)


def _limited() -> Iterator[None]:
    signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    """Limit the fixtures that a test is the first to need."""
    return (yield from _limited())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Limit the test itself."""
    return (yield from _limited())
