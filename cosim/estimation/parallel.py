"""Parallel work on up to two cores; kernels release the interpreter lock.

Work may contain parallel parts. Idle threads help with remaining items, so that the last and longest fit of a stage
leaves no core idle. After an error, no item is begun any more. After a stop from outside, as from the keyboard, all
threads end at their next check, and not only after the fits that they have begun.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from threading import Event, Semaphore, Thread, local
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_idle = Semaphore(min(2, os.cpu_count() or 1) - 1)  # cores besides the calling thread's
_thread = local()  # `calls`: errors by item of the calls of `in_parallel` for which a thread works, outermost first


class _Abandoned(BaseException):
    """End of work that was stopped in another thread."""


def check_wanted() -> None:
    """End the work of this thread if a call of `in_parallel` for which it works was stopped.

    Long work without parallel parts calls this function now and then.
    """
    for faults in getattr(_thread, "calls", ()):
        if not all(isinstance(error, Exception) for error in [*faults.values()]):
            raise _Abandoned


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of `work` in the order of the items; raise the first error."""
    results: dict[int, Result] = {}
    numbers = iter(range(len(items)))  # shared by the threads
    outer: tuple[dict[int, BaseException], ...] = getattr(_thread, "calls", ())
    faults, helpers = dict[int, BaseException](), list[Event]()

    def process(k: int) -> None:
        if faults:
            return
        try:
            check_wanted()
            results[k] = work(items[k])
        except BaseException as error:
            faults[k] = error

    def help_out(end: Event) -> None:
        _thread.calls = (*outer, faults)
        for k in numbers:
            process(k)
        _idle.release()
        end.set()

    _thread.calls = (*outer, faults)
    try:
        for k in numbers:
            if k + 1 < len(items) and _idle.acquire(blocking=False):
                end = Event()
                Thread(target=help_out, args=(end,), daemon=True).start()
                helpers.append(end)
            process(k)
        _wait(faults, helpers)
    except BaseException as error:  # a signal between two items, or while waiting
        faults[-1] = error
        _wait(faults, helpers)
        raise
    finally:
        _thread.calls = outer
    if faults:
        errors = [error for _, error in sorted(faults.items())]
        raise next((error for error in errors if not isinstance(error, _Abandoned)), errors[0])
    return [results[k] for k in range(len(items))]


def _wait(faults: dict[int, BaseException], helpers: Sequence[Event]) -> None:
    """Wait for the ends of helper threads; meanwhile other work may use this thread's core.

    A signal during `Thread.join` may mark a running thread as ended (Python 3.11), so that each has an event.
    """
    if helpers:
        _idle.release()
        try:
            for end in helpers:
                end.wait()
        except BaseException as error:  # a signal; the helpers must know of it before they are waited for
            faults[-1] = error
            for end in helpers:
                end.wait()
            raise
        finally:
            _idle.acquire()
