"""Derived signals: functions over time, values of every function, gaps, wrong formulas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.pages.formulas import derivative, evaluate, integral, lowpass
from cosim.pages.rows import TIME_COLUMN, Recording

RNG = np.random.default_rng
Array = np.ndarray[Any, np.dtype[np.float64]]


def of(text: str, time: Any, **signals: Any) -> Array:
    """The values of a formula of signals."""
    time = np.asarray(time, dtype=float)
    rows = {name: np.broadcast_to(np.asarray(values, dtype=float), time.shape) for name, values in signals.items()}
    run = Recording({TIME_COLUMN: time, **rows}, dict.fromkeys(signals, "m"))
    return evaluate(text, {name: (run, name) for name in signals})


def test_filters_derivatives_and_integrals_are_those_of_their_definitions() -> None:
    time = np.sort(RNG(4).random(2000)) * 10.0
    np.testing.assert_allclose(derivative(time, 3.0 * time + 1.0), 3.0, rtol=1e-6)
    assert integral(time, 2.0 * time)[-1] == pytest.approx(time[-1] ** 2 - time[0] ** 2)
    answer = lowpass(time, np.r_[0.0, np.ones(1999)], 0.5)  # a step at the second row
    np.testing.assert_allclose(answer[1:], 1.0 - np.exp(-(time[1:] - time[1]) / 0.5), atol=1e-9)
    uniform, values = np.arange(500) * 0.01, RNG(5).standard_normal(500)
    uneven = uniform + np.where(np.arange(500) == 499, 1e-3, 0.0)
    np.testing.assert_allclose(lowpass(uniform, values, 0.2)[:499], lowpass(uneven, values, 0.2)[:499], rtol=1e-9)
    steps = derivative(np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 1.0, 5.0, 6.0]))
    np.testing.assert_array_equal(steps[:3], [1.0, np.nan, np.nan])


def test_a_formula_takes_signals_of_other_runs() -> None:
    first, second = (
        Recording({TIME_COLUMN: t, "x": t + k}, {"x": "m"}) for k, t in ((1, np.arange(3.0)), (0, np.array([0.0, 2.0])))
    )
    values = evaluate("a - b", {"a": (first, "x"), "b": (second, "x")})
    np.testing.assert_allclose(values, [1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    "text",
    ["a.x", "__import__('os')", "a +", "q", "der(a, 1)", "lowpass(a, a)", "a if a else a", "f(a)", "a // 2", "(" * 300],
)
def test_a_wrong_formula_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        of(text, [0, 1, 2], a=1)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a - b - 1", -2.0),
        ("-a * +b", -6.0),
        ("b / a + b ** a", 10.5),
        ("2 ** -a + 0 * b", 0.25),
        ("min(a, b) + 10 * max(a, b)", 32.0),
        ("hypot(a + 1, b + 1)", 5.0),
        ("atan2(a, a) + 0 * b", np.pi / 4),
        ("abs(-a) * b", 6.0),
        ("sin(2 * a + t) * b", 3.0 * np.sin(5.0)),
        ("cos(a) + tan(b)", np.cos(2.0) + np.tan(3.0)),
        ("asin(a / 2) + acos(b / 3) + atan(a / 2)", 0.75 * np.pi),
        ("log(exp(a)) + log10(100 * b / b)", 4.0),
        ("sqrt(2 * a * b / b)", 2.0),
        ("der(a * b * t)", 6.0),
        ("integral(a * b)", 6.0),
        ("lowpass(a * b, 0.5)", 6.0),
        ("1e999 - a * b", np.inf),
    ],
)
def test_a_formula_has_the_value_of_its_numbers(text: str, value: float) -> None:
    assert of(text, range(4), a=2, b=3)[1] == pytest.approx(value, rel=1e-12)


def test_gaps_are_bridged_and_rows_of_other_signals_do_not_count() -> None:
    nan, time = np.nan, np.arange(7.0)
    way = of("integral(a)", time, a=[1, 1, nan, nan, 1, 1, nan])
    np.testing.assert_array_equal(way, [0, 1, nan, nan, 4, 5, nan])
    sparse = np.where(time % 2 == 0, time, nan)
    np.testing.assert_array_equal(of("der(a)", time, a=sparse), [1, nan, 1, nan, 1, nan, 1])
    smooth = of("lowpass(a, 2)", time, a=sparse)
    np.testing.assert_allclose(smooth[::2], lowpass(time[::2], sparse[::2], 2.0))
