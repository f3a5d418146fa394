# SPDX-License-Identifier: Apache-2.0
"""Attitude from inertial sensors: two-state angle filter, 9-axis error-state filter, simulator, MPU6050 driver."""
