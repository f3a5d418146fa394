# SPDX-License-Identifier: Apache-2.0
"""A ROS domain that no other run on this machine uses."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

# Domains above 101 collide with the ephemeral ports of Linux; 0 is where users work.
_DOMAINS = range(1, 102)
# The mark of a domain in use is that of colcon-ros-domain-id-coordinator, so that `./ws run` and a
# `colcon test` beside it keep out of each other's way: TCP port 32768 + domain, bound but not listening.
_FIRST_PORT = 32768


@contextmanager
def own_domain() -> Iterator[int]:
    """Set ROS_DOMAIN_ID to a domain that is held for as long as the block runs."""
    for number in _DOMAINS:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as mark:
            try:
                mark.bind(('', _FIRST_PORT + number))
            except OSError:
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
