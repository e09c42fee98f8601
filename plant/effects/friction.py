"""Forces and moments against the motion, with the speed over the table s = √(vx² + vy²)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model import Namespace, Number, parameter
from plant.effects.hooks import HovercraftEffect, Motion, Wrench

STICTION_SPEED = 0.01  # [m/s] speed below which dry friction is smoothed
STICTION_YAW_RATE = 0.02  # [rad/s] yaw rate below which dry friction is smoothed
# Keeps 1/s finite at rest; far below the speed at which tanh(s/0.01) leaves its linear range.
REST = 1e-24


def speed(m: Namespace, motion: Motion) -> Number:
    """Return the positive speed over the table [m/s]."""
    return m.sqrt(motion.vx * motion.vx + motion.vy * motion.vy + REST)


def along(motion: Motion, gain: Number) -> Wrench:
    """Return the force `gain` times the velocity vector."""
    return gain * motion.vx, gain * motion.vy, 0.0, 0.0


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(HovercraftEffect):
    """Dry friction on the table: −F·tanh(s/0.01)·(vx, vy)/s."""

    name = "coulomb_friction"
    equation = "force −F·tanh(s/0.01)·(vx, vy)/s"

    force: float = parameter(0.0, unit="N", bounds=(0, 2), neutral=0.0, typical=0.05, doc="dry friction force F")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        s = speed(m, motion)
        return along(motion, -self.force * m.tanh(s / STICTION_SPEED) / s)


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(HovercraftEffect):
    """Friction that decreases with speed: −(F + (F_s − F)·e^(−(s/v_s)²))·tanh(s/0.01)·(vx, vy)/s."""

    name = "stribeck_friction"
    equation = "force −(F + (F_s − F)·e^(−(s/v_s)²))·tanh(s/0.01)·(vx, vy)/s"
    at_least: ClassVar[Mapping[str, str]] = {"static_force": "force"}

    force: float = parameter(0.0, unit="N", bounds=(0, 2), neutral=0.0, typical=0.05, doc="sliding friction force F")
    static_force: float = parameter(0.0, unit="N", bounds=(0, 2), neutral=0.0, typical=0.08, doc="breakaway force F_s")
    speed: float = parameter(0.05, unit="m/s", bounds=(0.005, 1), doc="Stribeck speed v_s")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        s = speed(m, motion)
        force = self.force + (self.static_force - self.force) * m.exp(-((s / self.speed) ** 2))
        return along(motion, -force * m.tanh(s / STICTION_SPEED) / s)


@dataclass(frozen=True, kw_only=True)
class QuadraticDrag(HovercraftEffect):
    """Aerodynamic drag: −k·s·(vx, vy)."""

    name = "quadratic_drag"
    equation = "force −k·s·(vx, vy)"

    coefficient: float = parameter(
        0.0, unit="N.s2/m2", bounds=(0, 10), neutral=0.0, typical=0.3, doc="drag coefficient k"
    )

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return along(motion, -self.coefficient * speed(m, motion))


@dataclass(frozen=True, kw_only=True)
class YawDamping(HovercraftEffect):
    """Viscous moment −d·ψ̇."""

    name = "yaw_damping"
    equation = "moment −d·ψ̇"

    coefficient: float = parameter(
        0.0, unit="N.m.s/rad", bounds=(0, 0.5), neutral=0.0, typical=0.004, doc="damping coefficient d"
    )

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.coefficient * motion.psi_dot, 0.0


@dataclass(frozen=True, kw_only=True)
class YawCoulombFriction(HovercraftEffect):
    """Dry moment −M·tanh(ψ̇/0.02)."""

    name = "yaw_coulomb_friction"
    equation = "moment −M·tanh(ψ̇/0.02)"

    moment: float = parameter(0.0, unit="N.m", bounds=(0, 0.1), neutral=0.0, typical=0.004, doc="dry friction moment M")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.moment * m.tanh(motion.psi_dot / STICTION_YAW_RATE), 0.0
