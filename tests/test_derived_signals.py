"""Derived signals: functions over time, values of every function, gaps, wrong formulas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.pages.formulas import derivative, evaluate, integral, lowpass
from cosim.pages.rows import TIME, Recording

RNG = np.random.default_rng
Array = np.ndarray[Any, np.dtype[np.float64]]


def _recording(time: Array, **signals: Array) -> Recording:
    return Recording({TIME: time, **signals}, dict.fromkeys(signals, "m"), time.size)


def _of_constants(text: str, **signals: float) -> float:
    """The value of a formula of constant signals."""
    run = _recording(np.arange(4.0), **{name: np.full(4, value) for name, value in signals.items()})
    return float(evaluate(text, {name: (run, name) for name in signals})[0][1])


def test_filters_derivatives_and_integrals_are_those_of_their_definitions() -> None:
    time = np.sort(RNG(4).random(2000)) * 10.0
    np.testing.assert_allclose(derivative(time, 3.0 * time + 1.0), 3.0, rtol=1e-6)
    assert integral(time, 2.0 * time)[-1] == pytest.approx(time[-1] ** 2 - time[0] ** 2)
    answer = lowpass(time, np.r_[0.0, np.ones(1999)], 0.5)  # a step at the second row
    np.testing.assert_allclose(answer[1:], 1.0 - np.exp(-(time[1:] - time[1]) / 0.5), atol=1e-9)
    uniform = np.arange(500) * 0.01
    values = RNG(5).standard_normal(500)
    uneven = uniform.copy()
    uneven[499] += 1e-3
    np.testing.assert_allclose(lowpass(uniform, values, 0.2)[:499], lowpass(uneven, values, 0.2)[:499], rtol=1e-9)
    steps = derivative(np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 1.0, 5.0, 6.0]))
    assert np.isnan(steps[1:3]).all()
    assert steps[0] == 1.0


def test_a_formula_takes_signals_of_other_runs() -> None:
    first = _recording(np.array([0.0, 1.0, 2.0]), x=np.array([1.0, 2.0, 3.0]))
    second = Recording({TIME: np.array([0.0, 2.0]), "x": np.array([0.0, 2.0])}, {"x": "m"}, 2)
    values, notes = evaluate("a - b", {"a": (first, "x"), "b": (second, "x")})
    np.testing.assert_allclose(values, [1.0, 1.0, 1.0])
    assert notes == []


@pytest.mark.parametrize(
    "text",
    [
        "a.x",
        "__import__('os')",
        "a +",
        "q",
        "der(a, 1)",
        "lowpass(a, a)",
        "a if a else a",
        "f(a)",
        "number(a)",
        "a // 2",
        "(" * 300,
        "'a'",
    ],
)
def test_a_wrong_formula_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        evaluate(text, {"a": (_recording(np.arange(3.0), x=np.ones(3)), "x")})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a + b", 5.0),
        ("a - b - 1", -2.0),
        ("-a * +b", -6.0),
        ("b / a", 1.5),
        ("b ** a", 9.0),
        ("2 ** -a", 0.25),
        ("min(a, b) + 10 * max(a, b)", 32.0),
        ("hypot(3, 4) + 0 * a", 5.0),
        ("atan2(a, a)", np.pi / 4),
        ("abs(-a)", 2.0),
        ("sin(2 * a + t)", np.sin(5.0)),
        ("cos(a) + tan(a)", np.cos(2.0) + np.tan(2.0)),
        ("asin(a / 2) + acos(a / 2) + atan(a / 2)", 0.75 * np.pi),
        ("log(exp(a)) + log10(100)", 4.0),
        ("sqrt(2 * a)", 2.0),
        ("der(a * t)", 2.0),
        ("integral(a)", 2.0),
        ("lowpass(a, 0.5)", 2.0),
        ("1e999 - 0 * a", np.inf),
    ],
)
def test_a_formula_has_the_value_of_its_numbers(text: str, value: float) -> None:
    signals = {"a": 2.0} | ({"b": 3.0} if "b" in text.replace("abs", "") else {})
    assert _of_constants(text, **signals) == pytest.approx(value, rel=1e-12)


def test_gaps_are_bridged_with_a_note_and_rows_of_other_signals_do_not_count() -> None:
    time = np.arange(7.0)
    gap = np.array([1.0, 1.0, np.nan, np.nan, 1.0, 1.0, np.nan])
    way, notes = evaluate("integral(a)", {"a": (_recording(time, x=gap), "x")}, "way")
    np.testing.assert_array_equal(way, [0, 1, np.nan, np.nan, 4, 5, np.nan])
    assert len(notes) == 1
    sparse = np.array([0.0, np.nan, 2.0, np.nan, 4.0, np.nan, 6.0])
    slope, _ = evaluate("der(a)", {"a": (_recording(time, x=sparse), "x")})
    np.testing.assert_array_equal(slope, [1, np.nan, 1, np.nan, 1, np.nan, 1])
    smooth, _ = evaluate("lowpass(a, 2)", {"a": (_recording(time, x=sparse), "x")})
    np.testing.assert_allclose(smooth[::2], lowpass(time[::2], sparse[::2], 2.0))
