"""Parallel work on up to two cores; kernels release the interpreter lock.

Work may contain parallel parts. Idle threads help with remaining items, so that the last and longest fit of a stage
leaves no core idle.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from threading import Semaphore, Thread
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_idle = Semaphore(min(2, os.cpu_count() or 1) - 1)  # cores besides the calling thread's


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of `work` in the order of the items; raise the first error."""
    results: dict[int, Result] = {}
    faults: dict[int, BaseException] = {}
    numbers = iter(range(len(items)))  # shared by the threads

    def process(k: int) -> None:
        if faults:
            return
        try:
            results[k] = work(items[k])
        except BaseException as error:
            faults[k] = error

    def help_out() -> None:
        for k in numbers:
            process(k)
        _idle.release()

    helpers: list[Thread] = []
    for k in numbers:
        if k + 1 < len(items) and _idle.acquire(blocking=False):
            helpers.append(Thread(target=help_out, daemon=True))
            helpers[-1].start()
        process(k)
    _wait(helpers)
    if faults:
        raise faults[min(faults)]
    return [results[k] for k in range(len(items))]


def _wait(helpers: Sequence[Thread]) -> None:
    """Wait for helper threads; meanwhile other work may use this thread's core."""
    if helpers:
        _idle.release()
        try:
            for helper in helpers:
                helper.join()
        finally:
            _idle.acquire()
