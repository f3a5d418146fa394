# SPDX-License-Identifier: Apache-2.0
"""An executor that hands messages to subscriptions directly.

rclpy's SingleThreadedExecutor collects all entities anew for every message, wraps its callback in a task and
wakes itself twice on the way: several times what a filter step costs. Here the wait set is made once and
filled again for every wait, and what a ready subscription or timer has to do is done on the spot. All else
(services, events, tasks) goes through rclpy's own code.
"""

from __future__ import annotations

import inspect
from contextlib import ExitStack
from typing import Any

from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription
from rclpy.timer import Timer

InvalidHandle = rclpy_implementation.InvalidHandle
_FOREVER = -1  # ns
_DIRECT = ('subscription', 'timer')


class DirectExecutor(SingleThreadedExecutor):
    """Spins nodes in this thread, one message per topic and turn; callbacks must not spin themselves."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._held = ExitStack()
        self._waiting: _Waiting | None = None

    def spin(self) -> None:
        """Run callbacks until the context or this executor is shut down; errors of callbacks pass on."""
        try:
            super().spin()
        finally:
            self._let_go()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait at most `timeout_sec` (None: for ever), then run all that is ready."""
        if self._waiting is None or self._waiting.changed:
            self._let_go()
            self._waiting = _Waiting(self, self._held)
        for entity in self._waiting.wait(_FOREVER if timeout_sec is None else round(timeout_sec * 1e9)):
            _call(entity)
        if self._waiting.others or self._tasks:
            self._spin_others()
            self._waiting.changed = True  # a wait in there may have taken the guard's word for it

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop, and let the handles go that were waited for."""
        self._let_go()
        return super().shutdown(timeout_sec)

    def _let_go(self) -> None:
        self._waiting = None
        self._held.close()

    def _spin_others(self) -> None:
        """Run all that is ready, in the way of rclpy."""
        while True:
            try:
                task = self.wait_for_ready_callbacks(0.0)[0]
            except (TimeoutException, ShutdownException):
                return
            task()
            task.result()  # raises what the callback raised


class _Waiting:
    """The entities of an executor's nodes in one wait set; `held` keeps their handles while it is in use."""

    def __init__(self, executor: SingleThreadedExecutor, held: ExitStack) -> None:
        self.changed, self.others = False, False
        self._context = executor.context
        nodes = executor.get_nodes()
        self._guard = executor._guard.handle.pointer
        entities: dict[str, list[Any]] = {
            'subscription': [s for node in nodes for s in node.subscriptions],
            'guard_condition': [
                *(g for node in nodes for g in node.guards),
                executor._guard,
                executor._sigint_gc,
            ],
            'timer': [t for node in nodes for t in node.timers],
            'client': [c for node in nodes for c in node.clients],
            'service': [s for node in nodes for s in node.services],
        }
        self._direct: dict[int, Subscription | Timer] = {}
        handles: list[tuple[str, Any]] = []
        for kind, entity in ((k, entity) for k, group in entities.items() for entity in group):
            try:
                held.enter_context(entity.handle)
            except InvalidHandle:  # destroyed meanwhile: the guard will say so
                continue
            handles.append((kind, entity.handle))
            if kind in _DIRECT and not inspect.iscoroutinefunction(entity.callback):
                self._direct[entity.handle.pointer] = entity
        self._waitables = [w for node in nodes for w in node.waitables]
        for waitable in self._waitables:
            held.enter_context(waitable)
        context: Any = self._context.handle
        held.enter_context(context)
        counts = [sum(k == kind for k, _ in handles) for kind in entities]
        events = sum(w.get_num_entities().num_events for w in self._waitables)
        self._set = rclpy_implementation.WaitSet(*counts, events, context)
        self._adders = [(getattr(self._set, f'add_{kind}'), handle) for kind, handle in handles]

    def wait(self, timeout: int) -> list[Subscription | Timer]:
        """Wait at most `timeout` (ns); return what is ready to be called, note the rest in `others`."""
        wait_set = self._set
        wait_set.clear_entities()
        try:
            for add, handle in self._adders:
                add(handle)
            for waitable in self._waitables:
                waitable.add_to_wait_set(wait_set)
        except InvalidHandle:  # destroyed by a callback
            self.changed = True
            return []
        wait_set.wait(timeout)
        if not self._context.ok():
            raise ExternalShutdownException
        guards = wait_set.get_ready_entities('guard_condition')
        self.changed = self._guard in guards
        ready = [p for kind in _DIRECT for p in wait_set.get_ready_entities(kind)]
        direct = [self._direct[p] for p in ready if p in self._direct]
        self.others = (
            len(direct) < len(ready)
            or len(guards) > self.changed
            or any(wait_set.get_ready_entities(kind) for kind in ('client', 'service'))
            or any(waitable.is_ready(wait_set) for waitable in self._waitables)
        )
        return direct


def _call(entity: Subscription | Timer) -> None:
    if isinstance(entity, Timer):
        _tick(entity)
    else:
        _deliver(entity)


def _tick(timer: Timer) -> None:
    try:
        with timer.handle:
            if not timer.handle.is_timer_ready():  # cancelled by the callback before this one
                return
            timer.handle.call_timer()
    except InvalidHandle:
        return
    timer.callback()


def _deliver(subscription: Subscription) -> None:
    try:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    except InvalidHandle:  # destroyed by the callback before this one
        return
    if taken is None:
        return
    if subscription._callback_type is Subscription.CallbackType.MessageOnly:
        subscription.callback(taken[0])
    else:
        subscription.callback(*taken)
