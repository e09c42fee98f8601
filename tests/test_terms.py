"""Terms of the general catalogue: binding to places, lags against exact solutions, printed C, terms of a user."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from cosim.fmi.building.file import own_terms
from cosim.model import (
    SCALAR,
    Asymmetry,
    DryFriction,
    FirstOrderLag,
    Model,
    Offset,
    QuadraticDrag,
    Quantity,
    ViscousFriction,
    parameter,
)
from cosim.terms.catalogue import (
    InputLag,
    Play,
    RateLimit,
    SecondOrderLag,
    Stribeck,
    bound_terms,
)
from cosim.terms.language import Force, Place, bind, unit_of

INPUT = Place("voltage", {"u": "V", "T": "s"}, {"u": 4.0, "T": 0.1}, input=0)
PAIR = Place(
    "speed", {"u": "V", "v": "rad/s", "q": "rad", "d": "rad"}, {"u": 4.0, "v": 10.0, "q": 3.0, "d": 9.0}, 0, 0, 1
)


LAW = parameter(0.0, unit="1", neutral=0.0, typical=1.0, doc="size")


@pytest.mark.parametrize(
    ("kind", "member", "more", "expected"),
    [
        (Offset, "value", {}, -1.0),
        (Asymmetry, "ratio", {}, 3.0),
        (DryFriction, "level", {"softness": 0.5}, -3.0 - 2.0 * math.tanh(-8.0)),
        (ViscousFriction, "coefficient", {}, 5.0),
        (QuadraticDrag, "coefficient", {}, 29.0),
    ],
)
def test_a_general_effect_changes_the_quantity_of_its_place_alone(
    kind: type[Any], member: str, more: dict[str, Any], expected: float
) -> None:
    effect = kind.named("rubs", place="axle", **more, **{member: LAW})
    model = type("Shaft", (Model,), {"catalogue": (effect,), "places": ("axle", "hub")})()
    at = model.with_values({f"rubs.{member}": 2.0}).effects_at(SCALAR)
    assert (at("axle", -3.0, -4.0), at("hub", -3.0, -4.0)) == (pytest.approx(expected, rel=1e-12), -3.0)
    assert model.effects_at(SCALAR)("axle", -3.0, -4.0) == -3.0


def test_a_lag_puts_its_states_in_place_of_the_quantities_it_follows() -> None:
    pair = (Quantity("left", "V", ""), Quantity("right", "V", ""))
    lags = (
        FirstOrderLag.named("late", place="valve", shortest=0.1, states=pair[:1], time=LAW),
        FirstOrderLag.named("slow", place="pumps", shortest=0.5, states=pair, time=LAW),
    )
    model = type("Pumps", (Model,), {"base_states": (), "catalogue": lags, "places": ("pumps", "valve")})()
    slow = model.with_values({"slow.time": 2.0, "late.time": 0.01})
    assert [q.name for q in slow.states] == ["late.left", "slow.left", "slow.right"]
    assert slow.lag_at(SCALAR, "pumps", (4.0, 1.0), (9.0, 3.0, 5.0)) == ((3.0, 5.0), (0.5, -2.0))
    assert slow.lag_at(SCALAR, "valve", (8.0,), (9.0, 3.0, 5.0)) == ((9.0,), (pytest.approx(-10.0),))
    assert model.lag_at(SCALAR, "pumps", (4.0, 1.0), ()) == ((4.0, 1.0), ())


@pytest.mark.parametrize(
    ("expression", "unit"),
    [("u", "V"), ("u/v", "V.s/rad"), ("u/v^2", "V.s2/rad2"), ("s/u", "s/V"), ("1", ""), ("u/x", "")],
)
def test_units_are_products_of_those_of_the_place(expression: str, unit: str) -> None:
    assert unit_of(expression, {"u": "V", "v": "rad/s", "x": "furlongs"}) == unit


@pytest.mark.parametrize("step", [0.01, 0.05])
def test_a_first_order_lag_is_exact_for_held_inputs(step: float) -> None:
    term, memory = bind(InputLag, INPUT)(time=0.3), (0.0, 0.0)
    commands = [1.0, 1.0, 3.0, 3.0, -2.0, -2.0, -2.0]
    value = commands[0]
    for command in commands:
        before = value
        value = command + (value - command) * math.exp(-step / 0.3)
        (mean,), memory = term.shape(SCALAR, 0.0, step, (command,), memory)
        assert memory[0] == pytest.approx(value, rel=1e-12)
        exact = command + (before - command) * (1.0 - math.exp(-step / 0.3)) * 0.3 / step
        assert mean == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("damping", [0.05, 0.4, 2.5])
def test_a_lag_of_second_order_is_exact_for_steps_of_any_length(damping: float) -> None:
    time, step, count = 0.2, 0.5, 20
    term, memory = bind(SecondOrderLag, INPUT)(time=time, damping=damping), (0.0, 0.0, 0.0)
    (_,), memory = term.shape(SCALAR, 0.0, step, (0.0,), memory)
    ends, means = [], []
    for _ in range(count):
        (mean,), memory = term.shape(SCALAR, 0.0, step, (1.0,), memory)
        means.append(mean)
        ends.append(memory[0])
    fine = np.linspace(0.0, count * step, 200 * count + 1)
    _, exact, _ = lsim(([1.0], [time**2, 2.0 * damping * time, 1.0]), np.ones(fine.size), fine)
    assert np.abs(ends - exact[200::200]).max() < 1e-9
    assert np.abs(means - 0.5 * (exact[1:] + exact[:-1]).reshape(count, 200).mean(axis=1)).max() < 1e-4


def test_play_and_rate_limit_begin_at_the_first_input() -> None:
    play, limit = bind(Play, INPUT)(width=0.5), bind(RateLimit, INPUT)(inverse_rate=0.5)
    (value,), memory = play.shape(SCALAR, 0.0, 0.1, (2.0,), (0.0, 0.0))
    assert value == 2.0
    (value,), memory = play.shape(SCALAR, 0.1, 0.1, (2.4,), memory)
    assert value == 2.0
    (value,), _ = play.shape(SCALAR, 0.2, 0.1, (3.0,), memory)
    assert value == pytest.approx(2.5)
    (value,), memory = limit.shape(SCALAR, 0.0, 0.1, (2.0,), (0.0, 0.0))
    (value,), memory = limit.shape(SCALAR, 0.1, 0.1, (5.0,), memory)
    assert (value, memory[0]) == (pytest.approx(2.1), pytest.approx(2.2))  # mean and end at two per second


def test_friction_that_is_larger_at_rest_falls_to_its_level() -> None:
    term = bind(Stribeck, PAIR)(level=1.0, breakaway=2.0, speed=0.5, softness=0.02)
    assert -term.force(SCALAR, 0.0, 0.1) == pytest.approx(1.0 + math.exp(-0.04), rel=1e-3)
    assert -term.force(SCALAR, 0.0, 10.0) == pytest.approx(1.0)


def test_a_users_file_adds_terms(tmp_path: Path) -> None:
    file = tmp_path / "my_terms.py"
    file.write_text(
        "from cosim.terms import Force, scaled\n\n"
        "class Windage(Force):\n"
        '    kind = "windage"\n    equation = "-c*v^3"\n'
        '    coefficient: float = scaled("u/v^3", neutral=0.0, typical=0.1, low=0.0, doc="coefficient")\n\n'
        "    def force(self, m, position, velocity):\n        return -self.coefficient * velocity**3\n"
    )
    (windage,) = own_terms(file)
    assert issubclass(windage, Force)
    (bound,) = [t for t in bound_terms([INPUT, PAIR], [windage]) if t.name.startswith("windage")]
    assert (bound.name, bound(coefficient=2.0).force(SCALAR, 0.0, 3.0)) == ("windage_at_speed", -54.0)
