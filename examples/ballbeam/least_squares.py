"""Least-squares fit of the ball: `python examples/ballbeam/least_squares.py LOGS [--refined FOLDER]`.

The velocity is not measured: position and velocity at the start of a prediction over 2 s are fitted to the readings
of the second before it. The equations are those of ballbeam.py.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from yardstick import Array, Channel, Parameters, Rig, main

GIVEN = {
    "incline": 7.0,
    "angle_delay.time": 0.0,
    "rolling_friction.level": 0.0,
    "viscous_friction.damping": 0.0,
    "level_offset.value": 0.0,
    "beam_curvature.coefficient": 0.0,
}
DELAY = {"incline": 7.0, "angle_delay.time": 0.1}
EFFECTS = {**DELAY, "rolling_friction.level": 0.01, "level_offset.value": 0.005, "beam_curvature.coefficient": 0.1}
HELD_OUT = {**DELAY, "viscous_friction.damping": 0.1, "beam_curvature.coefficient": 0.1}
VARIANTS = {
    "base": {"incline": 7.0},
    "with delay": DELAY,
    "terms chosen by parts left out": HELD_OUT,
    "with four effects": EFFECTS,
}


def derivative(p: Parameters, state: tuple[Array, ...], angle: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the velocity and ẍ = k·θ − r·tanh(v/0.005) − d·v + o + c·x."""
    position, velocity = state
    total = p["incline"] * angle[0] - p["rolling_friction.level"] * np.tanh(velocity / 5e-3)
    total = total - p["viscous_friction.damping"] * velocity
    return velocity, total + p["level_offset.value"] + p["beam_curvature.coefficient"] * position


RIG = Rig(
    derivative,
    states=2,
    inputs=("angle",),
    channels=(Channel("position", "mm", 1e-3),),
    horizon=2.0,
    every=2,
    past=1.0,
    substeps=4,
    interpolated=True,
    delay="angle_delay.time",
)

if __name__ == "__main__":
    sys.exit(main(__doc__, RIG, GIVEN, VARIANTS))
