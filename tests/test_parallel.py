"""Work shared between cores: its results are those of one after the other, and nobody waits for ever."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from cosim.estimation import parallel
from cosim.estimation.parallel import in_parallel


@pytest.mark.parametrize("cores", [1, 2, 4])
def test_results_stand_in_order_at_every_depth_and_after_an_error_nothing_is_begun(
    monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    monkeypatch.setattr(parallel, "CORES", cores)
    monkeypatch.setattr(parallel, "_threads", ThreadPoolExecutor(cores))

    def sums(n: int) -> int:
        return sum(in_parallel(lambda k: sum(in_parallel(lambda j: k * j, range(n))), range(n)))

    for _ in range(20):
        assert in_parallel(sums, range(12)) == [sum(range(n)) ** 2 for n in range(12)]
    begun = []

    def fail(k: int) -> None:
        begun.append(k)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_parallel(lambda n: in_parallel(fail, range(9)), range(9))
    assert len(begun) <= 16
    assert in_parallel(str, range(3)) == ["0", "1", "2"]
