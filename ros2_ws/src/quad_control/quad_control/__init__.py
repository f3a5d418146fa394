# SPDX-License-Identifier: Apache-2.0
"""Kalman attitude, PID control, mixer and tuning of an X quadcopter."""
