"""Least-squares fit of the elbow: `python examples/ur10e/least_squares.py LOGS [--refined FOLDER]`.

Predictions over 0.3 s start from measured angle and rate, every tenth row. The equations are those of elbow.py.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from yardstick import Array, Channel, Parameters, Rig, main

GIVEN = {
    "inertia": 1.0,
    "viscous": 2.0,
    "weight_cosine": 3.0,
    "weight_sine": 1.0,
    "coulomb.level": 0.0,
    "drag.coefficient": 0.0,
    "cable_spring.stiffness": 0.0,
    "current_bias.offset": 0.0,
    "rate_bias.value": 0.0,
}
BASE = {name: GIVEN[name] for name in ("inertia", "viscous", "weight_cosine", "weight_sine")}
VARIANTS = {"base": BASE, "with dry friction": {**BASE, "coulomb.level": 0.5}}


def derivative(p: Parameters, state: tuple[Array, ...], current: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the rate and J·q̈ = i − b·q̇ − c·cos q − s·sin q − F·tanh(q̇/0.02) − k·|q̇|·q̇ − κ·q + B, over J."""
    angle, rate = state
    torque = current[0] - p["viscous"] * rate
    torque = torque - p["weight_cosine"] * np.cos(angle) - p["weight_sine"] * np.sin(angle)
    torque = torque - p["coulomb.level"] * np.tanh(rate / 0.02) - p["drag.coefficient"] * np.abs(rate) * rate
    torque = torque - p["cable_spring.stiffness"] * angle + p["current_bias.offset"]
    return rate, torque / p["inertia"]


RIG = Rig(
    derivative,
    states=2,
    inputs=("current",),
    channels=(Channel("angle", "mrad", 1e-3), Channel("rate", "mrad/s", 1e-3)),
    horizon=0.3,
    every=10,
    biases={"rate": "rate_bias.value"},
)

if __name__ == "__main__":
    sys.exit(main(__doc__, RIG, GIVEN, VARIANTS))
