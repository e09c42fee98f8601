"""A component that fails is blamed, and one that ends a run leaves a row."""

from __future__ import annotations

import pytest

from cosim.blocks.component import EarlyEnd
from cosim.core.errors import SimulationError
from cosim.master.master import StoppedRun, simulate
from tests.own_blocks import Block, system_of


@pytest.mark.parametrize(
    ("name", "call", "count"),
    [("one", "open", 1), ("two", "start", 1), ("three", "put", 4), ("two", "advance", 2), ("one", "get", 4)],
)
def test_a_call_that_fails_stops_the_run_there_and_every_component_is_closed(name: str, call: str, count: int) -> None:
    fails = {"fails": (call, count), "error": SimulationError}
    names = ("one", "two", "three")
    blocks = [Block(n, ["u"], ["y"], lambda t, h, u: u, **(fails if n == name else {})) for n in names]
    system = system_of(blocks, {"two.u": "one.y", "three.u": "two.y"})
    with pytest.raises(StoppedRun, match=f"{name} at t = .* s: {call} failed") as stopped:
        simulate(system, 9, 0.1)
    assert (len(stopped.value.results.time) == 0) == (call in {"open", "start"})
    assert all(block.calls[-1][1] == "close" for block in blocks)


@pytest.mark.parametrize(
    ("readable", "fmus", "times"),
    [(True, ["a"], [0, 1, 2, 2.25]), (True, ["a", "b"], [0, 1, 2]), (False, ["a"], [0, 1, 2])],
)
def test_an_fmu_that_ends_the_run_alone_leaves_a_row_of_its_time(
    readable: bool, fmus: list[str], times: list[float]
) -> None:
    class Ends(Block):
        def advance(self, t: float, h: float) -> None:
            super().advance(t, h)
            if len(self.steps) == 3:
                self._at = t + 0.25 * h, h
                raise EarlyEnd(self.name, t + 0.25 * h, "it has landed", readable=readable)

    block = Ends("a", [], ["y"], lambda t, h, u: [t])
    results = simulate(system_of([block], {}, fmus=dict.fromkeys(fmus)), 9, 1.0)
    assert results.time.tolist() == times
    assert results["a.y"].tolist() == times
    assert results.notes == ("a ended the simulation at t = 2.25 s: it has landed",)
