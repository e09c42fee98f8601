"""Each call of each component is written down before it is made, so that the right one is blamed for what follows."""

from __future__ import annotations

from typing import Any

import pytest

from cosim.blocks.component import EarlyEnd
from cosim.core.errors import SimulationError
from cosim.isolation.rows import CALLS
from cosim.master.master import StoppedRun, simulate
from tests.own_blocks import Block, rows_for, system_of

CODES = {"put": 0, "advance": 1, "get": 2, "open": 3, "start": 3, "close": 3}
NAMES = ("one", "two", "three")


def three(**fails: Any) -> list[Block]:
    """Three components in a row, each of which adds its own number to what it is given."""
    return [
        Block(name, ["u"], ["y"], lambda t, h, u, add=k: [u[0] + 10.0**add], **fails.get(name, {}))
        for k, name in enumerate(NAMES)
    ]


def chain(blocks: list[Block]) -> Any:
    return system_of(blocks, {"two.u": "one.y", "three.u": "two.y"})


def test_every_call_of_a_run_is_announced_with_the_number_of_its_component() -> None:
    blocks = three()
    system = chain(blocks)
    results = simulate(system, 2, 0.1, rows=rows_for(system, 2))
    assert results.loop.startswith("Python")
    assert results["three.y"].tolist() == [111.0, 111.0, 111.0]
    for number, block in enumerate(blocks):
        assert {call for _, call, _ in block.calls} == CODES.keys()
        for name, call, doing in block.calls:
            assert divmod(doing, CALLS) == (number, CODES[call]), (name, call)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("call", ["open", "start", "put", "advance", "get"])
def test_a_call_that_fails_stops_the_run_there_and_every_component_is_closed(name: str, call: str) -> None:
    how_many = 1 if call in {"open", "start"} else 4 if call != "advance" else 2
    blocks = three(**{name: {"fails": (call, how_many), "error": SimulationError}})
    system = chain(blocks)
    rows = rows_for(system, 9)
    with pytest.raises(StoppedRun, match=f"{name} at t = .* s: {call} failed") as stopped:
        simulate(system, 9, 0.1, rows=rows)
    assert stopped.value.error.component == name
    assert len(stopped.value.results.time) == rows.made[0] == (0 if call in {"open", "start"} else rows.made[0])
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


# -- initialization ---------------------------------------------------------------------------------


def test_outputs_that_are_right_only_after_initialization_reach_the_others() -> None:
    late = Block("late", [], ["y"], lambda t, h, u: [7.0 if any(c == "start" for _, c, _ in late.calls) else 0.0])
    taker = Block("taker", ["u"], ["y"], lambda t, h, u: [2.0 * u[0]])
    results = simulate(system_of([late, taker], {"taker.u": "late.y"}), 0, 1.0)
    assert (results["taker.u"][0], results["taker.y"][0]) == (7.0, 14.0)
