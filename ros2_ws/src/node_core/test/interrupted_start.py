# SPDX-License-Identifier: Apache-2.0
"""A node that gets Ctrl-C while its kernels load, within a call of C back into Python as LLVM makes them."""

import ctypes
import signal
import sys
from dataclasses import replace

from node_core.spin import run


def build():
    """Make a node that does not live to see its first message."""
    from echo_estimator import LEAK_PORTS

    from node_core.node import EstimatorNode

    @ctypes.CFUNCTYPE(None)
    def notify():
        signal.raise_signal(signal.SIGINT)

    def warm():
        print('loading', flush=True)
        notify()
        print('loaded', flush=True)

    return EstimatorNode(replace(LEAK_PORTS, warm=warm))


if __name__ == '__main__':
    sys.exit(run(build))
