"""Hidden properties of a blind study, drawn by seed: kind, effects and sizes, measured channels, style of flight.

Consecutive seeds are dealt from shuffled decks: any twenty contain 11 known, 5 nothing and 4 outside, and effects
alternate. Sizes are those of a real rig (docs/blind.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from tests.blind.field_rig import Random, Truth, dealt
from tests.blind.field_rig import stream as any_stream
from tests.blind.truth_craft import SHEET
from tests.blind.truth_outside import OUTSIDE

BASE = ("mass", "izz", "friction", "lag", "thrust_slope")
SENSORS = ("accelerometer_bias", "accelerometer_scale", "gyro_bias")
EFFECTS = (
    "coulomb_friction",
    "stribeck_friction",
    "quadratic_drag",
    "yaw_damping",
    "yaw_coulomb_friction",
    "actuator_second_order",
    "actuator_delay",
    "servo_rate_limit",
    "servo_backlash",
    "servo_dead_band",
    "tilt_offset",
    "thrust_asymmetry",
    "battery_sag",
    "inflow_thrust_loss",
    "com_offset",
    "table_tilt",
    "coriolis",
)
# never in one study: the data cannot tell them apart, or one hides the other
FAMILIES = (
    {"coulomb_friction", "stribeck_friction", "quadratic_drag"},
    {"yaw_damping", "yaw_coulomb_friction"},
    {"actuator_second_order", "actuator_delay", "servo_rate_limit"},
    {"servo_backlash", "servo_dead_band"},
    {"thrust_asymmetry", "com_offset", "tilt_offset"},
    {"battery_sag", "inflow_thrust_loss"},
)
# what the accelerometer and the heading do not show without any position (docs/blind.md says why)
NEED_POSITION = {
    *("coulomb_friction", "stribeck_friction", "quadratic_drag", "thrust_asymmetry", "com_offset", "table_tilt"),
    *("coriolis", "mass", "friction", "accelerometer_bias", "accelerometer_scale"),
}
# a block of twenty consecutive seeds, in shuffled order
BLOCK = ("known",) * 11 + ("nothing",) * 5 + ("outside",) * 4
PAIR, BASE_PAIR = "two effects", "two base parameters"
KNOWN_DECK = (*EFFECTS, *BASE, *SENSORS, *(PAIR,) * 6, *(BASE_PAIR,) * 2)
NOTHING_DECK = ("clean", "disturbed")


@dataclass(frozen=True)
class Study:
    """Answer of a study: hidden effects, and the conditions of its logs."""

    seed: int
    kind: str  # known, nothing, outside
    truth: Truth
    disturbed: bool
    position: bool
    duty_varied: bool


stream = partial(any_stream, 9137)  # of this half


def _sign(rng: Random) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _near(rng: Random, size: float) -> float:
    """Return a random value within 20 % of `size`."""
    return size * float(rng.uniform(0.8, 1.2))


def size(name: str, rng: Random) -> dict[str, float]:
    """Return random parameters of the effect, base parameter or sensor error `name`, in SI (thrust_slope in gf/%)."""
    degree = math.pi / 180.0
    between = rng.uniform
    if name in BASE:
        return {"value": SHEET[name] * (1.0 + _wrong_by(name, rng))}
    drawn: dict[str, dict[str, float]] = {
        "coulomb_friction": {"force": between(0.025, 0.08)},
        "stribeck_friction": {
            "force": between(0.025, 0.035),
            "static_force": between(0.07, 0.08),
            "speed": between(0.1, 0.2),
        },
        "quadratic_drag": {"coefficient": _near(rng, 0.5)},
        "yaw_damping": {"coefficient": _near(rng, 0.004)},
        "yaw_coulomb_friction": {"moment": _near(rng, 0.003)},
        "actuator_second_order": {"natural_frequency": between(13.0, 15.0), "damping_ratio": between(0.35, 0.55)},
        "actuator_delay": {"time": _near(rng, 0.06)},
        "servo_rate_limit": {"rate": _near(rng, 0.8)},
        "servo_backlash": {"width": between(1.0, 2.0) * degree},
        "servo_dead_band": {"width": between(1.0, 2.0) * degree},
        "tilt_offset": {side: _sign(rng) * _near(rng, degree) for side in ("right", "left")},
        "thrust_asymmetry": {"ratio": _sign(rng) * _near(rng, 0.02)},
        "battery_sag": {"drop": _near(rng, 0.2), "time": _near(rng, 15.0)},
        "inflow_thrust_loss": {"coefficient": _near(rng, 0.25)},
        "com_offset": {"right": _sign(rng) * _near(rng, 0.004)},
        "table_tilt": {axis: _sign(rng) * _near(rng, 0.2 * degree) for axis in ("x", "y")},
        "coriolis": {"gain": 1.0},
        "accelerometer_bias": {"value": _sign(rng) * _near(rng, 0.1)},
        "accelerometer_scale": {"value": 1.0 + _sign(rng) * _near(rng, 0.12)},
        "gyro_bias": {"value": _sign(rng) * _near(rng, 0.02)},
    }
    return {p: float(v) for p, v in drawn[name].items()}


def _wrong_by(name: str, rng: Random) -> float:
    """Return the relative error of a base parameter: 10-70 % up or 10-45 % down; of the thrust slope ±3-7 %."""
    if name == "thrust_slope":
        # 7 % less slope is 72 % less thrust at the nominal duty: the line's offset does not shrink with it
        return _sign(rng) * float(rng.uniform(0.03, 0.07))
    return float(rng.uniform(0.1, 0.7) if rng.random() < 0.5 else -rng.uniform(0.1, 0.45))


def _deal(deck: tuple[str, ...], number: int, purpose: int) -> tuple[str, int]:
    """Return card `number` of an endless pile of equal decks, and how many equal cards are above it."""
    card, before = dealt(deck, number, lambda pile: stream(pile, purpose))
    return card, before


def _names_of_card(card: str, rng: Random) -> list[str]:
    if card == BASE_PAIR:
        return [str(n) for n in rng.choice(BASE[:4], 2, replace=False)]
    if card != PAIR:
        return [card]
    while True:
        pair = {str(n) for n in rng.choice(EFFECTS, 2, replace=False)}
        if not any(pair <= family for family in FAMILIES):
            return sorted(pair)


def draw(seed: int) -> Study:
    """Return the study of a seed, reproducible byte for byte."""
    kind, number = _deal(BLOCK, seed, 1)
    rng = stream(seed, 2)
    disturbed, imu_alone, duty = rng.random(3) < (0.5, 0.4, 0.5)
    truth: Truth = {}
    if kind == "known":
        truth = {name: size(name, rng) for name in _names_of_card(_deal(KNOWN_DECK, number, 3)[0], rng)}
        imu_alone &= not truth.keys() & NEED_POSITION
        duty |= "thrust_slope" in truth
    elif kind == "outside":
        name, _ = _deal(tuple(OUTSIDE), number, 4)
        entry = OUTSIDE[name]
        truth = {name: {p: float(rng.uniform(*r)) for p, r in entry.ranges.items()}}
        imu_alone &= not entry.needs_position
        duty |= entry.needs_duty
    else:
        disturbed = _deal(NOTHING_DECK, number, 5)[0] == "disturbed"
    return Study(seed, kind, truth, bool(disturbed), not imu_alone, bool(duty))
