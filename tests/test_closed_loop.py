"""The loop closed as plain functions: Fig 6.2, the roll it does not show, and the craft under sensor noise."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.laws import feedback
from controller.loop import Loop
from controller.settings import Settings
from cosim.model import Stepper
from plant.hovercraft import Hovercraft

Array = NDArray[np.float64]
H = 0.02
NAMES = [q.name for q in Hovercraft.outputs]


def settling(trace: Array, band: float) -> float:
    """Time of the last sample outside ±band; row k is t = k·0.02 s."""
    outside = np.nonzero(np.abs(trace) > band)[0]
    return float(H * outside[-1]) if len(outside) else 0.0


# Fig 6.2: x = 1 m, ψ = 1 rad → 0 with K on the true state.


@functools.cache
def figure_6_2(limit: float, craft: Hovercraft, duration: float = 10.0) -> dict[str, Array]:
    """Outputs by name, and the larger of the commanded tilts as `command`."""
    stepper, gain = Stepper(craft), Settings().gain_matrix
    moment = stepper.start(0.0, {"x": 1.0, "psi": 1.0})
    rows, commands = [], []
    for _ in range(round(duration / H) + 1):
        y = dict(zip(NAMES, stepper.output(moment.t, moment.state, ()), strict=True))
        a = sum(y[f"thrust_{side}"] * math.sin(y[f"tilt_{side}_actual"]) for side in ("right", "left")) / craft.mass
        u = feedback(gain, (y["x"], y["vx"], y["psi"], y["psi_dot"], a), limit)
        rows.append(list(y.values()))
        commands.append(max(map(abs, u)))
        moment = stepper.step(moment, (craft.duty_nominal, craft.duty_nominal, *u), H)
    return dict(zip(NAMES, np.array(rows).T, strict=True)) | {"command": np.array(commands)}


@pytest.mark.parametrize(
    ("limit", "settled_x", "settled_psi", "tilt"),
    [(math.inf, 2.98, 1.38, 53.3), (math.radians(12), 3.22, 1.86, 12.0)],
    ids=["free", "12 deg"],
)
def test_figure_6_2(limit: float, settled_x: float, settled_psi: float, tilt: float) -> None:
    run = figure_6_2(limit, Hovercraft())
    # on a grid of 0.02 s these are exact sample counts
    assert settling(run["x"], 0.02) == pytest.approx(settled_x, abs=1e-9)
    assert settling(run["psi"], 0.02) == pytest.approx(settled_psi, abs=1e-9)
    assert np.degrees(np.max(run["command"])) == pytest.approx(tilt, abs=0.05)  # half a unit of the last digit


@pytest.mark.parametrize(
    ("craft", "phi", "digits", "y"),
    [
        # eq 5.14 alone: the craft tumbles, which the five states do not show; y printed as 35 m
        (Hovercraft(table_roll_stiffness=0.0, table_roll_damping=0.0, roll_ground_effect=False), 7.5, 0.05, 35.0),
        # each propeller's own ground effect holds it, undamped
        (Hovercraft(table_roll_stiffness=0.0, table_roll_damping=0.0), 0.124, 5e-4, None),
        # and the air cushion of §4.2 makes it a detail
        (Hovercraft(), 0.007, 5e-4, None),
    ],
    ids=["eq 5.14", "own ground effect", "air cushion"],
)
def test_roll_that_figure_6_2_does_not_show(craft: Hovercraft, phi: float, digits: float, y: float | None) -> None:
    run = figure_6_2(math.inf, craft)
    assert np.max(np.abs(run["phi"])) == pytest.approx(phi, abs=digits)  # half a unit of the last digit
    if y is not None:
        assert np.max(np.abs(run["y"])) == pytest.approx(y, abs=0.5)
    # the 5-state figures are the same whatever roll does, to a tenth of a second or two
    assert settling(run["x"], 0.02) == pytest.approx(2.98, abs=0.03)
    assert settling(run["psi"], 0.02) == pytest.approx(1.38, abs=0.15)


# Under the measured noise of eq 5.46.


def test_reference_steps_are_followed() -> None:
    # one leg of Appendix G: turn 90° right (negative ψ), then 1.5 m ahead; goal reached within 10 % and 10° (§5.6)
    craft = Hovercraft()
    stepper = Stepper(craft)
    moment, loop = stepper.start(), Loop(Settings(), (0.0,) * 5, 0.0, -math.pi / 2)
    for k in range(500):
        moment = stepper.step(moment, (craft.duty_nominal, craft.duty_nominal, *loop.command), H)
        y = dict(zip(NAMES, stepper.output(moment.t, moment.state, ()), strict=True))
        loop.step((y["psi"], y["psi_dot"], y["ax"]), 1.5 if k >= 150 else 0.0, -math.pi / 2)
    assert y["x"] == pytest.approx(1.5, rel=0.1)
    assert y["psi"] == pytest.approx(-math.pi / 2, abs=math.radians(10))
    # a right turn and straight on is −Y of the world, for Y points left
    assert y["y_world"] == pytest.approx(-1.5, rel=0.1)
    assert abs(y["x_world"]) < 0.15
