"""Effects on the thrust of the propellers."""

from __future__ import annotations

from dataclasses import dataclass

from cosim.model import Namespace, Number, parameter
from plant.effects.hooks import HovercraftEffect, Pair


@dataclass(frozen=True, kw_only=True)
class ThrustAsymmetry(HovercraftEffect):
    """Unequal propellers: T_R·(1 + ε), T_L·(1 − ε)."""

    name = "thrust_asymmetry"
    equation = "T_R·(1 + ε), T_L·(1 − ε)"

    ratio: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.02, doc="asymmetry ε")

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        return 1.0 + self.ratio, 1.0 - self.ratio


@dataclass(frozen=True, kw_only=True)
class BatterySag(HovercraftEffect):
    """Discharging battery: both thrusts × (1 − p·(1 − e^(−t/θ))), t the simulation time."""

    name = "battery_sag"
    equation = "both thrusts × (1 − p·(1 − e^(−t/θ)))"

    drop: float = parameter(
        0.0, unit="1", bounds=(0, 0.9), neutral=0.0, typical=0.1, doc="share p of the thrust lost in the end"
    )
    time: float = parameter(15.0, unit="s", bounds=(0.5, 600), doc="time constant θ")

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        factor = 1.0 - self.drop * (1.0 - m.exp(-t / self.time))
        return factor, factor


@dataclass(frozen=True, kw_only=True)
class InflowThrustLoss(HovercraftEffect):
    """Thrust loss by air flow into the disc: both thrusts × (1 − κ·vx)."""

    name = "inflow_thrust_loss"
    equation = "both thrusts × (1 − κ·vx)"

    coefficient: float = parameter(
        0.0, unit="s/m", bounds=(0, 2), neutral=0.0, typical=0.2, doc="loss κ per forward speed"
    )

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        factor = 1.0 - self.coefficient * vx
        return factor, factor
