# SPDX-License-Identifier: Apache-2.0
"""Nodes of the navigation graph; the only modules here that import rclpy."""
