"""Terms without a name that are local: a block on a rail, whose rail, clock or law of friction hides something."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import read_log
from cosim.model import Equations, Model, Namespace, Quantity, parameter
from cosim.refinement.search.fits import Search
from cosim.refinement.search.shapes import Shape
from cosim.refinement.search.unnamed import Leftover, find_unnamed_terms
from tests.logs import write_log

STEP, ROWS, NOISE = 0.02, 900, 5e-4
UNITS = {"time": "s", "place": "m", "speed": "m/s", "command force": "N"}
PRICE = 4.0
Push = Callable[[float, float, float], float]


@dataclass(frozen=True, kw_only=True)
class Block(Model):
    """A block on a rail, held by a spring, its place measured."""

    base_states = (Quantity("place", "m", "place"), Quantity("speed", "m/s", "speed"))
    inputs, outputs = (Quantity("force", "N", "force"),), base_states[:1]
    sensor_variance, forced, calibrated = {"place": NOISE**2}, ("speed",), ("friction",)
    friction: float = parameter(0.8, unit="N.s/m", bounds=(0, 10), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """v̇ = u − b·v − 2·x."""
        return Equations(
            lambda t, x, u: (x[1], u[0] - self.friction * x[1] - 2.0 * x[0]), lambda t, x, u: (x[0],)
        )  # fmt: skip


def left(folder: Path, push: Push, shown: Callable[[Array], Array] = np.array) -> tuple[Problem, Leftover]:
    """What is left beside the block recalibrated, on two logs of a block with another push on it, or another sensor."""
    logs = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        time = STEP * np.arange(ROWS)
        force = np.repeat(rng.uniform(-2.0, 2.0, ROWS // 30 + 1), 30)[:ROWS]
        x, v, places = 0.0, 0.0, []
        fine = 4
        for t, u in zip(time, force, strict=True):
            places.append(x)
            for k in range(fine):
                h = STEP / fine
                v += h * (u - 0.8 * v - 2.0 * x + push(t + k * h, x, v))
                x += h * v
        columns = {"time": time, "force": force, "place": shown(np.array(places)) + NOISE * rng.standard_normal(ROWS)}
        logs.append(read_log(write_log(folder / f"{seed}.csv", columns), Block.inputs, Block.outputs))
    problem = build_problem(ModelSubject.of(Block()), logs, unnamed=True)
    at = Search(ModelSubject.of(Block()), problem, 1, lambda stage, share: None).hypothesis((), None).fit
    problem = replace(problem, sensing=at.noise)
    return problem, find_unnamed_terms(problem, at, PRICE, UNITS)


@pytest.mark.thorough
def test_a_tight_place_on_the_rail_is_found_where_it_is(tmp_path: Path) -> None:
    place, half = 0.3, 0.12
    _, found = left(tmp_path, lambda t, x, v: -2.0 * v * np.exp(-(((x - place) / half) ** 2)))
    first = found.terms[0]
    assert first.shape is not None
    assert (first.equation, first.shape.kind, first.shape.of) == ("speed", "bump", ("place",))
    assert abs(first.shape.place - place) < first.shape.width
    assert first.shape.width < 0.6  # of 2 m that it moves over
    assert first.coefficient < 0.0
    assert "speed" in first.shape.factor
    assert found.is_placed


@pytest.mark.thorough
def test_a_push_that_begins_at_a_time_is_a_step_there(tmp_path: Path) -> None:
    _, found = left(tmp_path, lambda t, x, v: 0.15 if t > 10.0 else 0.0)
    first = found.terms[0]
    assert first.shape is not None
    assert (first.shape.kind, first.signal) == ("step", "time")
    assert first.shape.place == pytest.approx(10.0, abs=first.shape.width)


@pytest.mark.thorough
def test_a_law_that_holds_everywhere_is_not_told_as_local(tmp_path: Path) -> None:
    _, found = left(tmp_path, lambda t, x, v: -0.3 * v**3)
    assert found.terms
    assert found.terms[0].shape is None
    assert found.terms[0].signal in {"speed³", "speed·|speed|"}


@pytest.mark.thorough
def test_where_nothing_is_hidden_no_shape_is_found(tmp_path: Path) -> None:
    assert left(tmp_path, lambda t, x, v: 0.0)[1].terms == ()


@pytest.mark.parametrize(
    ("push", "shown", "where", "signal", "period"),
    [
        (lambda t, x, v: 0.02 * np.sin(8.0 * t + 1.0), np.array, "speed", "time", 2.0 * np.pi / 8.0),
        (lambda t, x, v: 0.0, lambda x: x + 2e-3 * np.sin(30.0 * x), "reading of place", "place", 2.0 * np.pi / 30.0),
    ],
    ids=["push", "sensor"],
)
def test_what_repeats_is_found_where_it_acts(
    tmp_path: Path, push: Push, shown: Callable[[Array], Array], where: str, signal: str, period: float
) -> None:
    _, found = left(tmp_path, push, shown)
    first = found.terms[0]
    assert first.shape is not None
    assert (first.equation, first.shape.kind, first.signal) == (where, "wave", signal)
    assert first.shape.width == pytest.approx(period, rel=0.05)


SHAPES = [
    Shape("speed", ("place",), "bump", 0.2, 0.1),
    Shape("speed", ("place",), "bump", 0.2, 0.1, ("speed",)),
    Shape("speed", ("place", "speed"), "step", 0.2, 0.3, ("speed",)),
    Shape("speed", ("place",), "spline", -1.0, 0.3),
    Shape("speed", ("place",), "wave", 0.0, 0.4, ("speed",)),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: f"{s.kind} {s.factor}")
def test_the_kernel_has_the_shape_that_is_told(shape: Shape, tmp_path: Path) -> None:
    problem = replace(left_problem(tmp_path))
    signals = {"place": np.linspace(-1.0, 1.0, 9), "speed": np.linspace(0.7, -0.4, 9)}
    (column, *_) = shape.columns(signals).T
    known: Mapping[str, float] = {**problem.values, **shape.settings(2), shape.coefficients(2)[0]: 1.0}
    data, h = problem.logs[0].rows(0, 2), 1e-6
    data = replace(data, step=h, u=0.0 * data.u)
    for place, speed, expected in zip(signals["place"], signals["speed"], column, strict=True):
        state = np.zeros(len(problem.layout.states))
        state[:2] = place, speed
        base, there = (
            problem.kernel.simulate(data, problem.numbers(values), state, np.zeros(0)).states[1]
            for values in (problem.values, known)
        )
        assert (there - base)[1] / h == pytest.approx(expected, abs=1e-4)


def left_problem(folder: Path) -> Problem:
    """A problem of a few rows."""
    time = STEP * np.arange(200)
    columns = {"time": time, "force": np.sin(time), "place": 0.1 * np.sin(time)}
    log = read_log(write_log(folder / "a.csv", columns), Block.inputs, Block.outputs)
    return build_problem(ModelSubject.of(Block()), [log], unnamed=True)
