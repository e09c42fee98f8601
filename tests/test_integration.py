"""Integration: the plant against the model written a second time, and the arithmetic of steps."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from cosim.model import parameters_of
from cosim.model.integrate import Stepper
from plant.effects import CATALOGUE
from plant.hovercraft import Hovercraft
from tests.independent import excitation, flown, simulate
from tests.test_effects import MOVING, Fine, largest_difference

NO_SUPPORT = {"table_roll_stiffness": 0.0, "table_roll_damping": 0.0}, {"k_t": 0.0, "d_t": 0.0}


@pytest.mark.parametrize(
    ("craft", "numbers"),
    [
        ({}, {}),
        NO_SUPPORT,
        (NO_SUPPORT[0] | {"roll_ground_effect": False}, NO_SUPPORT[1] | {"own_height": 0.0}),
        (
            {"mass": 1.1, "izz": 0.02, "ixx": 0.015, "arm": 0.2, "propeller_radius": 0.1, "height": 0.12},
            {"m": 1.1, "Izz": 0.02, "Ixx": 0.015, "L": 0.2, "R": 0.1, "z": 0.12},
        ),
        (
            {"thrust_offset": -1900.0, "thrust_slope": 340.0, "ground_effect_exponent": 1.5, "gravity": 9.78},
            {"a": -1900.0, "b": 340.0, "k": 1.5, "g": 9.78},
        ),
        ({"lag": 0.12, "friction": 0.6}, {"tau": 0.12, "c": 0.6}),
    ],
    ids=["thesis", "no support", "eq 5.14", "other body", "other propeller", "other lag"],
)
def test_every_parameter_means_the_same_in_both(craft: dict[str, float], numbers: dict[str, float]) -> None:
    # One second: without support a gentle excitation keeps both heights above R/2, where Γ has a kink.
    # RK4 at 0.5 ms: the base model's 5e-6 at 5 ms, 10⁴ times less; 1e-8 leaves a factor 20.
    commands = excitation(50, duty=0.05)
    commands[:, 2:] *= 0.5
    hover = {name: (Hovercraft(**craft).start_state()[name]) for name in ("thrust_right", "thrust_left")}
    for start in ({}, MOVING):
        exact = simulate(commands, {}, numbers, hover | start)
        got = largest_difference(flown(Stepper(Fine(**craft)), commands, start), exact)
        assert got < 1e-8


def test_a_propeller_at_the_lowest_height_is_integrated_across_the_kink() -> None:
    # φ = 0.3 rad puts the left propeller below R/2, where Γ stays constant. RK4 meets the kink once:
    # one substep of the slope's jump, h²/8 · jump ≈ 1e-4 in the roll rate; a hundred times less at h/10.
    start = {"phi": 0.3}
    commands = excitation(50, duty=0.1)
    exact = simulate(commands, start=start)
    assert largest_difference(flown(Stepper(Hovercraft()), commands, start), exact) < 2e-4
    assert largest_difference(flown(Stepper(Fine()), commands, start), exact) < 2e-6


def test_error_falls_with_the_fourth_power_of_the_substep() -> None:
    commands = excitation(50)
    exact = simulate(commands, start=MOVING)
    errors = []
    for length in (0.02, 0.01, 0.005):
        craft = type("Craft", (Hovercraft,), {"substep": length})()
        errors.append(largest_difference(flown(Stepper(craft), commands, MOVING), exact))
    for coarse, fine in itertools.pairwise(errors):
        assert 12 < coarse / fine < 24  # 2⁴ = 16, and the next order of a step that is not yet tiny


@pytest.mark.parametrize("kind", [Hovercraft, *CATALOGUE], ids=lambda kind: kind.__name__)
def test_craft_stays_finite_at_the_ends_of_its_bounds(kind: Any) -> None:
    """Each parameter alone at both of its ends; those of an effect all at one end or the other."""
    ends = [(p.name, p.bounds) for p in parameters_of(kind) if not isinstance(p.default, bool)]
    cases = [{name: float(value)} for name, bounds in ends for value in bounds]
    if kind is not Hovercraft:
        cases = [{f"{kind.name}.{name}": float(bounds[k]) for name, bounds in ends} for k in (0, 1)]
    for values in cases:
        craft = Hovercraft().with_values(values)
        y = flown(Stepper(craft), [(6.8, 6.2, 0.3, -0.1)] * 50 + [craft.start_command()] * 50)
        assert all(np.all(np.isfinite(trace)) for trace in y.values()), values
        assert np.max(np.abs(y["phi"])) < math.pi, values  # on its table, not tumbling
