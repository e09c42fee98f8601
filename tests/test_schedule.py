"""When components step: orders, rates, what is passed on at which communication point, and what acts there."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.blocks.coupling import DEFAULT, OWN, Algorithm, Plan
from cosim.blocks.faults import fault_function, points
from cosim.core.times import MOST, steps_in, whole_steps
from cosim.simulation import criteria
from cosim.system.schedule import schedule
from cosim.system.wiring import Transfer
from tests.own_blocks import Block


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


# -- order ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "place", "words"),
    [
        (DEFAULT.plan, "connections", "(order: [a, b]) or algorithm: jacobi"),
        (lambda components, edges, order: Plan(("a",), (False,) * len(edges)), "algorithm", "third steps a; it must"),
    ],
)
def test_a_loop_or_a_forgotten_component_of_an_algorithm_of_a_third_party_is_a_fault(
    monkeypatch: pytest.MonkeyPatch, plan: Any, place: str, words: str
) -> None:
    third = type("Third", (Algorithm,), {"name": "third", "plan": lambda self, *arguments: plan(*arguments)})
    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, third()))
    components = {"a": block("a", "u", u=True), "b": block("b", "u", u=True)}
    ends, transfers = [("a.y", "b.u"), ("b.y", "a.u")], [(Transfer(0, 1, "b.u"),), (Transfer(2, 3, "a.u"),)]
    named, noted = {name: SimpleNamespace() for name in components}, Noted()
    given = scenario(connections=ends, components=named, algorithm="third")
    assert schedule(given, components, transfers, noted).stages == ()  # type: ignore[arg-type]
    ((where, message),) = noted.faults
    assert where == (place,)
    assert words in message


# -- faults on a connection -------------------------------------------------------------------------

POINTS = 8


def passed(fault: Any) -> list[float]:
    return [fault(k, float(10 * k)) for k in range(POINTS)]


def test_what_is_lost_or_hit_by_chance_is_as_often_as_its_probability_says() -> None:
    count, rng = 20_000, np.random.default_rng(3)
    for kind, share in (("dropout", 0.25), ("spike", 0.25)):
        fault = fault_function(kind, (0, count), count, rng, value=0.5, probability=share)
        values = np.array([fault(k, float(k)) for k in range(count)])
        changed = np.mean(values != np.arange(count))
        assert changed == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / count))
    assert passed(fault_function("freeze", (0, 7), 8, rng)) == [0] * 8  # what comes first is always there


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


@pytest.mark.parametrize(
    ("signal", "target", "overshoot"),
    [
        ([0, 0.5, 1.25, 0.9, 1.0], 1.0, 0.25),
        ([0, -0.5, 0.5, 0.9, 1.0], 1.0, 0.0),
        ([2, 0.75, 1.5, 1.0, 1.0], 1.0, 0.25),
        ([1, 1.5, 0.25, 1.0, 1.0], 1.0, 0.75),  # from the target every excursion counts
        ([0.0, 2.5, 2.0], [0.0, 1.0, 2.0], 0.5),
    ],
)
def test_overshoot_is_measured_in_the_direction_of_travel(signal: list[float], target: Any, overshoot: float) -> None:
    assert criteria.overshoot(np.array(signal), np.array(target)) == overshoot


def test_errors_and_effort_are_their_formulas() -> None:
    signal, target = np.array([1.0, -3.0, 2.0, 5.0, 4.0]), np.array([0.0, 0.0, 2.0, 1.0, 1.0])
    assert criteria.rms_error(signal, target) == pytest.approx(math.sqrt((1 + 9 + 0 + 16 + 9) / 5))
    assert (criteria.final_error(signal, target), criteria.peak(-signal)) == (3.0, 5.0)
    assert criteria.effort(T, signal) == 0.5 * 1 + 0.5 * 3 + 1.0 * 2 + 0.5 * 5
