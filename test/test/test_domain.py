# SPDX-License-Identifier: Apache-2.0
"""Runs on one machine keep out of each other's ROS domain, those of `colcon test` included."""

import os
import socket

import pytest
from workspace_harness import domain
from workspace_harness.domain import own_domain


def test_two_runs_have_two_domains_and_leave_the_environment_as_it_was(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '77')
    with own_domain() as outer:
        assert os.environ['ROS_DOMAIN_ID'] == str(outer)
        with own_domain() as inner:
            assert inner != outer
            assert os.environ['ROS_DOMAIN_ID'] == str(inner)
        assert os.environ['ROS_DOMAIN_ID'] == str(outer)
    assert os.environ['ROS_DOMAIN_ID'] == '77'


def test_colcon_gives_no_domain_that_a_run_has_and_the_other_way_round(monkeypatch):
    coordinator = pytest.importorskip('colcon_ros_domain_id_coordinator.shell.ros_domain_id')
    colcon = coordinator.ROSDomainIDShell()
    with own_domain() as ours:
        while not colcon.free_ids.empty():
            colcon.free_ids.get_nowait()
        colcon.free_ids.put_nowait(str(ours))
        assert colcon._get_free_id() == (None, None)
    theirs, mark = colcon._get_free_id()
    with mark:
        assert theirs == str(ours)
        monkeypatch.setattr(domain, '_DOMAINS', (ours,))
        with pytest.raises(RuntimeError, match='all ROS domains'), own_domain():
            pass
    with own_domain() as again:
        assert again == ours


def test_a_domain_in_use_is_no_open_port():
    with own_domain() as number, socket.socket() as client:
        assert client.connect_ex(('127.0.0.1', 32768 + number)) != 0
