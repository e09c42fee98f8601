"""Rigid body on the air table (thesis ch. 5), and its frames.

Local axes: x forward, y to the right, ψ positive to the left seen from above, φ positive with the right side up. World
axes: X forward and Y left at ψ = 0, z up. Only this convention satisfies eqs 5.6-5.8.
"""

from __future__ import annotations

from cosim.model import Namespace, Number


def thrust_vector(m: Namespace, thrust: Number, alpha: Number) -> tuple[Number, Number]:
    """Return forward and upward force of a propeller tilted by α [rad], eq 5.1.

    F_x = T·sin α, F_z = T·cos α.
    """
    return thrust * m.sin(alpha), thrust * m.cos(alpha)
