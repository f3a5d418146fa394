# SPDX-License-Identifier: Apache-2.0
"""Attitude from inertial sensors: two filters, a simulator and an MPU6050 driver."""
