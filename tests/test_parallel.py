"""Work shared between cores: its results are those of one after the other, and nobody waits for ever."""

from __future__ import annotations

import threading

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
