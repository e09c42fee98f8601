"""Symmetries of the craft: a mirror in its mid-line, and places, headings and times that are all alike."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.model import Stepper
from plant.hovercraft import DUTY_NOMINAL, Hovercraft
from tests.independent import COLUMNS, Array, flown

property_settings = settings(deadline=None, derandomize=True, max_examples=12)

piece = st.tuples(st.floats(6.0, 6.8), st.floats(6.0, 6.8), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
histories = st.lists(piece, min_size=4, max_size=4).map(lambda pieces: np.repeat(np.array(pieces), 8, axis=0))
starts = st.fixed_dictionaries(
    {
        "vx": st.floats(-1, 1), "vy": st.floats(-1, 1), "psi_dot": st.floats(-3, 3), "psi": st.floats(-4, 4),
        "phi": st.floats(-0.05, 0.05), "tilt_right": st.floats(-0.3, 0.3), "tilt_left": st.floats(-0.3, 0.3),
        "thrust_right": st.floats(1.5, 2.8), "thrust_left": st.floats(1.5, 2.8),
        "servo_backlash.play_right": st.floats(-0.1, 0.1), "servo_backlash.play_left": st.floats(-0.1, 0.1),
    }
)  # fmt: skip
# Every effect, some dormant, with what it becomes in the mirror: sides change places, what points right changes sign.
effects = st.fixed_dictionaries(
    {
        "actuator_delay.time": st.sampled_from([0.0, 0.013, 0.04]), "servo_backlash.width": st.floats(0, 0.1),
        "tilt_offset.right": st.floats(-0.1, 0.1), "tilt_offset.left": st.floats(-0.1, 0.1),
        "servo_dead_band.width": st.floats(0, 0.05), "servo_rate_limit.rate": st.sampled_from([0.0, 2.0]),
        "actuator_second_order.natural_frequency": st.sampled_from([0, 15]),
        "thrust_asymmetry.ratio": st.floats(-0.1, 0.1),
        "battery_sag.drop": st.floats(0, 0.3), "inflow_thrust_loss.coefficient": st.floats(0, 0.3),
        "coulomb_friction.force": st.floats(0, 0.2), "stribeck_friction.static_force": st.floats(0, 0.2),
        "quadratic_drag.coefficient": st.floats(0, 0.5), "yaw_damping.coefficient": st.floats(0, 0.02),
        "yaw_coulomb_friction.moment": st.floats(0, 0.02), "com_offset.right": st.floats(-0.01, 0.01),
        "table_tilt.x": st.floats(-0.05, 0.05), "table_tilt.y": st.floats(-0.05, 0.05),
        "coriolis.gain": st.sampled_from([0.0, 1.0]),
    }
)  # fmt: skip
ODD = {
    "y", "y_world", "psi", "phi", "vy", "psi_dot", "phi_dot",
    "thrust_asymmetry.ratio", "com_offset.right", "table_tilt.y",
}  # fmt: skip


def other_side(name: str) -> str:
    swap = {"right": "left", "left": "right"}
    head, dot, tail = name.rpartition(".")
    if head == "com_offset":
        return name
    return head + dot + "_".join(swap.get(word, word) for word in tail.split("_"))


def mirrored(values: dict[str, Any]) -> dict[str, Any]:
    """The same situation seen in a mirror along the mid-line: right is left, and left turns are right turns."""
    return {other_side(name): -value if name in ODD else value for name, value in values.items()}


def run(commands: Array, start: dict[str, float], values: dict[str, float], t0: float = 0.0) -> dict[str, Array]:
    return flown(Stepper(Hovercraft().with_values(values)), commands, start, t0=t0)


def test_mirroring_twice_is_nothing() -> None:
    # the mirror used below names real quantities on both sides
    names = [*COLUMNS, "servo_backlash.play_left", "tilt_offset.right", "com_offset.right", "table_tilt.x"]
    assert {other_side(other_side(name)) for name in names} == set(names)
    assert {other_side(name) for name in COLUMNS} == set(COLUMNS)


@property_settings
@given(histories, starts, effects)
def test_a_mirrored_craft_flies_the_mirrored_path(
    commands: Array, start: dict[str, float], values: dict[str, float]
) -> None:
    path = run(commands, start, values)
    image = run(commands[:, [1, 0, 3, 2]], mirrored(start), mirrored(values))
    expected = mirrored(path)
    for name in COLUMNS:
        # sums are taken in another order: rounding, grown by at most e^(t·slope) of dry friction's 40 /s while it slips
        assert np.max(np.abs(image[name] - expected[name])) < 1e-11, name


@property_settings
@given(histories.map(lambda u: u[:, [0, 0, 2, 2]]), st.floats(-1, 1), st.floats(-2, 2))
def test_equal_commands_never_turn_nor_lean_the_craft(commands: Array, vx: float, psi: float) -> None:
    path = run(commands, {"vx": vx, "psi": psi}, {})
    for name in ("psi_dot", "phi", "phi_dot", "vy", "y"):
        assert np.all(path[name] == 0.0), name
    assert np.all(path["psi"] == psi)
    # and the path in the world is the straight line of its heading; 1e-16 m of rounding a substep, 128 of them
    assert np.max(np.abs(path["x_world"] - math.cos(psi) * path["x"])) < 2e-14
    assert np.max(np.abs(path["y_world"] - math.sin(psi) * path["x"])) < 2e-14


@property_settings
@given(histories, starts, effects, st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5))
def test_every_place_is_alike(
    commands: Array, start: dict[str, float], values: dict[str, float], x: float, y: float, X: float, Y: float
) -> None:
    here = run(commands, start, values)
    there = run(commands, start | {"x": x, "y": y, "x_world": X, "y_world": Y}, values)
    for name in COLUMNS:
        shift = {"x": x, "y": y, "x_world": X, "y_world": Y}.get(name, 0.0)
        if shift:
            # a coordinate of up to 10 m rounds by 1e-15 a substep, 128 of them
            assert np.max(np.abs(there[name] - here[name] - shift)) < 3e-13, name
        else:
            assert np.array_equal(there[name], here[name]), name


@property_settings
@given(histories, starts, effects, st.floats(-4, 4))
def test_every_heading_is_alike_on_a_level_table(
    commands: Array, start: dict[str, float], values: dict[str, float], turn: float
) -> None:
    level = values | {"table_tilt.x": 0.0, "table_tilt.y": 0.0}
    one = run(commands, start, level)
    other = run(commands, start | {"psi": start["psi"] + turn}, level)
    for name in set(COLUMNS) - {"psi", "x_world", "y_world"}:
        assert np.array_equal(one[name], other[name]), name
    assert np.max(np.abs(other["psi"] - one["psi"] - turn)) < 1e-12  # a rounding of 1e-15 a substep, 128 of them
    # the path in the world turns with the craft
    cos, sin = math.cos(turn), math.sin(turn)
    assert np.max(np.abs(other["x_world"] - (cos * one["x_world"] - sin * one["y_world"]))) < 1e-12
    assert np.max(np.abs(other["y_world"] - (sin * one["x_world"] + cos * one["y_world"]))) < 1e-12


@property_settings
@given(histories, starts, effects, st.integers(1, 1000))
def test_every_time_is_alike_while_the_battery_is_fresh(
    commands: Array, start: dict[str, float], values: dict[str, float], samples: int
) -> None:
    fresh = values | {"battery_sag.drop": 0.0}
    early = run(commands, start, fresh)
    late = run(commands, start, fresh, t0=samples * 0.02)
    for name in COLUMNS:
        # only a delay looks at time, and sees it to 4e-15 of 20 s over a substep of 5 ms: 1e-12 of a command's jump
        assert np.max(np.abs(late[name] - early[name])) < 1e-10, name


def test_a_tired_battery_breaks_the_symmetry_in_time() -> None:
    commands = np.tile((DUTY_NOMINAL, DUTY_NOMINAL, 0.1, 0.1), (20, 1))
    early, late = (run(commands, {}, {"battery_sag.drop": 0.2}, t0=t0)["vx"][-1] for t0 in (0.0, 20.0))
    # θ = 15 s: at 20 s the thrust is 1 − 0.2·(1 − e^(−20/15)) = 0.853 of the first; 1.5 % covers the 0.4 s of the run
    assert abs(late / early - 0.853) < 0.015
