"""The symmetry of the craft: a mirror in its mid-line."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.model import Stepper
from plant.hovercraft import Hovercraft
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


def run(commands: Array, start: dict[str, float], values: dict[str, float]) -> dict[str, Array]:
    return flown(Stepper(Hovercraft().with_values(values)), commands, start)


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
