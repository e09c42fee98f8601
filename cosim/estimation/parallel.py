"""Parallel work on up to two cores; kernels release the interpreter lock.

Work may contain parallel parts. Idle threads help with remaining items, so that the last and longest fit of a stage
leaves no core idle.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from itertools import count
from threading import Semaphore, Thread
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_idle = Semaphore(min(2, os.cpu_count() or 1) - 1)  # cores besides the calling thread's


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of `work` in the order of the items; raise the first error."""
    results: dict[int, Result] = {}
    faults: dict[int, BaseException] = {}
    numbers = count()

    def done() -> bool:
        """Process the next item; return True if none remains."""
        k = next(numbers)
        if k >= len(items) or faults:
            return True
        try:
            results[k] = work(items[k])
        except BaseException as error:
            faults[k] = error
        return False

    def help_out() -> None:
        while not done():
            pass
        _idle.release()

    helpers: list[Thread] = []
    for left in range(len(items), 0, -1):
        if left > 1 and _idle.acquire(blocking=False):
            helpers.append(Thread(target=help_out, daemon=True))
            helpers[-1].start()
        if done():
            break
    _wait(helpers)
    if faults:
        raise faults[min(faults)]
    return [results[k] for k in range(len(items))]


def _wait(helpers: Sequence[Thread]) -> None:
    """Wait for helpers, and lend this thread's core to their parallel parts."""
    if helpers:
        _idle.release()
        try:
            for helper in helpers:
                helper.join()
        finally:
            _idle.acquire()
