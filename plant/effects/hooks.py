"""Hooks for effects in the hovercraft equations.

    command → shape → lag ← tilt_rate → thrust_factor → wrench (sensed) → acceleration (not sensed)

An effect overrides some hooks; the craft calls only overridden hooks of active effects.
"""

from __future__ import annotations

from typing import NamedTuple

from cosim.model import Effect, Namespace, Number, Values

Pair = tuple[Number, Number]
Wrench = tuple[Number, Number, Number, Number]


class Motion(NamedTuple):
    """Arguments of forces: velocities [m/s, rad/s] and the propellers' total force [N]."""

    vx: Number
    vy: Number
    psi_dot: Number
    thrust_x: Number
    thrust_z: Number


class HovercraftEffect(Effect):
    """An effect of the hovercraft's equations. Pairs are (right, left)."""

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        """Return tilt rates [rad/s] in place of `rate`, and derivatives of own states."""
        return rate, ()

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        """Return the factors on the right and left thrust."""
        return 1.0, 1.0

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        """Return the contact force of the effect, forward and rightward [N], and its yaw and roll moment [N m].

        The accelerometer senses these forces.
        """
        return 0.0, 0.0, 0.0, 0.0

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        """Return unsensed forward and rightward acceleration [m/s²]."""
        return 0.0, 0.0
