"""Effects on the rigid body and on the table."""

from __future__ import annotations

from dataclasses import dataclass

from cosim.model import Namespace, Number, parameter
from cosim.model.planar import local_vector
from plant.effects.hooks import HovercraftEffect, Motion, Pair, Wrench


@dataclass(frozen=True, kw_only=True)
class ComOffset(HovercraftEffect):
    """CoM e to the right of the mid-line: yaw −e·(F_Rx + F_Lx), roll −e·(F_Rz + F_Lz)."""

    name = "com_offset"
    equation = "yaw moment −e·(F_Rx + F_Lx), roll moment −e·(F_Rz + F_Lz)"

    right: float = parameter(
        0.0, unit="m", bounds=(-0.1, 0.1), neutral=0.0, typical=0.004, doc="offset e of the CoM to the right"
    )

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.right * motion.thrust_x, -self.right * motion.thrust_z


@dataclass(frozen=True, kw_only=True)
class TableTilt(HovercraftEffect):
    """Tilted table: force m·g·(sin θ_X, sin θ_Y) along world X, Y, not sensed by the accelerometer."""

    name = "table_tilt"
    equation = "force m·g·(sin θ_X, sin θ_Y) along world X, Y, not felt by the accelerometer"

    x: float = parameter(
        0.0, unit="rad", bounds=(-0.1, 0.1), neutral=0.0, typical=0.003, doc="slope θ_X, downhill along world X"
    )
    y: float = parameter(
        0.0, unit="rad", bounds=(-0.1, 0.1), neutral=0.0, typical=0.003, doc="slope θ_Y, downhill along world Y"
    )

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        return local_vector(m, psi, gravity * m.sin(self.x), gravity * m.sin(self.y))


@dataclass(frozen=True, kw_only=True)
class Coriolis(HovercraftEffect):
    """Rotation of the body axes, neglected in the thesis: v̇x −= κ·ψ̇·vy, v̇y += κ·ψ̇·vx."""

    name = "coriolis"
    equation = "v̇x −= κ·ψ̇·vy, v̇y += κ·ψ̇·vx; κ = 1 is physics"

    gain: float = parameter(0.0, unit="1", bounds=(-5, 5), neutral=0.0, typical=0.5, doc="gain κ; physics says 1")

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        return -self.gain * psi_dot * vy, self.gain * psi_dot * vx
