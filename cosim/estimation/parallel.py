"""Parallel work in threads: kernels release the interpreter lock, and threads cost far less than jobs of joblib.

Work may itself start parallel work. An idle thread takes over remaining items of any parallel work, so that no core is
idle during the last and longest fit of a stage.
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
_stops: ContextVar[tuple[Event, ...]] = ContextVar("stops", default=())  # events of a thread's calls


class _Abandoned(BaseException):
    """Raised in a thread whose work was cancelled by another thread."""


def raise_if_cancelled() -> None:
    """End the work of this thread if it was cancelled, for example from the keyboard.

    Long work without parallel parts calls this function regularly.
    """
    if any(stop.is_set() for stop in _stops.get()):
        raise _Abandoned


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of `work` in the order of the items; after an error, no further item is started."""
    results: list[Any] = [None] * len(items)
    numbers, stop = iter(range(len(items))), Event()  # shared by all threads of this call
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
            if not helper.cancel():  # a helper that has not started would find nothing to do
                helper.result()
    except BaseException as error:
        if not isinstance(error, Exception):
            stop.set()
        wait([helper for helper in helpers if not helper.cancel()])
        raise
    finally:
        _stops.reset(outer)
    return results
