# SPDX-License-Identifier: Apache-2.0
"""An estimator that runs for long neither grows nor loses its covariance."""

import numpy as np
import pytest
from workspace_harness.soak import COURSES, covariances, positive_definite, soak

from bag_tools.bag import zeroed

# Simulated time of each estimator in the tests; ./ws bench soak runs 24 h.
HOURS, PARTS = 0.1, 6


@pytest.mark.parametrize('course', COURSES, ids=lambda c: c.name)
def test_memory_and_covariance_stay(course):
    run = soak(course, HOURS, PARTS)
    assert run.samples > 300
    assert run.outputs > 0
    assert run.bad == 0
    assert run.growth < 4.0


def test_a_covariance_with_a_negative_eigenvalue_is_bad():
    assert positive_definite(np.diag([1e-9, 1e9]))
    assert not positive_definite(np.array([[1.0, 1.1], [1.1, 1.0]]))
    assert not positive_definite(np.array([[1.0, np.nan], [np.nan, 1.0]]))
    assert not positive_definite(np.array([[1.0, 0.5], [0.4, 1.0]]))
    assert not positive_definite(np.zeros((1, 1)))


def test_covariances_are_found_at_any_depth():
    message = zeroed('nav_msgs/msg/Odometry')
    message.pose.covariance[0] = 2.0
    message.twist.covariance[7] = 3.0
    assert [m.tolist() for m in covariances(message)] == [[[2.0]], [[3.0]]]
