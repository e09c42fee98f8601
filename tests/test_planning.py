"""What is decided by numbers: start values that fit their variables, and criteria."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.files.results import Results
from cosim.scenario.scenario import Criterion
from cosim.scenario.start_values import convert_value
from cosim.simulation.criteria import evaluate

# -- start values -----------------------------------------------------------------------------------


def variable(kind: str = "Real", **more: Any) -> Any:
    default = {
        "name": "v", "type": kind, "shape": (), "causality": "parameter", "variability": "fixed", "initial": "exact",
        "start": "0", "min": None, "max": None, "declaredType": None, "unit": None, "relativeQuantity": None,
    }  # fmt: skip
    return SimpleNamespace(**(default | more))


def fits(given: Any, kind: str = "Real", version: str = "2.0", **more: Any) -> Any:
    try:
        return convert_value(SimpleNamespace(fmiVersion=version, unitDefinitions=[]), variable(kind, **more), given)
    except ValueError as error:
        return str(error)


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
