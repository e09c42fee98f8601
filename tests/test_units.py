"""Units: what their symbols mean in SI, and the definitions an FMU carries."""

from __future__ import annotations

import math

import pytest

from cosim.core.units import (
    SYMBOLS,
    factor,
    parse,
    unit_definitions,
    unit_of_rate,
)

BASE = {"kg", "m", "s", "A", "K", "mol", "cd", "rad"}  # FMI 2.0, 2.2.2


@pytest.mark.parametrize(
    ("written", "exponents", "size"),
    [
        ("V", "A:-1 kg:1 m:2 s:-3", 1.0),
        ("ohm", "A:-2 kg:1 m:2 s:-3", 1.0),
        ("F", "A:2 kg:-1 m:-2 s:4", 1.0),
        ("N·m·s/rad", "kg:1 m:2 rad:-1 s:-1", 1.0),
        ("mm/s2", "m:1 s:-2", 1e-3),
        ("gf/%", "kg:1 m:1 s:-2", 0.980665),
    ],
)
def test_a_unit_is_what_its_symbols_make(written: str, exponents: str, size: float) -> None:
    unit = parse(written)
    assert unit is not None
    assert " ".join(sorted(f"{name}:{power}" for name, power in unit.exponents.items())) == exponents
    assert unit.factor == pytest.approx(size, rel=1e-15)  # one or two roundings


@pytest.mark.parametrize("written", ["rpm", "U/min", "1/min", "min-1", "rev/min"])
def test_turns_per_minute_are_one_unit_however_they_are_written(written: str) -> None:
    assert factor(written, "rpm") == pytest.approx(1.0, rel=1e-12)
    assert factor(written, "rad/s") == pytest.approx(math.pi / 30.0, rel=1e-12)
    assert factor("rad/s", written) == pytest.approx(30.0 / math.pi, rel=1e-12)
    assert factor("1/s", "rad/s") is None
    assert factor("1/min", "Hz") == pytest.approx(1.0 / 60.0)


@pytest.mark.parametrize(
    "pair",
    ["V/A=ohm", "Ω=ohm", "\u2126=ohm", "V.s/A=H", "V.A=W", "J=N.m", "A.s/V=F", "Wb=V.s", "T=Wb/m2", "S=1/ohm", "C=A.s",
     "Pa=N/m2", "1/s=Hz"],
)  # fmt: skip
def test_units_of_one_dimension_are_one(pair: str) -> None:
    assert factor(*pair.split("=")) == 1.0


@pytest.mark.parametrize("text", ["", "furlong", "N.m/", "rad^", "N m²/(rad s)"])
def test_what_is_no_unit_is_told(text: str) -> None:
    assert parse(text) is None
    with pytest.raises(ValueError, match="unknown unit"):
        unit_definitions({text})


def test_every_symbol_has_a_size_and_the_base_units_of_fmi() -> None:
    for symbol, unit in SYMBOLS.items():
        assert unit.factor > 0.0, symbol
        assert unit.exponents.keys() <= BASE, symbol
        assert parse(symbol) == unit


def test_a_definition_has_exponents_factor_and_the_degrees_of_angles() -> None:
    root = unit_definitions({"V", "mA", "rad", "1"})
    found = {node.get("name"): {child.tag: dict(child.attrib) for child in node} for node in root}
    degrees = {"name": "deg", "factor": repr(180.0 / math.pi)}
    assert found == {
        "V": {"BaseUnit": {"kg": "1", "m": "2", "s": "-3", "A": "-1"}},
        "mA": {"BaseUnit": {"A": "1", "factor": "0.001"}},
        "1": {"BaseUnit": {}},
        "rad": {"BaseUnit": {"rad": "1"}, "DisplayUnit": degrees},
    }


def test_a_derivative_by_time_has_the_unit_of_a_rate() -> None:
    assert [unit_of_rate(unit) for unit in ("rad", "m/s", "")] == ["rad/s", "m/s2", "1/s"]
