"""Rigid body on the air table (thesis ch. 5), and the frames it moves in.

Local axes: x forward, y to the right, ψ positive to the left seen from above, φ positive with the right
side up. World axes: X forward and Y left at ψ = 0, z up. No other reading satisfies eqs 5.6-5.8.
"""

from __future__ import annotations

from plant.model import Number
from plant.namespaces import Namespace


def world_velocity(m: Namespace, psi: Number, vx: Number, vy: Number) -> tuple[Number, Number]:
    """Velocity of the craft in world axes [m/s]: Ẋ = vx·cos ψ + vy·sin ψ, Ẏ = vx·sin ψ − vy·cos ψ."""
    s, c = m.sin(psi), m.cos(psi)
    return vx * c + vy * s, vx * s - vy * c


# The map is its own inverse (a rotation and a mirror), so a world vector reaches local axes by it too.
local_vector = world_velocity


def thrust_vector(m: Namespace, thrust: Number, alpha: Number) -> tuple[Number, Number]:
    """Forward and upward force of a propeller tilted by α [rad], eq 5.1: F_x = T·sin α, F_z = T·cos α."""
    return thrust * m.sin(alpha), thrust * m.cos(alpha)
