"""Linearization of the plant's fourteen states at hover, from a few parameters.

States and inputs are those of the plant. Both axes have the lag; each propeller has its own thrust and tilt. A test
compares every entry with the linearization of the plant's equations.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from controller.design_model import Matrix, ModelNumbers
from plant.hovercraft import INPUTS as PLANT_INPUTS
from plant.hovercraft import STATES as PLANT_STATES

STATES = tuple(q.name for q in PLANT_STATES)
INPUTS = tuple(q.name for q in PLANT_INPUTS)


class FullNumbers(ModelNumbers, Protocol):
    """Parameters of the design model, roll and motors, all SI (duty in %)."""

    @property
    def ixx(self) -> float: ...
    @property
    def ground_gain(self) -> float: ...
    @property
    def thrust_per_duty(self) -> float: ...
    @property
    def roll_stiffness(self) -> float: ...
    @property
    def roll_damping(self) -> float: ...


def full_model(p: FullNumbers) -> tuple[Matrix, Matrix]:
    """Return A (14, 14) and B (14, 4) about hover at ψ = 0, eqs 5.9-5.14 with 4.20 and 4.29.

    v̇x = −c/m·vx + T_N/m·(α_R + α_L)          v̇y = −c/m·vy − 2·T_N/m·φ
    ψ̈ = −d/Izz·ψ̇ + L·T_N/Izz·(α_R − α_L)      φ̈ = −k/Ixx·φ − d_φ/Ixx·φ̇ + L·Γ/Ixx·(T_R − T_L)
    Ṫ = (dT/dδ·δ − T)/τ                        α̇ = (α_cmd − α)/τ                 Ẋ = vx,  Ẏ = −vy
    """
    A, B = np.zeros((14, 14)), np.zeros((14, 4))
    at = {name: k for k, name in enumerate(STATES)}

    def put(row: str, **entries: float) -> None:
        for column, value in entries.items():
            A[at[row], at[column]] = value

    put("x", vx=1.0)
    put("y", vy=1.0)
    put("x_world", vx=1.0)
    put("y_world", vy=-1.0)
    put("psi", psi_dot=1.0)
    put("phi", phi_dot=1.0)
    push, turn, lift = p.thrust_nominal / p.mass, p.arm * p.thrust_nominal / p.izz, p.arm * p.ground_gain / p.ixx
    put("vx", vx=-p.friction / p.mass, tilt_right=push, tilt_left=push)
    put("vy", vy=-p.friction / p.mass, phi=-2.0 * push)
    put("psi_dot", psi_dot=-p.yaw_damping / p.izz, tilt_right=turn, tilt_left=-turn)
    put("phi_dot", phi=-p.roll_stiffness / p.ixx, phi_dot=-p.roll_damping / p.ixx, thrust_right=lift, thrust_left=-lift)
    for k, state in enumerate(("thrust_right", "thrust_left", "tilt_right", "tilt_left")):
        put(state, **{state: -1.0 / p.lag})
        B[at[state], k] = (p.thrust_per_duty if k < 2 else 1.0) / p.lag
    return A, B
