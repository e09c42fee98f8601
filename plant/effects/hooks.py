"""What an effect on the hovercraft may add, and where it enters the equations.

    command → shape → lag ← tilt_rate → thrust_factor → wrench (felt) → acceleration (not felt)

An effect overrides the hooks it needs; the craft calls only those an awake effect overrides.
"""

from __future__ import annotations

from typing import NamedTuple

from cosim.model import Effect, Namespace, Number, Values

Pair = tuple[Number, Number]
Wrench = tuple[Number, Number, Number, Number]


class Motion(NamedTuple):
    """What a force may depend on: velocities [m/s, rad/s] and the propellers' total force [N]."""

    vx: Number
    vy: Number
    psi_dot: Number
    thrust_x: Number
    thrust_z: Number


class HovercraftEffect(Effect):
    """A term of the hovercraft. Pairs are (right, left)."""

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        """Tilt rates [rad/s] in place of `rate`, and the derivatives of the effect's own states."""
        return rate, ()

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        """Factors on both thrusts."""
        return 1.0, 1.0

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        """Forward and rightward force [N], yaw and roll moment [N m], felt by the accelerometer."""
        return 0.0, 0.0, 0.0, 0.0

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        """Forward and rightward acceleration [m/s²] that the accelerometer does not feel."""
        return 0.0, 0.0
