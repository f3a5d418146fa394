# SPDX-License-Identifier: Apache-2.0
"""Longitudinal speed of an electric car at 500 Hz from wheels, GPS, accelerometer and pedals."""
