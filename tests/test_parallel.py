"""Work shared between cores: its results are those of one after the other, and nobody waits for ever."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from cosim.estimation import parallel
from cosim.estimation.parallel import in_parallel


@pytest.fixture(autouse=True, params=[1, 2, 4])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """So many cores, whatever this machine has."""
    monkeypatch.setattr(parallel, "CORES", request.param)
    monkeypatch.setattr(parallel, "_threads", ThreadPoolExecutor(request.param))


def test_results_stand_in_the_order_of_the_items_at_every_depth() -> None:
    def sums(n: int) -> int:
        return sum(in_parallel(lambda k: sum(in_parallel(lambda j: k * j, range(n))), range(n)))

    for _ in range(20):
        assert in_parallel(sums, range(12)) == [sum(k * j for k in range(n) for j in range(n)) for n in range(12)]
    assert in_parallel(sums, []) == []


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_after_an_error_nothing_is_begun(error: type[BaseException]) -> None:
    begun = []

    def fail(k: int) -> None:
        begun.append(k)
        raise error

    with pytest.raises(error):
        in_parallel(lambda n: in_parallel(fail, range(9)), range(9))
    assert len(begun) <= 16
    assert in_parallel(str, range(3)) == ["0", "1", "2"]
