"""The measure of the plant's code: the craft of tests/blind/truth_craft.py, written a second time without any of it.

Its time is integrated by DOP853 with rtol 1e-11, restarted wherever the acting command jumps. `flown` drives the code
under test (any stepper) over the same commands, so that both are read alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.blind.truth_craft import DUTY, OUTPUTS, SHEET, STEP, Craft, Flight

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

COLUMNS = OUTPUTS
HOVER = np.array([DUTY, DUTY, 0.0, 0.0])
COMMANDS = ("duty_right", "duty_left", "tilt_right", "tilt_left")
# symbols of the parameter table of the thesis: §5.2, eqs 5.3, 5.4, 4.20, 4.28, 4.29, §5.5; k_t, d_t are not in it
SYMBOLS = {
    "m": "mass", "L": "arm", "Izz": "izz", "Ixx": "ixx", "R": "propeller_radius", "z": "height", "a": "thrust_offset",
    "b": "thrust_slope", "k": "ground_effect_exponent", "tau": "lag", "c": "friction", "k_t": "table_roll_stiffness",
    "d_t": "table_roll_damping", "g": "gravity",
}  # fmt: skip


def simulate(
    commands: Array,
    effects: Effects | None = None,
    numbers: Mapping[str, float] | None = None,
    start: Mapping[str, float] | None = None,
    t0: float = 0.0,
) -> dict[str, Array]:
    """Return outputs by name at t0, t0 + 0.02 s, …; `commands` (N, 4) is (δ_R, δ_L, α_R, α_L), with a row per hold."""
    start, effects, given = start or {}, dict(effects or {}), dict(numbers or {})
    own_height = given.pop("own_height", 1.0)
    base = {SYMBOLS[symbol]: value for symbol, value in given.items()}
    if not own_height:  # eq 5.14: both propellers at the height of the craft, however it rolls
        sheet = SHEET | base
        near = (sheet["propeller_radius"] / 4.0 / sheet["height"]) ** sheet["ground_effect_exponent"]
        effects["thrust_factor"], base["height"] = {"value": 1.0 / (1.0 - near)}, 1e9
    craft = Craft(base, effects)
    states = {name.removeprefix("actuator_second_order."): value for name, value in start.items()}
    flight = Flight(craft, craft.rest(**states), t0, tolerance=1e-11)
    flight.servos.play = [start.get(f"servo_backlash.play_{side}", 0.0) for side in ("right", "left")]
    waiting: Any = tuple(start.get(f"actuator_delay.{n}", u) for n, u in zip(COMMANDS, HOVER.tolist(), strict=True))
    flight.servos.sent = [(-math.inf, waiting)]
    rows = [flight.outputs()]
    for command in np.asarray(commands, dtype=float).tolist():
        flight.advance(tuple(command))
        rows.append(flight.outputs())
    return {name: np.array([row[name] for row in rows]) for name in COLUMNS}


def excitation(count: int, seed: int = 1, tilt: float = 0.25, duty: float = 0.35) -> Array:
    """Return commands (count, 4) with several frequencies and jumps in both tilts and both duties."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(count)[:, None]
    waves = sum(np.sin(2 * np.pi * rng.uniform(0.2, 3.0, 4) * t + rng.uniform(0, 2 * np.pi, 4)) for _ in range(3)) / 3
    jumps = np.repeat(rng.uniform(-1, 1, (count // 10 + 1, 4)), 10, axis=0)[:count]
    size = np.array([duty, duty, tilt, tilt])
    return np.array(HOVER) + size * (0.6 * waves + 0.4 * jumps)


def to_and_fro(count: int) -> Array:
    """Return commands (count, 4) under which both speeds often change sign, to excite dry friction."""
    t = STEP * np.arange(count)
    both, turn = 0.2 * np.cos(2 * np.pi * 0.7 * t), 0.1 * np.cos(2 * np.pi * 1.3 * t)
    duty = 0.1 * np.sin(2 * np.pi * 0.9 * t)
    return np.column_stack([DUTY + duty, DUTY + 0.5 * duty, both + turn, both - turn])


def flown(stepper: Any, commands: Any, start: Mapping[str, float] | None = None, t0: float = 0.0) -> dict[str, Array]:
    """Return the result of `simulate` from the stepper under test."""
    moment = stepper.start(t0, start)
    rows = [stepper.output(moment.t, moment.state, stepper.model.start_command())]
    for k, row in enumerate(np.asarray(commands, dtype=float).tolist()):
        moment = stepper.step(type(moment)(t0 + k * STEP, moment.state, moment.memory), tuple(row), STEP)
        rows.append(stepper.output(moment.t, moment.state, tuple(row)))
    names = [q.name for q in stepper.model.outputs]
    return dict(zip(names, np.array(rows).T, strict=True))
