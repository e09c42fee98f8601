"""Each call of each component is written down before it is made, so that the right one is blamed for what follows."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from cosim.base.errors import SimulationError, TimedOut
from cosim.blocks.component import EarlyEnd
from cosim.blocks.sources import SourceBlock
from cosim.isolation import watch
from cosim.isolation.limits import Limits
from cosim.isolation.rows import CALLS, NOTHING, OTHER, Progress, Rows
from cosim.isolation.watch import Clock, Watch, fmi_calls, how_ended
from cosim.master.master import StoppedRun, simulate
from cosim.system.schedule import Stage
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


def test_halved_steps_are_one_whole_and_two_halves_from_the_same_time() -> None:
    source = SourceBlock("s", {"y": ("", lambda t: t)})  # type: ignore[dict-item]
    system = system_of([], {}, start=3.0)
    stage = Stage(source)
    system = type(system)((stage,), (), ("s.y",), {"s.y": ""}, start=3.0, signals={"s.y": source.outputs[0]})
    taken: list[tuple[float, float]] = []
    advance = source.advance
    source.advance = lambda t, h: (taken.append((t, h)), advance(t, h))[1]  # type: ignore[func-returns-value,method-assign]
    rows = Rows.in_memory(3, 1)
    results = simulate(replace(system, halved=True), 2, 0.5, rows=rows)
    assert taken == [(3.0, 0.5), (3.0, 0.25), (3.25, 0.25), (3.5, 0.5), (3.5, 0.25), (3.75, 0.25)]
    assert results["s.y"].tolist() == [0.0, 0.0, 0.0]  # a function of time does not depend on the steps
    assert (rows.made[0], results.time.tolist()) == (3, [3.0, 3.5, 4.0])


def test_the_difference_of_halves_is_that_of_the_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step adds h²: one whole adds h², two halves add h²/2, so that they are h²/2 apart."""

    class Squares(Block):
        total = 0.0

        def advance(self, t: float, h: float) -> None:
            super().advance(t, h)
            self.total += h * h

    monkeypatch.setattr("cosim.master.policies.FmuBlock", Block)
    block = Squares("a", [], ["y"], lambda t, h, u: [block.total])
    block.instance = SimpleNamespace(  # type: ignore[attr-defined]
        save_state=lambda: block.total, restore_state=lambda state, keep=False: setattr(block, "total", state)
    )
    system = system_of([block], {})
    results = simulate(replace(system, halved=True), 3, 0.4, rows=rows_for(system, 3))
    assert results["a.y"].tolist() == pytest.approx([0.0, 0.08, 0.08, 0.08])
    assert block.total == pytest.approx(3 * 0.16)  # the run goes on from the whole steps

    block.instance.restore_state = lambda state, keep=False: None  # type: ignore[attr-defined]
    with pytest.raises(StoppedRun, match=r"a at t = 0 s: its outputs differ after a saved state is restored"):
        simulate(replace(system, halved=True), 3, 0.4, rows=rows_for(system, 3))


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


def initialized(gain: float, offset: float = 1.0) -> tuple[int, float]:
    """How often y = gain·u + offset, fed back, is exchanged until it settles, and where it settles."""
    block = Block("a", ["u"], ["y"], lambda t, h, u: [gain * u[0] + offset])
    system = system_of([block], {"a.u": "a.y"}, held=["a.u"])
    rows = rows_for(system, 0)
    results = simulate(system, 0, 1.0, rows=rows)
    return sum(call == "put" for _, call, _ in block.calls), float(results["a.y"][0])


def test_initialization_ends_exactly_where_it_can_and_within_rounding_where_it_cannot() -> None:
    assert initialized(0.0) == (2, 1.0)  # once to know it, once to see that nothing changes
    sweeps, value = initialized(0.5)
    assert value == pytest.approx(2.0, rel=1e-11)
    # 0.5^n ≤ 1e-12 of max(1, 2) after 39 or 40 sweeps; to the last bit it takes 53
    assert 38 <= sweeps <= 42
    sweeps, value = initialized(-0.97)
    assert value == pytest.approx(1.0 / 1.97, rel=1e-9)
    assert 860 <= sweeps <= 960  # 0.97^n ≈ 1e-12/0.97…


def test_a_loop_without_a_solution_does_not_settle() -> None:
    with pytest.raises(StoppedRun, match=r"\.u at t = 0 s"):
        initialized(1.0)


@pytest.mark.parametrize("gain", [-1.0, 0.9985, 0.99992])
def test_a_loop_whose_exchanges_grow_swing_or_shrink_slowly_is_solved(gain: float) -> None:
    sweeps, value = initialized(gain)
    assert value == pytest.approx(1.0 / (1.0 - gain), rel=1e-6)
    assert sweeps < 20_000


def test_outputs_that_are_right_only_after_initialization_reach_the_others() -> None:
    late = Block("late", [], ["y"], lambda t, h, u: [7.0 if any(c == "start" for _, c, _ in late.calls) else 0.0])
    taker = Block("taker", ["u"], ["y"], lambda t, h, u: [2.0 * u[0]])
    results = simulate(system_of([late, taker], {"taker.u": "late.y"}), 0, 1.0)
    assert (results["taker.u"][0], results["taker.y"][0]) == (7.0, 14.0)


# -- who watches ------------------------------------------------------------------------------------


def clock_of(limits: Limits | None = None, **more: Any) -> Clock:
    calls = [fmi_calls(SimpleNamespace(fmiVersion=version)) for version in ("2.0", "3.0-rc.1")]
    told = Watch(("plant", "loop"), calls, lambda made, call: 10.0 * made + call, limits or Limits(), **more)
    return Clock(told, Progress())


@pytest.mark.parametrize(
    ("doing", "place"),
    [
        (0, ("plant", 30.0, "fmi2SetReal")),
        (1, ("plant", 31.0, "fmi2DoStep")),
        (2, ("plant", 32.0, "fmi2GetReal")),
        (3, ("plant", 33.0, "unloading")),
        (4, ("loop", 30.0, "fmi3SetFloat64")),
        (5, ("loop", 31.0, "fmi3DoStep")),
        (6, ("loop", 32.0, "fmi3GetFloat64")),
        (7, ("loop", 33.0, "unloading")),
        (8, ("the run", 0.0, "the worker")),
        (NOTHING, ("the run", 0.0, "the worker")),
    ],
)
def test_a_number_names_component_time_and_call(doing: int, place: tuple[str, float, str]) -> None:
    clock = clock_of()
    clock.progress.made[0], clock.progress.doing[0] = 3, doing
    assert clock.place() == place
    if 0 <= doing < 8:
        clock.progress.named[0], clock.progress.call = 1, b"fmi2GetInteger"
        assert clock.place() == (*place[:2], "fmi2GetInteger")
        clock.progress.named[0] = clock.progress.made[0] = 0
        assert clock.place()[2] == ("loading" if place[2] == "unloading" else place[2])


def test_what_is_no_fmu_sets_steps_and_reads() -> None:
    clock = Clock(Watch(("table",)), Progress())
    for call, words in enumerate(("setting its inputs", "stepping", "reading its outputs")):
        clock.progress.doing[0] = call
        assert clock.place()[2] == words
    assert fmi_calls(None) == watch.PLAIN_CALLS


def at(monkeypatch: pytest.MonkeyPatch, clock: Clock, time: float) -> None:
    monkeypatch.setattr(watch.time, "monotonic", lambda: time)
    clock.look(0)


def test_a_step_has_its_limit_from_the_first_look_at_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.time, "monotonic", lambda: 0.0)
    clock = clock_of(Limits(step=1.0))
    clock.progress.made[0], clock.progress.doing[0] = 1, 1
    at(monkeypatch, clock, 5.0)  # seen for the first time now
    clock.progress.doing[0] = 6  # the calls of one step are one
    at(monkeypatch, clock, 6.0)
    with pytest.raises(TimedOut, match=r"loop at t = 12 s: fmi3GetFloat64 takes longer than 1 s \(limits: step\)"):
        at(monkeypatch, clock, 6.001)
    clock.progress.made[0] = 2
    at(monkeypatch, clock, 6.002)  # the next step has its time again


def test_calls_of_initialization_and_end_have_the_limit_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.time, "monotonic", lambda: 0.0)
    clock = clock_of(Limits(step=1.0))
    for k, doing in enumerate((0, 1, 2, 4, 5)):
        clock.progress.doing[0] = doing
        at(monkeypatch, clock, 0.9 * k)
    clock.progress.made[0], clock.progress.doing[0] = 9, OTHER
    at(monkeypatch, clock, 10.0)
    at(monkeypatch, clock, 10.9)
    clock.progress.doing[0] = CALLS + OTHER  # the next component has its own time
    at(monkeypatch, clock, 11.2)
    at(monkeypatch, clock, 12.1)
    with pytest.raises(TimedOut, match=r"loop at t = .* s: unloading takes longer than 1 s"):
        at(monkeypatch, clock, 12.3)


def test_loading_counts_for_its_own_limit_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.time, "monotonic", lambda: 0.0)
    clock = clock_of(Limits(step=1.0, total=3.0, load=20.0))
    clock.progress.doing[0] = OTHER
    at(monkeypatch, clock, 1.0)
    at(monkeypatch, clock, 20.0)
    assert clock.watch.spent == [0.0]
    with pytest.raises(TimedOut, match=r"plant at t = 3 s: loading takes longer than 20 s \(limits: load\)"):
        at(monkeypatch, clock, 21.5)
    clock.progress.named[0], clock.progress.call = 1, b"fmi2Instantiate"  # is loading still
    at(monkeypatch, clock, 22.0)
    clock.progress.call = b"fmi2SetupExperiment"  # is not
    at(monkeypatch, clock, 22.5)
    assert clock.watch.spent == [0.5]
    with pytest.raises(TimedOut, match="limits: step"):
        at(monkeypatch, clock, 24.0)


def test_the_total_is_that_of_all_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.time, "monotonic", lambda: 0.0)
    clock = clock_of(Limits(total=3.0), spent=[2.0])
    clock.progress.made[0], clock.progress.doing[0] = 1, 0
    at(monkeypatch, clock, 1.0)
    assert clock.watch.spent == [3.0]
    with pytest.raises(
        TimedOut, match=r"fmi2SetReal was stopped: the run takes longer than 3 s in all \(limits: total\)"
    ):
        at(monkeypatch, clock, 1.1)


def test_rows_do_not_count_for_the_limit_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.ProcessTree, "size", lambda tree, limit: 50_000_000)
    clock = clock_of(Limits(memory=40e6), width=1000)
    clock.progress.doing[0] = 1
    clock.progress.made[0] = 10_000
    clock.look(0)  # exactly as much as is allowed
    clock.progress.made[0] = 9_000
    with pytest.raises(SimulationError, match=r"fmi2DoStep: .* 41 MB, more than 40 MB \(limits: memory\)"):
        clock.look(0)


def test_progress_is_told_when_there_are_more_rows() -> None:
    told: list[int] = []
    clock = clock_of(progress=told.append)
    for made in (0, 3, 3, 4):
        clock.progress.made[0] = made
        clock.look(0)
    assert told == [3, 4]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (-11, "crashed: segmentation fault (SIGSEGV)"),
        (-10_000, "was ended (signal 10000)"),
        (-15, "was ended (SIGTERM)"),
        (0xC0000005, "crashed: access violation"),
        (0xC00000FD, "crashed: stack overflow"),
        (0xC0000094, "crashed: division by zero"),
        (0xC0000374, "crashed: heap corrupted"),
        (0xC0000409, "crashed: abort"),
        (0, "ended the process, exit code 0"),
        (3, "ended the process, exit code 3"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="names of POSIX")
def test_the_end_of_a_process_has_a_name(code: int | None, words: str) -> None:
    assert how_ended(code) == words
