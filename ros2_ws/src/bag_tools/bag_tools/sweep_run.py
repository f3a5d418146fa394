# SPDX-License-Identifier: Apache-2.0
"""Runs the tasks of a sweep: one after the other, or on Dask workers (this machine's, or a cluster's).

A row is a function of its task, so both give the same. A worker that dies costs nothing but the time of the
run it was at: Dask gives it to another one.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from bag_tools.bag import BagError
from bag_tools.sweep_plan import Task
from bag_tools.sweep_store import Store
from bag_tools.sweep_task import Row, run_task

# Workers that may die under one run before the run is held to be what kills them.
_DEATHS = 10
# Kernels are loaded by the first run; BLAS threads would only take the cores of other workers.
_ENVIRONMENT = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}

Runner = Callable[[Sequence[Task]], Iterator[Row]]


def serial(tasks: Sequence[Task]) -> Iterator[Row]:
    """Yield the rows of `tasks`, run here one after the other."""
    for task in tasks:
        yield run_task(task)


@contextmanager
def on_dask(scheduler: str = '', workers: int = 0) -> Iterator[tuple[Runner, Any]]:
    """Yield (runner, Dask client) on the cluster at `scheduler`, or on processes here (0: one per core).

    The local cluster listens on the loopback interface only and serves no dashboard. Raises BagError.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BagError(
            f'parallel sweeps need the packages of requirements/sweep.in ({error.name} is missing); '
            './ws sweep installs them; --serial does without'
        ) from error
    dask.config.set({'distributed.scheduler.allowed-failures': _DEATHS})
    if scheduler:
        try:
            client = Client(scheduler, timeout=30)
        except (OSError, ValueError) as error:
            raise BagError(
                f"no Dask scheduler at '{scheduler}' ({error}); expected tcp://host:port"
            ) from error
        with client:
            yield _runner(client), client
        return
    with (
        LocalCluster(
            n_workers=workers or os.cpu_count() or 1,
            threads_per_worker=1,
            host='127.0.0.1',
            dashboard_address=None,
            env=_ENVIRONMENT,
            silence_logs=logging.ERROR,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield _runner(client), client


def _runner(client: Any) -> Runner:
    from distributed import as_completed

    def run(tasks: Sequence[Task]) -> Iterator[Row]:
        futures = [client.submit(run_task, task, key=f'run-{task.key}', pure=False) for task in tasks]
        for future in as_completed(futures):
            yield future.result()
            future.release()

    return run


def complete(
    tasks: Sequence[Task], store: Store, run: Runner, done: Callable[[int], None] = lambda _n: None
) -> list[Row]:
    """Run what `store` does not hold yet; return all rows in the order of `tasks`.

    `done(n)` is called with the number of finished runs.
    """
    missing = {task.key: task for task in tasks if store.get(task) is None}
    finished = len(tasks) - len(missing)
    done(finished)
    for row in run(list(missing.values())):
        store.put(row)
        finished += 1
        done(finished)
    rows = [store.get(task) for task in tasks]
    return [row for row in rows if row is not None]
