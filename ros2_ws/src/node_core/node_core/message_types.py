# SPDX-License-Identifier: Apache-2.0
"""Message classes by their ROS name."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any


@cache
def message_class(name: str) -> Any:
    """Return rclpy's class of ``'sensor_msgs/msg/Imu'``; raise LookupError naming what is missing."""
    try:
        package, kind, cls = name.split('/')
        return getattr(import_module(f'{package}.{kind}'), cls)
    except (ValueError, ImportError, AttributeError) as error:
        raise LookupError(f"message type '{name}' is not installed ({error})") from error
