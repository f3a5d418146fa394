# SPDX-License-Identifier: Apache-2.0
"""The launch-free harness: node processes, replays through the live graph, comparison."""
