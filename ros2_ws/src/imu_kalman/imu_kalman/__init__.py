# SPDX-License-Identifier: Apache-2.0
"""Attitude from inertial sensors: the two-state angle filter and a 9-axis error-state filter, simulator and MPU6050 driver."""
