# SPDX-License-Identifier: Apache-2.0
"""A small stand-in for `ros2`: the same words and options for the verbs this workspace's documents use."""
