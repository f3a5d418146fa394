# SPDX-License-Identifier: Apache-2.0
"""Faults across live graphs: what is broken, what was stated about it, and whether it held."""
