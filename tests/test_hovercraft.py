"""The craft: signs, frames, hover, start values, roll, and what it refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosim.model import SCALAR, Stepper, parameters_of
from plant.hovercraft import Hovercraft
from tests.independent import flown

CRAFT = Hovercraft()
STATE = [q.name for q in CRAFT.states]
HOVER = CRAFT.start_command()


def rate(command: tuple[float, ...] = HOVER, craft: Hovercraft = CRAFT, **start: float) -> dict[str, float]:
    """Derivative by state name."""
    values = craft.equations(SCALAR).derivative(0.0, craft.start(start), command)
    return dict(zip([q.name for q in craft.states], values, strict=True))


def output(craft: Hovercraft = CRAFT, **start: float) -> dict[str, float]:
    values = craft.equations(SCALAR).output(0.0, craft.start(start), HOVER)
    return dict(zip([q.name for q in craft.outputs], values, strict=True))


def test_unconnected_plant_hovers() -> None:
    assert rate() == dict.fromkeys(STATE, 0.0)
    y = flown(Stepper(CRAFT), [HOVER] * 50)
    for name, trace in y.items():
        assert np.ptp(trace) == 0.0, name
    assert y["thrust_right"][0] == pytest.approx(2.4973, abs=6e-6)  # T_N, eq 5.36; δ_N is rounded to 1e-6 %


def test_any_craft_hovers_at_its_own_nominal_duty() -> None:
    craft = Hovercraft(thrust_slope=380.0, duty_nominal=6.2, mass=0.9, gravity=9.78)
    assert set(rate(craft.start_command(), craft).values()) == {0.0}
    assert craft.start()[STATE.index("thrust_right")] == pytest.approx((-2076 + 380 * 6.2) * 9.78e-3, rel=1e-14)


# Signs, in the axes that eqs 5.6-5.8 admit: x forward, y right, ψ left, φ right side up.


@pytest.mark.parametrize(
    ("cause", "start", "effect"),
    [
        ("tilt forward pushes forward (5.9)", {"tilt_right": 0.1, "tilt_left": 0.1}, {"vx": +1, "psi_dot": 0, "vy": 0}),
        ("right thrust forward turns left (5.7)", {"tilt_right": 0.1, "tilt_left": -0.1}, {"vx": 0, "psi_dot": +1}),
        ("more thrust right lifts the right side (5.8)", {"thrust_right": 2.5}, {"phi_dot": +1, "vx": 0}),
        ("leaning to the left drifts to the left (5.6)", {"phi": 0.05}, {"vy": -1}),
        ("table resists forward motion (5.5)", {"vx": 1.0}, {"vx": -1, "vy": 0}),
        ("table resists sideways motion", {"vy": 1.0}, {"vy": -1, "vx": 0}),
        ("air cushion pushes the raised side down", {"phi": 0.05}, {"phi_dot": -1}),
    ],
)
def test_signs(cause: str, start: dict[str, float], effect: dict[str, int]) -> None:
    got = rate(**start)
    assert {name: int(np.sign(got[name])) for name in effect} == effect, cause


def test_start_values_are_what_the_first_row_shows() -> None:
    names = [n for n in STATE if not n.startswith("thrust")]
    start = {name: 0.01 * (k + 1) for k, name in enumerate(names)} | {"thrust_right": 2.0, "thrust_left": 2.2}
    y = output(**start, craft=Hovercraft(roll_ground_effect=False))
    gain = y["thrust_right"] / 2.0
    assert gain == pytest.approx(1.142024, abs=5e-7)  # the start is T_R without ground effect, the output with
    assert y["thrust_left"] == pytest.approx(2.2 * gain, rel=1e-14)
    expected = {**start, "tilt_right_actual": start["tilt_right"], "tilt_left_actual": start["tilt_left"]}
    for name in set(y) - {"thrust_right", "thrust_left", "ax"}:
        assert y[name] == expected[name], name


# Roll: what the sheet says of the thesis' eq 5.14 and of the support that is ours.


# Refusals.


@pytest.mark.parametrize("name", [p.name for p in parameters_of(Hovercraft) if not isinstance(p.default, bool)])
def test_parameters_are_refused_just_outside_their_bounds_and_taken_on_them(name: str) -> None:
    (declared,) = [p for p in parameters_of(Hovercraft) if p.name == name]
    for bound, outside in zip(declared.bounds, (-1.0, 1.0), strict=True):
        assert getattr(Hovercraft(**{name: float(bound)}), name) == bound
        with pytest.raises(ValueError, match=name):
            Hovercraft(**{name: math.nextafter(bound, outside * math.inf)})


def test_values_by_name_reach_parameters_and_effects_and_nothing_else() -> None:
    craft = CRAFT.with_values({"mass": 0.8, "table_tilt.x": 0.01, "servo_backlash.width": 0.02})
    assert craft.mass == 0.8
    assert [(e.name, e.dormant) for e in craft.effects] == [("servo_backlash", False), ("table_tilt", False)]
    assert CRAFT.mass == 0.705  # a model is changed by making another
    assert CRAFT.effects == ()
    for unknown in ("masss", "table_tilt.z", "gremlins.force"):
        with pytest.raises(KeyError):
            CRAFT.with_values({unknown: 0.1})
