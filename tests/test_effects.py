"""The craft and its catalogue of effects, compared with an independent implementation; rejected inputs of both."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from controller.settings import Settings
from cosim.model import SCALAR, Stepper, parameters_of
from plant.effects import CATALOGUE, TableTilt, YawCoulombFriction
from plant.hovercraft import DUTY_NOMINAL, Hovercraft
from plant.powertrain import thrust_out_of_ground
from tests.independent import COLUMNS, Array, Effects, excitation, flown, simulate, to_and_fro

MEMORY = {
    "actuator_second_order.tilt_rate_right": 0.5, "actuator_second_order.tilt_rate_left": -0.4,
    "servo_backlash.play_right": 0.03, "servo_backlash.play_left": -0.02,
    "actuator_delay.duty_right": 6.45, "actuator_delay.duty_left": 6.35,
    "actuator_delay.tilt_right": 0.1, "actuator_delay.tilt_left": -0.05,
}  # fmt: skip
MOVING = {
    "x": 0.3, "y": -0.2, "x_world": 1.0, "y_world": -2.0, "psi": 0.7, "vx": 0.2, "vy": -0.1, "psi_dot": 0.6,
    "phi": 0.01, "phi_dot": -0.05, "thrust_right": 2.1, "thrust_left": 2.3, "tilt_right": 0.15, "tilt_left": -0.1,
}  # fmt: skip

# Tolerance at the plant's own 5 ms, and at 0.5 ms, where only the equations can differ.
SMOOTH = (1e-6, 1e-9)  # RK4 as in the base model, whose tolerance is the model sheet's
# Dry friction: vx agrees to 2e-7; a_x reads the force, whose slope F_s/(0.01·m) = 21 /s multiplies that.
STEEP = (5e-6, 1e-9)
# A pole at ωₙ(ζ + √(ζ² − 1)) = 52 rad/s: (hλ)⁵/120 = 1e-5 of a tilt step of 0.1 rad, times 2·T_N/m = 7 in a_x.
FAST = (7e-6, 1e-9)
# Kinked: the slope of α jumps inside a substep and RK4 errs by up to r·h²/(8τ) = 4e-5 rad in α; the yaw rate
# gains L·T_N/Izz·τ = 3.7 /s of that, ψ its integral over the 2.4 s of the run. h² at h/10: 1 %.
KINKED = (4e-4, 4e-6)
# tanh(ψ̇/0.02) is crossed at 4 rad/s², so in 2 substeps: hλ = h·M/(0.02·Izz) = 0.24 at rest, and RK4's (hλ)⁵/120
# of the 0.02 rad/s crossed, summed over crossings, is 5e-5 at most; h⁴ at h/10.
NARROW = (5e-5, 5e-9)
# Over a substep the mean of a delayed command acts: its impulse is exact and its shape is not, by up to
# (h/τ)²/8 = 4e-4 of a jump, here 0.3 rad: 1.2e-4 rad in α, times 2·T_N/m = 7 in a_x. h² at h/10: 1 %.
BLURRED = (9e-4, 9e-6)

EVERYTHING = {
    "actuator_delay": {"time": 0.03}, "servo_backlash": {"width": 0.03}, "tilt_offset": {"right": 0.02, "left": -0.01},
    "servo_dead_band": {"width": 0.02}, "actuator_second_order": {"natural_frequency": 15.0, "damping_ratio": 0.6},
    "servo_rate_limit": {"rate": 1.5}, "thrust_asymmetry": {"ratio": 0.03}, "battery_sag": {"drop": 0.1, "time": 8.0},
    "inflow_thrust_loss": {"coefficient": 0.1}, "coulomb_friction": {"force": 0.05},
    "stribeck_friction": {"force": 0.02, "static_force": 0.05, "speed": 0.05}, "quadratic_drag": {"coefficient": 0.2},
    "yaw_damping": {"coefficient": 0.01}, "yaw_coulomb_friction": {"moment": 0.005}, "com_offset": {"right": 0.004},
    "table_tilt": {"x": 0.01, "y": 0.02}, "coriolis": {"gain": 1.0},
}  # fmt: skip
ROUGH = {"stribeck_friction": STEEP, "yaw_coulomb_friction": NARROW, "servo_rate_limit": KINKED}
# a delay of whole substeps, as above, has nothing to blur; a backlash's kinks fall on command changes, where
# integration restarts
CASES: list[tuple[dict[str, dict[str, float]], tuple[float, float]]] = [
    *(({name: values}, ROUGH.get(name, SMOOTH)) for name, values in EVERYTHING.items()),
    ({"actuator_second_order": {"natural_frequency": 20.0, "damping_ratio": 1.5}}, FAST),
    ({"actuator_delay": {"time": 0.0337}}, BLURRED),
    ({"actuator_delay": {"time": 0.5}}, SMOOTH),
]


class Fine(Hovercraft):
    """The craft with ten times the substeps."""

    substep = 0.0005


def named(effects: Effects) -> dict[str, float]:
    """`effect.parameter` values."""
    return {f"{effect}.{p}": value for effect, values in effects.items() for p, value in values.items()}


def largest_difference(a: dict[str, Array], b: dict[str, Array]) -> float:
    return max(float(np.max(np.abs(a[name] - b[name]))) for name in COLUMNS)


def test_cases_cover_the_catalogue() -> None:
    assert set(EVERYTHING) == {kind.name for kind in CATALOGUE}


@cache
def without_effects() -> dict[str, Array]:
    """Return the run of the craft alone."""
    return simulate(to_and_fro(120))


# all at once, they act in the order of the catalogue
@pytest.mark.parametrize(("effects", "tolerances"), [*CASES, (EVERYTHING, KINKED)], ids=str)
def test_effect_agrees_with_the_independent_one(effects: Effects, tolerances: tuple[float, float]) -> None:
    commands = to_and_fro(120)
    exact = simulate(commands, effects)
    # the run excites the effect: a thousand times what a smooth one may differ by
    assert largest_difference(exact, without_effects()) > 1e-3
    for craft, tolerance in zip((Hovercraft(), Fine()), tolerances, strict=True):
        got = flown(Stepper(craft.with_values(named(effects))), commands)
        assert largest_difference(got, exact) < tolerance
    # every state moving, memories of its own, a late start of time
    commands = excitation(40, seed=2, duty=0.1)
    start = MOVING | {name: v for name, v in MEMORY.items() if name.partition(".")[0] in effects}
    exact = simulate(commands, effects, start=start, t0=3.7)
    got = flown(Stepper(Fine().with_values(named(effects))), commands, start, t0=3.7)
    assert largest_difference(got, exact) < max(tolerances[1], 1e-8)


def test_effects_sleep_at_their_neutral_values_only_and_are_no_effect_then_bit_for_bit() -> None:
    for kind in CATALOGUE:
        neutral = {p.name: p.neutral for p in parameters_of(kind) if p.neutral is not None}
        assert kind().dormant
        assert kind(**neutral).dormant
        assert [name for name, value in neutral.items() if kind(**{name: value + 0.01}).dormant] == []
    commands = excitation(50)
    craft = Hovercraft(effects=tuple(kind() for kind in CATALOGUE))
    plain, dormant = (flown(Stepper(c), commands, MOVING) for c in (Hovercraft(), craft))
    assert largest_difference(plain, dormant) == 0.0


@pytest.mark.parametrize("moment", [0.004, parameters_of(YawCoulombFriction)[0].bounds[1]])
def test_dry_yaw_friction_of_any_allowed_size_brings_the_craft_to_rest(moment: float) -> None:
    craft = Hovercraft(effects=(YawCoulombFriction(moment=moment),), friction=0.0, duty_nominal=0.0)  # no thrust
    assert abs(flown(Stepper(craft), np.zeros((150, 4)), {"psi_dot": 0.5})["psi_dot"][-1]) < 1e-9


# -- the craft itself -----------------------------------------------------------------------------

CRAFT = Hovercraft()


def test_thrust_line_is_that_of_the_load_cell_and_never_pulls_backwards() -> None:
    # eq 4.20 in gf at both ends of the fitted range, exact arithmetic on the printed a and b; zero at 5.768 %
    for duty, grams in ((6.0, -2076 + 359.9 * 6.0), (7.0, 443.3), (5.0, 0.0)):
        thrust = thrust_out_of_ground(SCALAR, duty, CRAFT.thrust_offset, CRAFT.thrust_slope, CRAFT.gravity)
        assert thrust == pytest.approx(grams * 9.81e-3, rel=1e-14)


def test_unconnected_plant_hovers_with_the_nominal_thrust_at_the_nominal_duty() -> None:
    y = flown(Stepper(CRAFT), [CRAFT.start_command()] * 50)
    assert {name for name, trace in y.items() if np.ptp(trace)} == set()
    assert y["thrust_right"][0] == pytest.approx(2.4973, abs=6e-6)  # T_N, eq 5.36; δ_N is rounded to 1e-6 %
    assert DUTY_NOMINAL == CRAFT.duty_nominal == Settings().duty_nominal == 6.38763
    other = Hovercraft(thrust_slope=380.0, duty_nominal=6.2, mass=0.9, gravity=9.78)  # at its own nominal duty
    assert set(other.equations(SCALAR).derivative(0.0, other.start(), other.start_command())) == {0.0}


def test_parameters_are_refused_just_outside_their_bounds_and_taken_on_them() -> None:
    for p in parameters_of(Hovercraft):
        if not isinstance(p.default, bool):
            for bound, outside in zip(p.bounds, (-math.inf, math.inf), strict=True):
                assert getattr(Hovercraft(**{p.name: float(bound)}), p.name) == bound
                with pytest.raises(ValueError, match=p.name):
                    Hovercraft(**{p.name: math.nextafter(bound, outside)})


def test_values_by_name_reach_parameters_and_effects_and_nothing_else() -> None:
    craft = CRAFT.with_values({"mass": 0.8, "table_tilt.x": 0.01, "servo_backlash.width": 0.02})
    assert craft.mass == 0.8
    assert [(e.name, e.dormant) for e in craft.effects] == [("servo_backlash", False), ("table_tilt", False)]
    assert (CRAFT.mass, CRAFT.effects) == (0.705, ())  # a model is changed by making another
    assert CRAFT.with_effect(TableTilt(x=0.01)).with_effect(TableTilt(y=0.02)).effects == (TableTilt(y=0.02),)
    for unknown in ("masss", "table_tilt.z", "gremlins.force"):
        with pytest.raises(KeyError):
            CRAFT.with_values({unknown: 0.1})
