"""When components step: orders, rates, what is passed on at which communication point, and what acts there."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.base.times import MOST, steps_in, whole_steps
from cosim.blocks.coupling import OWN, AlgebraicLoop, Algorithm, Plan, order_by_dependencies
from cosim.blocks.faults import Delay, Hold, fault_function, points
from cosim.master.master import simulate
from cosim.simulation import criteria
from cosim.system.schedule import _every, schedule
from cosim.system.wiring import Transfer
from tests.own_blocks import Block, rows_for, system_of


class Noted:
    """A diagnosis that keeps what it is told."""

    def __init__(self) -> None:
        self.faults: list[tuple[tuple[Any, ...], str]] = []
        self.warnings: list[str] = []

    def note(self, where: tuple[Any, ...], message: str, exit_code: int = 2) -> None:
        self.faults.append((where, message))


def block(name: str, inputs: str = "", **direct: Any) -> Block:
    return Block(name, inputs.split(), ["y"], lambda t, h, u: [t], direct=direct)


def scenario(step: float = 0.1, steps: int = 10, connections: Any = (), **more: Any) -> Any:
    ends = [SimpleNamespace(source=a, target=b) for a, b in connections]
    default = {"algorithm": "gauss-seidel", "order": None, "loops": None, "components": {}}
    return SimpleNamespace(step=step, steps=steps, duration=step * steps, connections=ends, **(default | more))


# -- rates ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "every", "faults", "warnings"),
    [
        (None, 1, 0, 0),
        (0.1, 1, 0, 0),
        (0.5, 5, 0, 0),
        (1.0, 10, 0, 0),
        (0.3, 3, 0, 1),  # 10 is no multiple of 3
        (0.25, 2, 1, 0),
        (0.04, 1, 1, 0),
        (1.1, 11, 1, 0),
    ],
)
def test_a_step_of_its_own_is_a_whole_multiple_within_the_run(
    step: Any, every: int, faults: int, warnings: int
) -> None:
    noted = Noted()
    of = scenario(components={"a": SimpleNamespace(step=step)})
    assert _every(of, "a", noted) == every  # type: ignore[arg-type]
    assert (len(noted.faults), len(noted.warnings)) == (faults, warnings)


def test_a_component_with_a_longer_step_makes_it_at_its_end() -> None:
    slow, fast = (Block(name, ["u"], ["y"], lambda t, h, u: [u[0] + 100.0 * t]) for name in ("slow", "fast"))
    clock = Block("clock", [], ["y"], lambda t, h, u: [t])
    system = system_of([clock, slow, fast], {"slow.u": "clock.y", "fast.u": "slow.y"}, every={"slow": 3}, start=2.0)
    results = simulate(system, 7, 0.5, rows=rows_for(system, 7))
    assert clock.steps == fast.steps == [(2.0 + 0.5 * k, 0.5) for k in range(7)]
    assert slow.steps == [(2.0, 1.5), (3.5, 1.5)]
    seen = [2.0] * 3 + [3.5] * 3 + [5.0] * 2
    assert results["slow.u"].tolist() == seen
    assert results["slow.y"].tolist() == [101.0 * t for t in seen]
    assert results["fast.u"].tolist() == [101.0 * t for t in seen]


def test_what_is_held_is_passed_on_when_its_target_steps() -> None:
    clock, slow = Block("clock", [], ["y"], lambda t, h, u: [t]), Block("slow", ["u"], ["y"], lambda t, h, u: [u[0]])
    system = system_of([slow, clock], {"slow.u": "clock.y"}, held=["slow.u"], every={"slow": 2})
    results = simulate(system, 5, 1.0, rows=rows_for(system, 5))
    assert results["slow.u"].tolist() == [0, 0, 2, 2, 4, 4]
    assert results["slow.y"].tolist() == [0, 0, 0, 0, 2, 2]  # at its step it still sees what was passed on before


def test_a_component_of_equal_steps_is_given_that_very_length() -> None:
    one, other = block("one"), block("other")
    one.nominal_step = True
    simulate(system_of([one, other], {}, start=1e4), 50, 0.1)
    assert {h for _, h in one.steps} == {0.1}
    assert all(t + h == begin for (t, h), (begin, _) in zip(other.steps, other.steps[1:], strict=False))


def test_progress_is_told_every_fifty_steps_and_not_before_the_first() -> None:
    told: list[int] = []
    simulate(system_of([block("a")], {}), 120, 0.1, told.append)
    assert told == [50, 100]


def test_events_act_at_their_point_before_its_row_is_kept() -> None:
    class Changed(Block):
        value = 0.0

        def change(self, values: Any) -> None:
            self.value = values["p"]
            self._row[self._first] = self.value

    a = Changed("a", [], ["y"], lambda t, h, u: [a.value])
    system = system_of([a], {}, events={0: {"a": {"p": 5.0}}, 3: {"a": {"p": 7.0}, "b": {}}})
    assert simulate(system, 4, 1.0)["a.y"].tolist() == [5, 5, 5, 7, 7]


# -- order ------------------------------------------------------------------------------------------


def test_a_direct_input_is_of_the_same_time_and_any_other_of_the_last() -> None:
    blocks = {"b": block("b", "u", u=True), "a": block("a", "u", u=False)}
    edges = [("a", "b", "u", "y"), ("b", "a", "u", "y")]
    assert order_by_dependencies(blocks, edges, None) == (("a", "b"), (True, False), (), ())


def test_a_loop_of_direct_inputs_is_told_unless_an_order_is_given() -> None:
    blocks = {name: block(name, "u", u=True) for name in "abc"}
    edges = [("c", "a", "u", "y"), ("a", "b", "u", "y"), ("b", "c", "u", "y")]
    with pytest.raises(AlgebraicLoop) as loop:
        order_by_dependencies(blocks, edges, None)
    assert loop.value.cycle[0] == loop.value.cycle[-1]
    needs = {("a", "c"), ("b", "a"), ("c", "b")}
    assert all(pair in needs for pair in zip(loop.value.cycle, loop.value.cycle[1:], strict=False))
    assert order_by_dependencies(blocks, edges, ["b", "c", "a"]) == (("b", "c", "a"), (True, False, True), (), ())
    assert order_by_dependencies(blocks | {"s": block("s")}, edges, ["b", "c", "a"])[0] == ("s", "b", "c", "a")


def test_a_component_that_declares_nothing_gives_way_in_a_loop_and_that_is_noted() -> None:
    blocks = {"a": block("a", "u", u=True), "b": block("b", "u", u=None)}
    order, immediate, notes, _ = order_by_dependencies(blocks, [("a", "b", "u", "y"), ("b", "a", "u", "y")], None)
    assert (order, immediate) == (("b", "a"), (False, True))
    assert len(notes) == 1
    assert notes[0].startswith("b does not declare")


def test_jacobi_passes_everything_on_at_the_end_of_a_step_and_gauss_seidel_before() -> None:
    components = {"a": block("a"), "b": block("b", "u", u=True), "c": block("c", "u", u=False)}
    ends, transfers = [("a.y", "b.u"), ("b.y", "c.u")], [(Transfer(0, 1, "b.u"),), (Transfer(2, 3, "c.u"),)]
    named = {name: SimpleNamespace() for name in components}
    noted = Noted()
    found = schedule(scenario(connections=ends, components=named, algorithm="jacobi"), components, transfers, noted)  # type: ignore[arg-type]
    assert [stage.component.name for stage in found.stages] == ["a", "b", "c"]
    assert [t.name for t in found.held] == ["b.u", "c.u"]
    assert all(not stage.pulls for stage in found.stages)
    found = schedule(scenario(connections=ends, components=named), components, transfers, noted)  # type: ignore[arg-type]
    assert [t.name for t in found.held] == ["c.u"]
    assert {s.component.name: [t.name for t in s.pulls] for s in found.stages} == {"a": [], "b": ["b.u"], "c": []}
    assert noted.faults == []


def test_a_loop_is_a_fault_of_the_connections_for_an_algorithm_that_solves_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Plain(Algorithm):
        name = "plain"

        def plan(self, components: Any, edges: Any, order: Any) -> Plan:
            return order_by_dependencies(components, edges, order)

    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, Plain()))
    components = {"a": block("a", "u", u=True), "b": block("b", "u", u=True)}
    ends, transfers = [("a.y", "b.u"), ("b.y", "a.u")], [(Transfer(0, 1, "b.u"),), (Transfer(2, 3, "a.u"),)]
    noted = Noted()
    named = {name: SimpleNamespace() for name in components}
    found = schedule(scenario(connections=ends, components=named, algorithm="plain"), components, transfers, noted)  # type: ignore[arg-type]
    assert found.stages == ()
    ((where, message),) = noted.faults
    assert where == ("connections",)
    assert "(order: [a, b]) or algorithm: jacobi" in message


def test_an_algorithm_that_forgets_a_component_is_a_fault_of_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forgetful(Algorithm):
        name = "forgetful"

        def plan(self, components: Any, edges: Any, order: Any) -> Plan:
            return Plan(("a",), (False,) * len(edges))

    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, Forgetful()))
    components, noted = {"a": block("a"), "b": block("b")}, Noted()
    named = {name: SimpleNamespace() for name in components}
    assert schedule(scenario(components=named, algorithm="forgetful"), components, [], noted).stages == ()  # type: ignore[arg-type]
    assert noted.faults == [(("algorithm",), "forgetful steps a; it must step each component once")]


# -- faults on a connection -------------------------------------------------------------------------

POINTS = 8


def passed(fault: Any) -> list[float]:
    return [fault(k, float(10 * k)) for k in range(POINTS)]


def made(kind: str, window: tuple[int, int] = (2, 4), **more: Any) -> list[float]:
    return passed(fault_function(kind, window, POINTS, np.random.default_rng(1), **more))


def test_a_fault_acts_from_the_first_to_the_last_point_of_its_window_and_nowhere_else() -> None:
    assert made("bias", value=0.5) == [0, 10, 20.5, 30.5, 40.5, 50, 60, 70]
    assert made("scale", value=0.5) == [0, 10, 10, 15, 20, 50, 60, 70]
    assert made("stuck", value=7.0) == [0, 10, 7, 7, 7, 50, 60, 70]
    assert made("freeze") == [0, 10, 10, 10, 10, 50, 60, 70]
    assert made("delay", delay=2) == [0, 10, 0, 10, 20, 50, 60, 70]
    assert made("delay", delay=3, window=(0, 7)) == [0, 0, 0, 0, 10, 20, 30, 40]
    assert made("delay", delay=99, window=(0, 7)) == [0] * 8
    assert made("spike", value=1.0) == [0, 10, 21, 30, 40, 50, 60, 70]
    assert made("spike", value=1.0, window=(20, 30)) == [10.0 * k for k in range(8)]


def test_what_is_lost_or_hit_by_chance_is_as_often_as_its_probability_says() -> None:
    count, rng = 20_000, np.random.default_rng(3)
    for kind, share in (("dropout", 0.25), ("spike", 0.25)):
        fault = fault_function(kind, (0, count), count, rng, value=0.5, probability=share)
        values = np.array([fault(k, float(k)) for k in range(count)])
        changed = np.mean(values != np.arange(count))
        assert changed == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / count))
    assert passed(Hold((0, 7), bytearray(8 * [1]))) == [0] * 8  # what comes first is always there


def test_a_delay_keeps_no_more_than_it_needs() -> None:
    fault = Delay((0, 99), 3)
    for k in range(50):
        fault(k, float(k))
    assert len(fault._past) == 4


@pytest.mark.parametrize(
    ("begin", "end", "found"),
    [
        (None, None, (0, 10)),
        (5.2, 5.6, (2, 6)),
        (5.21, 5.59, (3, 5)),
        (5.0 + 3 * 0.1, None, (3, 10)),  # 0.1·3 is a little above 0.3
        (None, 5.3, (0, 3)),
        (4.0, 9.0, (-10, 40)),
    ],
)
def test_the_window_of_a_fault_is_the_points_within_its_times(begin: Any, end: Any, found: tuple[int, int]) -> None:
    assert points(begin, end, 5.0, 0.1, 11) == found


def test_steps_in_a_time_are_its_length_and_never_more_than_a_double_counts() -> None:
    assert steps_in(1.0, 0.25) == 4.0
    assert (steps_in(1e300, 1e-300), steps_in(-1e300, 1e-300)) == (MOST, -MOST)
    assert MOST < 2**63  # a communication point is counted in 64 bits, in C too
    assert [whole_steps(time, 0.1) for time in (0.0, 0.04, 0.14, 0.16, 1.0)] == [1, 1, 1, 2, 10]


# -- figures of merit -------------------------------------------------------------------------------

T = np.array([2.0, 2.5, 3.0, 4.0, 4.5])


@pytest.mark.parametrize(
    ("signal", "time"),
    [
        ([1, 1, 1, 1, 1], 0.0),
        ([3, 1, 1, 1, 1], 0.0),
        ([3, 1.2, 1, 1, 1], 0.5),
        ([3, 1, 0.7, 1, 1], 1.0),
        ([0, 0, 0, 0, 1], 2.0),
        ([1, 1, 1, 1, 1.11], math.inf),
        ([1.1, 0.9, 1.1, 0.9, 1.1], 0.0),  # on the edge of the band is within it
    ],
)
def test_settling_time_is_that_of_the_last_sample_outside_the_band(signal: list[float], time: float) -> None:
    assert criteria.settling_time(T, np.array(signal), 1.0, 0.1 + 1e-12) == time


def test_overshoot_is_seen_in_the_direction_of_travel() -> None:
    for signal, target, found in (
        ([0, 0.5, 1.25, 0.9, 1.0], 1.0, 0.25),
        ([0, -0.5, 0.5, 0.9, 1.0], 1.0, 0.0),
        ([2, 0.75, 1.5, 1.0, 1.0], 1.0, 0.25),
        ([1, 1.5, 0.25, 1.0, 1.0], 1.0, 0.75),  # it is there already: every excursion is one
    ):
        assert criteria.overshoot(np.array(signal), target) == found
    moving = np.array([0.0, 1.0, 2.0])
    assert criteria.overshoot(np.array([0.0, 2.5, 2.0]), moving) == 0.5


def test_errors_and_effort_are_their_formulas() -> None:
    signal, target = np.array([1.0, -3.0, 2.0, 5.0, 4.0]), np.array([0.0, 0.0, 2.0, 1.0, 1.0])
    assert criteria.rms_error(signal, target) == pytest.approx(math.sqrt((1 + 9 + 0 + 16 + 9) / 5))
    assert (criteria.final_error(signal, target), criteria.peak(-signal)) == (3.0, 5.0)
    assert criteria.effort(T, signal) == 0.5 * 1 + 0.5 * 3 + 1.0 * 2 + 0.5 * 5
