# SPDX-License-Identifier: Apache-2.0
"""What a node says while its kernels are compiled."""

import dataclasses
import threading

import pytest
import rclpy
from echo_estimator import LEAK_PORTS

import node_core.node as node_module
from node_core.testing import TIMEOUT


class Said:
    """A logger that keeps what it is told."""

    def __init__(self):
        self.lines, self.told = [], threading.Event()

    def info(self, line):
        self.lines.append(line)
        self.told.set()


@pytest.fixture
def context():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


def build(monkeypatch, context, warm):
    """An EstimatorNode prepared by `warm(said)`; returns what it said."""
    said = Said()
    monkeypatch.setattr(node_module.EstimatorNode, 'get_logger', lambda self: said)
    ports = dataclasses.replace(LEAK_PORTS, warm=lambda: warm(said))
    node_module.EstimatorNode(ports, context=context).destroy_node()
    return said


def test_a_long_preparation_is_announced_while_it_lasts(monkeypatch, context):
    monkeypatch.setattr(node_module, '_LOADING', 0.01)
    said = build(monkeypatch, context, lambda said: said.told.wait(TIMEOUT))
    assert said.lines == ['preparing kernels; the first start compiles them']


def test_a_short_preparation_says_nothing(monkeypatch, context):
    monkeypatch.setattr(node_module, '_LOADING', TIMEOUT)
    assert build(monkeypatch, context, lambda said: None).lines == []
