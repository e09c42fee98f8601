"""Parallel work in threads; kernels release the interpreter lock, and a thread costs far less than a job of joblib.

Work may contain parallel work. An idle thread helps with the remaining items of any of it, so that the last and longest
fit of a stage leaves no core idle.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from threading import Event
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

CORES = min(2, os.cpu_count() or 1)
_threads = ThreadPoolExecutor(CORES)
_stops: ContextVar[tuple[Event, ...]] = ContextVar("stops", default=())  # of the calls for which a thread works


class _Abandoned(BaseException):
    """End of work that was stopped in another thread."""


def raise_if_cancelled() -> None:
    """End the work of this thread if it was stopped from outside, as from the keyboard.

    Long work without parallel parts calls this function now and then.
    """
    if any(stop.is_set() for stop in _stops.get()):
        raise _Abandoned


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of `work` in the order of the items; after an error, no item is begun any more."""
    results: list[Any] = [None] * len(items)
    numbers, stop = iter(range(len(items))), Event()  # shared by the threads
    outer = _stops.set((*_stops.get(), stop))

    def process() -> None:
        try:
            for k in numbers:
                raise_if_cancelled()
                results[k] = work(items[k])
        except BaseException:
            deque(numbers, maxlen=0)
            raise

    helpers: list[Future[None]] = []
    try:
        for _ in items[1:CORES]:
            helpers.append(_threads.submit(copy_context().run, process))
        process()
        for helper in helpers:
            if not helper.cancel():  # one that has not begun would find nothing to do
                helper.result()
    except BaseException as error:
        if not isinstance(error, Exception):
            stop.set()
        wait([helper for helper in helpers if not helper.cancel()])
        raise
    finally:
        _stops.reset(outer)
    return results
