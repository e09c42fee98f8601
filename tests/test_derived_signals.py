"""Derived signals: functions over time, units of every function, gaps, wrong formulas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.viewing.derived_signals import FUNCTIONS, Formula, derivative, integral, lowpass
from cosim.viewing.pyramid import TIME, Recording
from tests.conftest import ROOT

RNG = np.random.default_rng
Array = np.ndarray[Any, np.dtype[np.float64]]


def _recording(time: Array, units: Mapping[str, str] | None = None, **signals: Array) -> Recording:
    return Recording({TIME: time, **signals}, units or dict.fromkeys(signals, "m"), time.size)


def _of_constants(text: str, **signals: tuple[float, str]) -> tuple[float, str]:
    """The value and the unit of a formula of constant signals."""
    time = np.arange(4.0)
    columns = {name: np.full(4, value) for name, (value, _) in signals.items()}
    run = _recording(time, {name: unit for name, (_, unit) in signals.items()}, **columns)
    values, unit = Formula(text, {name: (run, name) for name in signals}).evaluate()
    return float(values[1]), unit


def test_filters_derivatives_and_integrals_are_those_of_their_definitions() -> None:
    time = np.sort(RNG(4).random(2000)) * 10.0
    np.testing.assert_allclose(derivative(time, 3.0 * time + 1.0), 3.0, rtol=1e-6)
    assert integral(time, 2.0 * time)[-1] == pytest.approx(time[-1] ** 2 - time[0] ** 2)
    answer = lowpass(time, np.r_[0.0, np.ones(1999)], 0.5)  # a step at the second row
    np.testing.assert_allclose(answer[1:], 1.0 - np.exp(-(time[1:] - time[1]) / 0.5), atol=1e-9)
    uniform = np.arange(500) * 0.01
    values = RNG(5).standard_normal(500)
    uneven = uniform.copy()
    uneven[499] += 1e-3  # takes the other way, row by row
    np.testing.assert_allclose(lowpass(uniform, values, 0.2)[:499], lowpass(uneven, values, 0.2)[:499], rtol=1e-9)
    steps = derivative(np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 1.0, 5.0, 6.0]))
    assert np.isnan(steps[1:3]).all()
    assert steps[0] == 1.0


def test_a_formula_takes_signals_of_other_runs_and_units() -> None:
    first = _recording(np.array([0.0, 1.0, 2.0]), x=np.array([1.0, 2.0, 3.0]))
    second = Recording({TIME: np.array([0.0, 2.0]), "x": np.array([0.0, 2000.0])}, {"x": "mm"}, 2)
    values, unit = Formula("a - b", {"a": (first, "x"), "b": (second, "x")}).evaluate()
    np.testing.assert_allclose(values, [1.0, 1.0, 1.0])
    assert unit == "m"
    assert Formula("-der(2*a) + 0", {"a": (first, "x")}).evaluate()[1] == "m/s"
    np.testing.assert_allclose(Formula("hypot(3, 4) + 0*a", {"a": (first, "x")}).evaluate()[0], 5.0)


@pytest.mark.parametrize(
    "text",
    ["a.x", "__import__('os')", "a +", "q", "der(a, 1)", "lowpass(a, a)", "a if a else a", "f(a)", "(" * 300, "'a'"],
)
def test_a_wrong_formula_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        Formula(text, {"a": (_recording(np.arange(3.0), x=np.ones(3)), "x")}).evaluate()


# -- units ---------------------------------------------------------------------------------------------

UNITS = [  # formula, signals, value, unit
    ("a + b", {"a": (1.0, "m"), "b": (500.0, "mm")}, 1.5, "m"),
    ("a - b", {"a": (1.0, "m"), "b": (2.0, "")}, -1.0, "m"),
    ("a - b", {"a": (3.0, ""), "b": (2.0, "m")}, 1.0, "m"),
    ("a - b + 1", {"a": (1.0, "furlong"), "b": (2.0, "furlong")}, 0.0, "furlong"),
    ("max(a, b)", {"a": (1.0, "m"), "b": (500.0, "mm")}, 1.0, "m"),
    ("min(a, b)", {"a": (1.0, "m"), "b": (500.0, "mm")}, 0.5, "m"),
    ("max(a, 2)", {"a": (1.0, "m")}, 2.0, "m"),
    ("hypot(a, b)", {"a": (3.0, "m"), "b": (4000.0, "mm")}, 5.0, "m"),
    ("atan2(a, b)", {"a": (1.0, "m"), "b": (1000.0, "mm")}, np.pi / 4, "rad"),
    ("abs(a)", {"a": (-1.0, "m")}, 1.0, "m"),
    ("sin(a)", {"a": (90.0, "deg")}, 1.0, "1"),
    ("cos(a)", {"a": (0.5, "rev")}, -1.0, "1"),
    ("tan(a)", {"a": (0.25, "")}, np.tan(0.25), "1"),
    ("sin(2 * a + t)", {"a": (1.0, "")}, np.sin(3.0), "1"),
    ("asin(a)", {"a": (100.0, "%")}, np.pi / 2, "rad"),
    ("acos(a / b)", {"a": (500.0, "mm"), "b": (1.0, "m")}, np.pi / 3, "rad"),
    ("atan(a)", {"a": (1.0, "1")}, np.pi / 4, "rad"),
    ("exp(-t / 0.5) * a", {"a": (1.0, "V")}, np.exp(-2.0), "V"),
    ("log(a / b)", {"a": (1.0, "kN"), "b": (1.0, "N")}, np.log(1000.0), "1"),
    ("log10(a)", {"a": (100.0, "")}, 2.0, "1"),
    ("sqrt(a)", {"a": (4.0, "m2/s2")}, 2.0, "m/s"),
    ("a ** 0.5", {"a": (4.0, "J/kg")}, 2.0, "m/s"),
    ("a ** 2", {"a": (3.0, "m/s")}, 9.0, "m2/s2"),
    ("2 ** a", {"a": (300.0, "%")}, 8.0, ""),
    ("a * b", {"a": (2.0, "N"), "b": (3.0, "m/s")}, 6.0, "N.m/s"),
    ("a * b", {"a": (2.0, "m"), "b": (500.0, "mm")}, 1.0, "m2"),
    ("a * b", {"a": (36.0, "km/h"), "b": (2.0, "s")}, 20.0, "m"),
    ("a * b", {"a": (2.0, "N"), "b": (3.0, "")}, 6.0, ""),
    ("a / b", {"a": (1.0, "m"), "b": (1.0, "cm")}, 100.0, "1"),
    ("a / 2", {"a": (1.0, "m")}, 0.5, "m"),
    ("1 / a", {"a": (0.5, "s")}, 2.0, "1/s"),
    ("der(a * t)", {"a": (3.0, "m")}, 3.0, "m"),
    ("der(a)", {"a": (3.0, "deg")}, 0.0, "deg/s"),
    ("integral(a)", {"a": (36.0, "km/h")}, 10.0, "m"),
    ("integral(a)", {"a": (2.0, "W")}, 2.0, "W.s"),
    ("lowpass(a, 0.5)", {"a": (2.0, "degC")}, 2.0, "degC"),
    ("number(a) + number(b)", {"a": (1.0, "m"), "b": (2.0, "N")}, 3.0, ""),
    # temperatures
    ("a - b", {"a": (20.0, "degC"), "b": (293.15, "K")}, 0.0, "K"),
    ("a - b", {"a": (293.15, "K"), "b": (10.0, "degC")}, 10.0, "K"),
    ("a - b", {"a": (50.0, "degF"), "b": (0.0, "degC")}, 10.0, "K"),
    ("a + b", {"a": (20.0, "degC"), "b": (5.0, "K")}, 25.0, "degC"),
    ("a - (b - c)", {"a": (20.0, "degC"), "b": (9.0, "degC"), "c": (4.0, "degC")}, 15.0, "degC"),
    ("(a + b) / 2", {"a": (10.0, "degC"), "b": (86.0, "degF")}, 20.0, "degC"),
    ("max(a, b)", {"a": (10.0, "degC"), "b": (300.0, "K")}, 26.85, "degC"),
    ("a * b", {"a": (2.0, "J/K"), "b": (0.0, "degC")}, 546.3, "J"),
    ("der(a + number(9 * t))", {"a": (9.0, "degF")}, 5.0, "K/s"),
]


@pytest.mark.parametrize(("text", "signals", "value", "unit"), UNITS, ids=[case[0] for case in UNITS])
def test_units_of_a_formula_are_converted_and_combined(
    text: str, signals: dict[str, tuple[float, str]], value: float, unit: str
) -> None:
    found, made = _of_constants(text, **signals)
    assert (found, made) == (pytest.approx(value, rel=1e-12, abs=1e-12), unit)


@pytest.mark.parametrize(
    ("text", "units", "code"),
    [
        ("a + b", ("m", "N"), "E-VIE-018"),
        ("a - b", ("m", "furlong"), "E-VIE-018"),
        ("max(a, b)", ("m", "s"), "E-VIE-018"),
        ("hypot(a, b)", ("m", "rad"), "E-VIE-018"),
        ("atan2(a, b)", ("m", "1"), "E-VIE-018"),
        ("sin(a)", ("m", ""), "E-VIE-019"),
        ("log(b)", ("", "Pa"), "E-VIE-019"),
        ("2 ** b", ("", "m"), "E-VIE-019"),
        ("sqrt(a)", ("N", ""), "E-VIE-020"),
        ("a ** 2.718", ("m", ""), "E-VIE-020"),
        ("a ** b", ("m", ""), "E-VIE-021"),
        ("a + b", ("degC", "degC"), "E-VIE-022"),
        ("max(2 * a, b)", ("degC", "degC"), "E-VIE-022"),
    ],
)
def test_quantities_that_do_not_fit_are_refused_by_their_units(text: str, units: tuple[str, str], code: str) -> None:
    with pytest.raises(InputError) as refused:
        _of_constants(text, a=(1.0, units[0]), b=(2.0, units[1]))
    message = refused.value.faults[0].message
    assert message.code == code  # type: ignore[attr-defined]
    assert any(unit in message for unit in units if unit)


def test_every_function_is_in_the_table_of_the_docs() -> None:
    page = (ROOT / "docs" / "view.md").read_text(encoding="utf-8")
    table = page.partition("## Derived signals")[2].partition("\n## ")[0]
    assert [name for name in FUNCTIONS if f"`{name}(" not in table] == []


def test_gaps_are_bridged_with_a_note_and_rows_of_other_signals_do_not_count() -> None:
    time = np.arange(7.0)
    gap = np.array([1.0, 1.0, np.nan, np.nan, 1.0, 1.0, np.nan])
    formula = Formula("integral(a)", {"a": (_recording(time, x=gap), "x")}, "way")
    np.testing.assert_array_equal(formula.evaluate()[0], [0, 1, np.nan, np.nan, 4, 5, np.nan])
    assert [str(note) for note in formula.notes] == [
        "way: 1 gap without values, at most 3 s, are bridged by straight lines"
    ]
    sparse = np.array([0.0, np.nan, 2.0, np.nan, 4.0, np.nan, 6.0])
    slope = Formula("der(a)", {"a": (_recording(time, x=sparse), "x")}).evaluate()[0]
    np.testing.assert_array_equal(slope, [1, np.nan, 1, np.nan, 1, np.nan, 1])
    smooth = Formula("lowpass(a, 2)", {"a": (_recording(time, x=sparse), "x")}).evaluate()[0]
    np.testing.assert_allclose(smooth[::2], lowpass(time[::2], sparse[::2], 2.0))


@pytest.mark.parametrize(
    ("text", "unit", "code"),
    [("sqrt(-a)", "", "N-VIE-025"), ("der(a)", "furlong", "N-VIE-026"), ("a + 1", "furlong", ""), ("a", "m", "")],
)
def test_a_result_without_values_or_unit_is_noted(text: str, unit: str, code: str) -> None:
    run = _recording(np.arange(3.0), {"x": unit}, x=np.ones(3))
    formula = Formula(text, {"a": (run, "x")})
    formula.evaluate()
    assert [note.code for note in formula.notes] == [code] * bool(code)
