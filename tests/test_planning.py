"""What is decided before a run: what fits what, how long and how finely, start values, events, and what it may cost."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.authoring import parts
from cosim.authoring.parts import times_of
from cosim.files.results import Results
from cosim.scenario.scenario import Criterion
from cosim.scenario.start_values import Misfit, convert_value, with_elements
from cosim.simulation.criteria import evaluate
from cosim.sweeps.sampling import drawn_rows, saltelli_base

# -- how long and how finely ------------------------------------------------------------------------


def planned(monkeypatch: pytest.MonkeyPatch, *experiments: dict[str, float], own: Any = None, **asked: Any) -> Any:
    listed = [SimpleNamespace(name=f"p{k}", path=Path(f"p{k}.fmu"), description=e) for k, e in enumerate(experiments)]
    monkeypatch.setattr(parts, "experiment_of", lambda description: description)
    monkeypatch.setattr(parts, "_own_step", lambda part: (own or {}).get(part.name, 0.0))
    return times_of(listed, **asked)  # type: ignore[arg-type]


def test_a_run_is_that_of_the_longest_experiment_in_the_finest_step(monkeypatch: pytest.MonkeyPatch) -> None:
    found = planned(monkeypatch, {"start": 1.0, "stop": 3.0, "step": 0.1}, {"start": 0.0, "stop": 9.0, "step": 0.5})
    assert (found.start, found.duration, found.step) == (0.0, 9.0, 0.1)
    assert found.why_duration == "the default experiment of p1"
    assert found.why_step == "the step of p0"
    none = planned(monkeypatch, {}, {"start": 5.0, "stop": 5.0})
    assert (none.start, none.duration, none.step) == (0.0, 5.0, 0.01)
    guess = planned(monkeypatch, {})
    assert (guess.start, guess.duration, guess.step, guess.notes) == (0.0, 1.0, 0.002, ())


# -- start values -----------------------------------------------------------------------------------


def variable(kind: str = "Real", **more: Any) -> Any:
    default = {
        "name": "v", "type": kind, "shape": (), "causality": "parameter", "variability": "fixed", "initial": "exact",
        "start": "0", "min": None, "max": None, "declaredType": None, "unit": None, "relativeQuantity": None,
    }  # fmt: skip
    return SimpleNamespace(**(default | more))


def fits(given: Any, kind: str = "Real", version: str = "2.0", **more: Any) -> Any:
    found = convert_value(SimpleNamespace(fmiVersion=version, unitDefinitions=[]), variable(kind, **more), given)
    return found.reason if isinstance(found, Misfit) else found


@pytest.mark.parametrize(
    ("given", "kind", "more", "found"),
    [
        (2, "Real", {}, 2.0),
        (2.0, "Integer", {}, 2),
        (2.5, "Integer", {}, "it is a whole number"),
        (math.nan, "Integer", {}, "it is a whole number"),
        (math.inf, "Integer", {}, "it is a whole number"),
        (True, "Real", {}, "it is a number [1]"),
        (1, "Boolean", {}, "it is true or false"),
        (True, "Boolean", {}, True),
        (1, "String", {}, "it is text"),
        (5.0, "Real", {"min": "1", "max": "5"}, 5.0),
        (1.0, "Real", {"min": "1", "max": "5"}, 1.0),
        (5.1, "Real", {"min": "1", "max": "5"}, "it lies in [1, 5]"),
        (0.9, "Real", {"min": "1"}, "it lies in [1, inf]"),
        (2**31, "Integer", {}, "it lies in [-2.14748e+09, 2.14748e+09]"),
        (2**31 - 1, "Integer", {}, 2**31 - 1),
        ([1, 2], "Real", {"shape": (2,)}, [1.0, 2.0]),
        ([1], "Real", {"shape": (2,)}, "it is a list of 2 values"),
        ([1, "x"], "Real", {"shape": (1, 2)}, "it is a number alone: no unit of it is declared"),
        ("180 deg", "Real", {"unit": "rad"}, pytest.approx(math.pi)),
        ("1 m", "Real", {}, "it is a number alone: no unit of it is declared"),
    ],
)
def test_a_start_value_is_of_the_type_within_the_bounds(given: Any, kind: str, more: Any, found: Any) -> None:
    assert fits(given, kind, **more) == found


def test_elements_of_an_array_are_put_into_its_list() -> None:
    array = variable(name="A", shape=(2, 2), start="1 2 3 4")
    of = {"A": array, "b": variable(name="b")}
    assert with_elements({"A[1,2]": 9}, of) == {"A": [1, 9, 3, 4]}
    assert with_elements({"A[1,2]": 9, "A[2,2]": 8, "b": 1}, of) == {"A": [1, 9, 3, 8], "b": 1}
    assert with_elements({"A": [5, 5, 5, 5], "A[1,1]": 9}, of) == {"A": [9, 5, 5, 5]}
    assert with_elements({"A[1,1]": 9}, {"A": variable(name="A", shape=(2, 2), start="7")}) == {"A": [9, 7, 7, 7]}
    assert with_elements({"A[1,1]": 9}, {"A": variable(name="A", shape=(2, 2), start=None)}) == {"A": [9, 0, 0, 0]}
    assert with_elements({"A[3,1]": 9, "b[1]": 2}, of) == {"A[3,1]": 9, "b[1]": 2}


# -- criteria ---------------------------------------------------------------------------------------


def evaluated(kind: str, **more: Any) -> dict[str, Any]:
    time = 10.0 + np.arange(5.0)
    signals = np.column_stack([[4.0, -2.0, 1.0, 1.0, 3.0], [1.0, 1.0, 1.0, 1.0, 1.0]])
    results = Results(time, ("a.y", "a.r"), signals, {"a.y": "m"})
    criterion = Criterion.model_validate({"of": "a.y", "max": 2.0} | more)
    (found,) = evaluate(SimpleNamespace(goals=[(kind, 0, criterion)], step=1.0), results)  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize(
    ("kind", "more", "value", "unit"),
    [
        ("peak", {}, 4.0, "m"),
        ("peak", {"to": 1.0}, 3.0, "m"),
        ("peak", {"to": "a.r", "after": 1.0}, 3.0, "m"),
        ("peak", {"after": 2.0}, 3.0, "m"),
        ("peak", {"after": 2.0, "until": 3.0}, 1.0, "m"),
        ("peak", {"until": 0.0}, 4.0, "m"),
        ("final_error", {"to": 1.0}, 2.0, "m"),
        ("final_error", {"to": 1.0, "until": 3.0}, 0.0, "m"),
        ("rms_error", {"to": 1.0, "after": 1.0}, math.sqrt((9 + 4) / 4), "m"),
        ("effort", {}, 8.0, "m.s"),
        ("settling_time", {"to": 1.0, "band": 0.5, "until": 3.0}, 1.0, "s"),
        ("settling_time", {"to": 1.0, "band": 0.5}, None, "s"),
        ("overshoot", {"to": 1.0, "until": 3.0}, 3.0, "m"),
    ],
)
def test_a_criterion_is_judged_within_its_times(kind: str, more: Any, value: Any, unit: str) -> None:
    found = evaluated(kind, **more)
    assert (found["value"], found["unit"]) == (value if value is None else pytest.approx(value), unit)
    assert found["met"] is (value is not None and value <= 2.0)


# -- the design of a sweep --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("runs", "count", "base"),
    [(4, 2, 1), (3, 2, 0), (7, 2, 1), (8, 2, 2), (100, 3, 16), (0, 1, 0), (80, 3, 16), (79, 3, 8)],
)
def test_saltelli_takes_the_largest_power_of_two_that_fits(runs: int, count: int, base: int) -> None:
    assert saltelli_base(runs, count) == base
    assert drawn_rows(count, False, runs, "saltelli") == base * (count + 2) <= runs
    assert drawn_rows(0, True, runs, "saltelli") == runs
    assert drawn_rows(0, False, runs, "sobol") == 1
