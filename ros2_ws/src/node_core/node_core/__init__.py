# SPDX-License-Identifier: Apache-2.0
"""The one thin layer over rclpy.

``ports``, ``messages`` and ``driver`` need no ROS at all: the offline runner, importers and tests use
them. Only ``node``, ``parameters``, ``diagnostics``, ``lockstep`` and ``spin`` import rclpy.
"""
