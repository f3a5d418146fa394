# SPDX-License-Identifier: Apache-2.0
"""Tightly coupled INS/GPS with carrier-phase differences and DGPS."""
