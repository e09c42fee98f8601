"""The catalogue of effects: each against the model written a second time, and the physics each must obey."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

from cosim.model import Stepper, parameters_of
from plant.effects import (
    CATALOGUE,
    ActuatorDelay,
    ActuatorSecondOrder,
    CoulombFriction,
    TableTilt,
    YawCoulombFriction,
)
from plant.hovercraft import DUTY_NOMINAL, Hovercraft
from tests.independent import COLUMNS, HOLD, Array, Effects, excitation, flown, simulate, to_and_fro

HOVER = (DUTY_NOMINAL, DUTY_NOMINAL, 0.0, 0.0)

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

CASES: list[tuple[dict[str, dict[str, float]], tuple[float, float]]] = [
    ({"coulomb_friction": {"force": 0.1}}, SMOOTH),
    ({"stribeck_friction": {"force": 0.08, "static_force": 0.15, "speed": 0.05}}, STEEP),
    ({"stribeck_friction": {"force": 0.0, "static_force": 0.1, "speed": 0.02}}, STEEP),
    ({"quadratic_drag": {"coefficient": 0.5}}, SMOOTH),
    ({"yaw_damping": {"coefficient": 0.02}}, SMOOTH),
    ({"yaw_coulomb_friction": {"moment": 0.01}}, NARROW),
    ({"actuator_second_order": {"natural_frequency": 14.0, "damping_ratio": 0.4}}, SMOOTH),
    ({"actuator_second_order": {"natural_frequency": 20.0, "damping_ratio": 1.5}}, FAST),
    ({"actuator_delay": {"time": 0.06}}, SMOOTH),  # whole substeps: nothing to blur
    ({"actuator_delay": {"time": 0.035}}, SMOOTH),
    ({"actuator_delay": {"time": 0.0337}}, BLURRED),
    ({"actuator_delay": {"time": 0.002}}, BLURRED),
    ({"actuator_delay": {"time": 0.5}}, SMOOTH),
    ({"servo_rate_limit": {"rate": 1.0}}, KINKED),
    ({"servo_backlash": {"width": 0.05}}, SMOOTH),  # its kinks fall on command changes, where integration restarts
    ({"servo_dead_band": {"width": 0.04}}, SMOOTH),
    ({"tilt_offset": {"right": 0.03, "left": -0.02}}, SMOOTH),
    ({"tilt_offset": {"right": 0.0, "left": 0.02}}, SMOOTH),
    ({"thrust_asymmetry": {"ratio": 0.06}}, SMOOTH),
    ({"battery_sag": {"drop": 0.2, "time": 5.0}}, SMOOTH),
    ({"inflow_thrust_loss": {"coefficient": 0.2}}, SMOOTH),
    ({"com_offset": {"right": -0.01}}, SMOOTH),
    ({"table_tilt": {"x": 0.02, "y": -0.03}}, SMOOTH),
    ({"coriolis": {"gain": 1.0}}, SMOOTH),
]
EVERYTHING = {
    "actuator_delay": {"time": 0.03}, "servo_backlash": {"width": 0.03}, "tilt_offset": {"right": 0.02, "left": -0.01},
    "servo_dead_band": {"width": 0.02}, "actuator_second_order": {"natural_frequency": 15.0, "damping_ratio": 0.6},
    "servo_rate_limit": {"rate": 1.5}, "thrust_asymmetry": {"ratio": 0.03}, "battery_sag": {"drop": 0.1, "time": 8.0},
    "inflow_thrust_loss": {"coefficient": 0.1}, "coulomb_friction": {"force": 0.05},
    "stribeck_friction": {"force": 0.02, "static_force": 0.05, "speed": 0.05}, "quadratic_drag": {"coefficient": 0.2},
    "yaw_damping": {"coefficient": 0.01}, "yaw_coulomb_friction": {"moment": 0.005}, "com_offset": {"right": 0.004},
    "table_tilt": {"x": 0.01, "y": 0.02}, "coriolis": {"gain": 1.0},
}  # fmt: skip


class Fine(Hovercraft):
    """The craft with ten times the substeps."""

    substep = 0.0005


def named(effects: Effects) -> dict[str, float]:
    """`effect.parameter` values."""
    return {f"{effect}.{p}": value for effect, values in effects.items() for p, value in values.items()}


def largest_difference(a: dict[str, Array], b: dict[str, Array]) -> float:
    return max(float(np.max(np.abs(a[name] - b[name]))) for name in COLUMNS)


def craft_with(*effects: Any, **base: float) -> Hovercraft:
    return Hovercraft(effects=effects, **base)


def thrustless(*effects: Any, **base: float) -> Hovercraft:
    """A craft that only slides: no thrust at all, no viscous friction unless given."""
    return Hovercraft(effects=effects, **{"friction": 0.0, "duty_nominal": 0.0, **base})


def test_cases_cover_the_catalogue() -> None:
    tested = {name for effects, _ in CASES for name in effects}
    assert tested == set(EVERYTHING) == {kind.name for kind in CATALOGUE}


@cache
def without_effects() -> dict[str, Array]:
    """Return the run of the craft alone."""
    return simulate(to_and_fro(120))


def once_quick() -> list[Any]:
    """Return the cases: the first of each effect, and the others as thorough ones."""
    seen: set[str] = set()
    cases = []
    for effects, tolerances in CASES:
        marks = [pytest.mark.thorough] if seen >= effects.keys() else []
        cases.append(pytest.param(effects, tolerances, id=str(named(effects)), marks=marks))
        seen |= effects.keys()
    return cases


@pytest.mark.parametrize(("effects", "tolerances"), once_quick())
def test_effect_agrees_with_the_independent_one(effects: Effects, tolerances: tuple[float, float]) -> None:
    commands = to_and_fro(120)
    exact = simulate(commands, effects)
    # the run excites the effect: a thousand times what a smooth one may differ by
    assert largest_difference(exact, without_effects()) > 1e-3
    for craft, tolerance in zip((Hovercraft(), Fine()), tolerances, strict=True):
        got = flown(Stepper(craft.with_values(named(effects))), commands)
        assert largest_difference(got, exact) < tolerance


@pytest.mark.parametrize("effect", [kind.name for kind in CATALOGUE])
def test_effect_agrees_from_any_start(effect: str) -> None:
    # every state moving, memories of its own, a late start of time: at 0.5 ms only the equations can differ
    effects = {effect: EVERYTHING[effect]}
    commands = excitation(40, seed=2, duty=0.1)
    start = MOVING | {name: v for name, v in MEMORY.items() if name.startswith(f"{effect}.")}
    exact = simulate(commands, effects, start=start, t0=3.7)
    got = flown(Stepper(Fine().with_values(named(effects))), commands, start, t0=3.7)
    assert largest_difference(got, exact) < (KINKED[1] if effect == "servo_rate_limit" else 1e-8)


def test_all_effects_at_once_agree_in_the_order_of_the_catalogue() -> None:
    commands = to_and_fro(120)
    start = MOVING | MEMORY
    exact = simulate(commands, EVERYTHING, start=start)
    for craft, tolerance in ((Hovercraft(), KINKED[0]), (Fine(), KINKED[1])):
        got = flown(Stepper(craft.with_values(named(EVERYTHING))), commands, start)
        assert largest_difference(got, exact) < tolerance


# Dormant, composed.


def test_dormant_effects_are_no_effect_bit_for_bit() -> None:
    commands = excitation(50)
    craft = Hovercraft(effects=tuple(kind() for kind in CATALOGUE))
    assert craft.awake == ()
    assert craft.states == Hovercraft().states
    plain, dormant = (flown(Stepper(c), commands, MOVING) for c in (Hovercraft(), craft))
    for name in COLUMNS:
        assert np.array_equal(plain[name], dormant[name]), name


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.name)
def test_effect_sleeps_at_its_neutral_values_only(kind: Any) -> None:
    assert kind().dormant
    with_neutral = [p for p in parameters_of(kind) if p.neutral is not None]
    assert with_neutral
    for p in with_neutral:
        assert p.default == p.neutral
        assert not kind(**{p.name: p.neutral + 0.01}).dormant


def test_an_effect_replaces_one_of_its_kind() -> None:
    craft = Hovercraft().with_effect(TableTilt(x=0.01)).with_effect(TableTilt(y=0.02))
    assert craft.effects == (TableTilt(y=0.02),)


# Energy.


@pytest.mark.parametrize("moment", [0.004, parameters_of(YawCoulombFriction)[0].bounds[1]])
def test_dry_yaw_friction_of_any_allowed_size_brings_the_craft_to_rest(moment: float) -> None:
    craft = thrustless(YawCoulombFriction(moment=moment))
    y = flown(Stepper(craft), [(0.0, 0.0, 0.0, 0.0)] * 150, {"psi_dot": 0.5})
    assert abs(y["psi_dot"][-1]) < 1e-9


def test_dry_friction_slides_the_textbook_distance() -> None:
    # v₀²·m/(2F) at constant deceleration; tanh(s/0.01) stretches the last centimetre per second:
    # exactly, m/F·∫₀^v₀ v/tanh(v/0.01) dv = m/F·(v₀²/2 + 0.01²·π²/12)
    craft = thrustless(CoulombFriction(force=0.3))
    y = flown(Stepper(craft), [(0.0, 0.0, 0.0, 0.0)] * 200, {"vx": 0.3, "vy": -0.4, "psi": 1.0})
    distance = 0.705 / 0.3 * (0.5**2 / 2 + 0.01**2 * math.pi**2 / 12)
    assert math.hypot(y["x"][-1], y["y"][-1]) == pytest.approx(distance, rel=1e-6)  # RK4 over the last stretch
    assert y["y"][-1] / y["x"][-1] == pytest.approx(-4 / 3, rel=1e-12)


# Actuators.


@pytest.mark.parametrize("zeta", [0.1, 0.3, 0.5, 0.7])
def test_second_order_servo_overshoots_by_the_textbook_share(zeta: float) -> None:
    # §4.5.4 saw overshoot and oscillation; the peak of a step is 1 + e^(−πζ/√(1−ζ²)) at t = π/(ω√(1−ζ²))
    w = 15.0
    root = math.sqrt(1 - zeta * zeta)
    peak_time = math.pi / (w * root)
    craft = craft_with(ActuatorSecondOrder(natural_frequency=w, damping_ratio=zeta))
    tilt = flown(Stepper(craft), [(*HOVER[:2], 0.1, 0.0)] * 200, hold=peak_time / 100)["tilt_right_actual"]
    # the 100th sample is on the peak; RK4 at (ωh)⁵/120 < 1e-9 a substep
    assert tilt[100] / 0.1 == pytest.approx(1 + math.exp(-math.pi * zeta / root), rel=1e-7)
    assert np.argmax(tilt) == 100


@pytest.mark.parametrize("samples", [1, 3, 25])
def test_delay_of_whole_samples_is_the_command_row_shifted(samples: int) -> None:
    commands = excitation(60)
    shifted = np.vstack([np.tile(HOVER, (samples, 1)), commands[:-samples]])
    late = flown(Stepper(craft_with(ActuatorDelay(time=samples * HOLD))), commands)
    row = flown(Stepper(Hovercraft()), shifted)
    # the same commands in the same substeps; a mean over a substep of one and the same value rounds
    assert largest_difference(late, row) < 1e-12


# Sensors.
