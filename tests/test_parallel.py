"""Work shared between cores: its results are those of one after the other, and nobody waits for ever."""

from __future__ import annotations

import signal
import threading
import time

import pytest

from cosim.estimation import parallel
from cosim.estimation.parallel import in_parallel


@pytest.fixture(autouse=True, params=[0, 1, 3])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """So many cores beside the first, whatever this machine has."""
    monkeypatch.setattr(parallel, "_idle", threading.Semaphore(request.param))
    return int(request.param)


def test_results_stand_in_the_order_of_the_items_at_every_depth(cores: int) -> None:
    def sums(n: int) -> int:
        return sum(in_parallel(lambda k: sum(in_parallel(lambda j: k * j, range(n))), range(n)))

    for _ in range(20):
        assert in_parallel(sums, range(12)) == [sum(k * j for k in range(n) for j in range(n)) for n in range(12)]
    assert in_parallel(sums, []) == []
    assert parallel._idle._value == cores  # every core has been given back


def test_the_first_item_that_fails_is_the_one_that_is_said(cores: int) -> None:
    def fails(k: int) -> int:
        if k == 1:
            raise ValueError("one")
        return k

    with pytest.raises(ValueError, match="one"):
        in_parallel(lambda n: in_parallel(fails, range(n)), [1, 5, 9])
    assert parallel._idle._value == cores


class Stop(BaseException):
    """Raised by the handler of a signal."""


@pytest.mark.parametrize("waits", [False, True])
def test_a_stop_ends_the_work_of_all_threads_at_their_next_check(cores: int, waits: bool) -> None:
    """Whether it comes while the main thread works or while it waits for the others."""
    begun, ended = threading.Event(), list[str]()

    def long_fit(k: int) -> None:
        if threading.current_thread() is threading.main_thread():
            if begun.wait(60.0 if cores else 0.0) and waits:
                return
            raise Stop
        begun.set()
        signal.setitimer(signal.ITIMER_REAL, 0.2 if waits else 0.0)
        try:
            for _ in range(3000):
                in_parallel(time.sleep, [0.01])
            ended.append("after the whole fit")
        except BaseException:
            ended.append("at a check")
            raise

    def stop(number: int, frame: object) -> None:
        raise Stop

    before = signal.signal(signal.SIGALRM, stop)
    try:
        with pytest.raises(Stop):
            in_parallel(long_fit, [0, 1])
    finally:
        signal.signal(signal.SIGALRM, before)
    assert set(ended) <= {"at a check"}
    assert len(ended) == (1 if cores else 0)
    assert parallel._idle._value == cores
    assert in_parallel(abs, [-1, 2]) == [1, 2]


def test_a_core_without_items_helps_with_the_parts_of_the_last_one(cores: int) -> None:
    if cores == 0:
        pytest.skip("there is no other core")

    def worker(_: int) -> int:
        time.sleep(0.005)
        return threading.get_ident()

    def helped(long: bool) -> bool:
        return any(len({*in_parallel(worker, range(2))}) == 2 for _ in range(2000 if long else 0))

    assert in_parallel(helped, [False, True]) == [False, True]
