# SPDX-License-Identifier: Apache-2.0
"""Runs an estimator of bag_samples as a node: ``order_node.py mix --ros-args …``."""

import sys

from bag_samples import ESTIMATORS

from node_core.spin import run


def build():
    from node_core.node import EstimatorNode

    return EstimatorNode(ESTIMATORS[sys.argv[1]])


if __name__ == '__main__':
    sys.exit(run(build))
