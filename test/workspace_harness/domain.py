# SPDX-License-Identifier: Apache-2.0
"""A ROS domain that no other run on this machine uses."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Domains above 101 collide with the ephemeral ports of Linux; 0 is where users work.
_DOMAINS = range(1, 102)


@contextmanager
def own_domain() -> Iterator[int]:
    """Set ROS_DOMAIN_ID to a domain held by a lock file for as long as the block runs."""
    folder = Path(tempfile.gettempdir()) / f'ros_domains_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    for number in _DOMAINS:
        with (folder / str(number)).open('w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            before = os.environ.get('ROS_DOMAIN_ID')
            os.environ['ROS_DOMAIN_ID'] = str(number)
            try:
                yield number
            finally:
                if before is None:
                    del os.environ['ROS_DOMAIN_ID']
                else:
                    os.environ['ROS_DOMAIN_ID'] = before
            return
    raise RuntimeError('all ROS domains from 1 to 101 are in use on this machine')
