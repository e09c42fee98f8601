"""Catalogue of effects missing in the base model of the hovercraft, and the hooks of its equations where they act.

    command → shape → lag ← tilt_rate → thrust_factor → wrench (sensed) → acceleration (not sensed)

An effect overrides some hooks; the craft calls only overridden hooks of active effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, dataclass_transform

from cosim.model import Delay, Effect, Namespace, Number, Quantity, Values, parameter
from cosim.model.planar import local_vector
from plant.powertrain import second_order

Pair = tuple[Number, Number]
Wrench = tuple[Number, Number, Number, Number]


@dataclass_transform(frozen_default=True, kw_only_default=True)
def frozen(kind: type[Any]) -> type[Any]:
    """Make a class of parameters a frozen dataclass whose fields are given by name."""
    return dataclass(frozen=True, kw_only=True)(kind)


def bounded(default: float, unit: str, bounds: tuple[float, float], doc: str) -> Any:
    """Return a parameter from its default, unit, bounds and meaning."""
    return parameter(default, unit=unit, bounds=bounds, doc=doc)


def off_at_zero(unit: str, bounds: tuple[float, float], typical: float, doc: str) -> Any:
    """Return a parameter whose default 0 makes the effect dormant."""
    return parameter(0.0, unit=unit, bounds=bounds, neutral=0.0, typical=typical, doc=doc)


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
        """Return the contact force of the effect (forward, rightward [N]) and its yaw and roll moments [N m].

        The accelerometer measures these forces.
        """
        return 0.0, 0.0, 0.0, 0.0

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        """Return forward and rightward acceleration [m/s²] that the accelerometer does not measure."""
        return 0.0, 0.0


# -- between command and propeller: delay, backlash, offset, dead band, then lag and rate limit


def clip(m: Namespace, value: Number, low: Number, high: Number) -> Number:
    """Return `value` limited to `low` … `high`."""
    return m.minimum(m.maximum(value, low), high)


@frozen
class ActuatorDelay(Delay, HovercraftEffect):
    """Delay of all four commands by T: u(t) → u(t − T)."""

    name = "actuator_delay"
    equation = "u(t) → u(t − T), all four commands"
    memory = (
        Quantity("duty_right", "%", "right duty that acts until the delay has passed"),
        Quantity("duty_left", "%", "left duty that acts until the delay has passed"),
        Quantity("tilt_right", "rad", "right tilt command that acts until the delay has passed"),
        Quantity("tilt_left", "rad", "left tilt command that acts until the delay has passed"),
    )


@frozen
class ServoBacklash(HovercraftEffect):
    """Backlash of total width w on the tilt commands: p ← clip(p, α_cmd − w/2, α_cmd + w/2)."""

    name = "servo_backlash"
    equation = "p ← clip(p, α_cmd − w/2, α_cmd + w/2), p in place of α_cmd"
    memory = (
        Quantity("play_right", "rad", "right tilt command after the play"),
        Quantity("play_left", "rad", "left tilt command after the play"),
    )

    width: float = off_at_zero("rad", (0, 0.5), 0.02, "total width w of the play")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        half = 0.5 * self.width
        play = tuple(clip(m, p, a - half, a + half) for p, a in zip(memory, command[2:], strict=True))
        return (*command[:2], *play), play


@frozen
class TiltOffset(HovercraftEffect):
    """Offset of misaligned servo horns: α_cmd,R + r, α_cmd,L + l."""

    name = "tilt_offset"
    equation = "α_cmd,R + r, α_cmd,L + l"

    right: float = off_at_zero("rad", (-0.2, 0.2), 0.01, "offset r of the right tilt")
    left: float = off_at_zero("rad", (-0.2, 0.2), 0.01, "offset l of the left tilt")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        duty_right, duty_left, tilt_right, tilt_left = command
        return (duty_right, duty_left, tilt_right + self.right, tilt_left + self.left), memory


@frozen
class ServoDeadBand(HovercraftEffect):
    """Dead band around neutral: α_cmd − w·sign(α_cmd), 0 inside ±w."""

    name = "servo_dead_band"
    equation = "α_cmd − w·sign(α_cmd), 0 inside ±w"

    width: float = off_at_zero("rad", (0, 0.3), 0.02, "half width w of the band")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        w = self.width
        # α − clip(α, ±w) is the equation without a branch
        return (*command[:2], *(a - clip(m, a, -w, w) for a in command[2:])), memory


@frozen
class ActuatorSecondOrder(HovercraftEffect):
    """Second-order tilt instead of the first-order lag: α̈ = ωₙ²·(α_cmd − α) − 2ζωₙ·α̇ (overshoot in §4.5.4)."""

    name = "actuator_second_order"
    equation = "α̈ = ωₙ²·(α_cmd − α) − 2ζωₙ·α̇ in place of the first-order tilt lag"
    states: ClassVar[tuple[Quantity, ...]] = (
        Quantity("tilt_rate_right", "rad/s", "rate of the right tilt"),
        Quantity("tilt_rate_left", "rad/s", "rate of the left tilt"),
    )
    starts = ({"natural_frequency": 25.0, "damping_ratio": 1.0},)  # fast and overdamped resembles slow and underdamped

    natural_frequency: float = off_at_zero("rad/s", (0, 100), 15.0, "natural frequency ωₙ; 0 = off")
    damping_ratio: float = bounded(0.7, "1", (0.02, 2.5), "damping ratio ζ")

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        w, zeta = self.natural_frequency, self.damping_ratio
        rates = tuple(m.where(w > 0.0, own, first) for own, first in zip(states, rate, strict=True))
        return rates, tuple(
            second_order(target, alpha, own, w, zeta) for target, alpha, own in zip(command, tilt, states, strict=True)
        )


@frozen
class ServoRateLimit(HovercraftEffect):
    """Slew limit after the lag: |α̇_i| ≤ r. Under load, r may be far below the 7.5 rad/s of the data sheet."""

    name = "servo_rate_limit"
    equation = "|α̇_i| ≤ r, after the lag"

    rate: float = off_at_zero("rad/s", (0, 50), 1.0, "largest tilt rate r; 0 = off")

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        r = self.rate
        right, left = (m.where(r > 0.0, clip(m, rate_i, -r, r), rate_i) for rate_i in rate)
        return (right, left), ()


# -- thrust of the propellers


@frozen
class ThrustAsymmetry(HovercraftEffect):
    """Unequal propellers: T_R·(1 + ε), T_L·(1 − ε)."""

    name = "thrust_asymmetry"
    equation = "T_R·(1 + ε), T_L·(1 − ε)"

    ratio: float = off_at_zero("1", (-0.5, 0.5), 0.02, "asymmetry ε")

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        return 1.0 + self.ratio, 1.0 - self.ratio


@frozen
class BatterySag(HovercraftEffect):
    """Discharging battery: both thrusts × (1 − p·(1 − e^(−t/θ))), t the simulation time."""

    name = "battery_sag"
    equation = "both thrusts × (1 − p·(1 − e^(−t/θ)))"

    drop: float = off_at_zero("1", (0, 0.9), 0.1, "share p of the thrust lost in the end")
    time: float = bounded(15.0, "s", (0.5, 600), "time constant θ")

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        factor = 1.0 - self.drop * (1.0 - m.exp(-t / self.time))
        return factor, factor


@frozen
class InflowThrustLoss(HovercraftEffect):
    """Thrust loss by air flow into the disc: both thrusts × (1 − κ·vx)."""

    name = "inflow_thrust_loss"
    equation = "both thrusts × (1 − κ·vx)"

    coefficient: float = off_at_zero("s/m", (0, 2), 0.2, "loss κ per forward speed")

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        factor = 1.0 - self.coefficient * vx
        return factor, factor


# -- forces and moments against the motion, with the speed over the table s = √(vx² + vy²)

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


@frozen
class CoulombFriction(HovercraftEffect):
    """Dry friction on the table: −F·tanh(s/0.01)·(vx, vy)/s."""

    name = "coulomb_friction"
    equation = "force −F·tanh(s/0.01)·(vx, vy)/s"

    force: float = off_at_zero("N", (0, 2), 0.05, "dry friction force F")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        s = speed(m, motion)
        return along(motion, -self.force * m.tanh(s / STICTION_SPEED) / s)


@frozen
class StribeckFriction(HovercraftEffect):
    """Friction that decreases with speed: −(F + (F_s − F)·e^(−(s/v_s)²))·tanh(s/0.01)·(vx, vy)/s."""

    name = "stribeck_friction"
    equation = "force −(F + (F_s − F)·e^(−(s/v_s)²))·tanh(s/0.01)·(vx, vy)/s"
    at_least: ClassVar[Mapping[str, str]] = {"static_force": "force"}

    force: float = off_at_zero("N", (0, 2), 0.05, "sliding friction force F")
    static_force: float = off_at_zero("N", (0, 2), 0.08, "breakaway force F_s")
    speed: float = bounded(0.05, "m/s", (0.005, 1), "Stribeck speed v_s")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        s = speed(m, motion)
        force = self.force + (self.static_force - self.force) * m.exp(-((s / self.speed) ** 2))
        return along(motion, -force * m.tanh(s / STICTION_SPEED) / s)


@frozen
class QuadraticDrag(HovercraftEffect):
    """Aerodynamic drag: −k·s·(vx, vy)."""

    name = "quadratic_drag"
    equation = "force −k·s·(vx, vy)"

    coefficient: float = off_at_zero("N.s2/m2", (0, 10), 0.3, "drag coefficient k")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return along(motion, -self.coefficient * speed(m, motion))


@frozen
class YawDamping(HovercraftEffect):
    """Viscous moment −d·ψ̇."""

    name = "yaw_damping"
    equation = "moment −d·ψ̇"

    coefficient: float = off_at_zero("N.m.s/rad", (0, 0.5), 0.004, "damping coefficient d")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.coefficient * motion.psi_dot, 0.0


@frozen
class YawCoulombFriction(HovercraftEffect):
    """Dry moment −M·tanh(ψ̇/0.02)."""

    name = "yaw_coulomb_friction"
    equation = "moment −M·tanh(ψ̇/0.02)"

    moment: float = off_at_zero("N.m", (0, 0.1), 0.004, "dry friction moment M")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.moment * m.tanh(motion.psi_dot / STICTION_YAW_RATE), 0.0


# -- rigid body and table


@frozen
class ComOffset(HovercraftEffect):
    """CoM e to the right of the mid-line: yaw −e·(F_Rx + F_Lx), roll −e·(F_Rz + F_Lz)."""

    name = "com_offset"
    equation = "yaw moment −e·(F_Rx + F_Lx), roll moment −e·(F_Rz + F_Lz)"

    right: float = off_at_zero("m", (-0.1, 0.1), 0.004, "offset e of the CoM to the right")

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        return 0.0, 0.0, -self.right * motion.thrust_x, -self.right * motion.thrust_z


@frozen
class TableTilt(HovercraftEffect):
    """Tilted table: force m·g·(sin θ_X, sin θ_Y) along world X, Y, not sensed by the accelerometer."""

    name = "table_tilt"
    equation = "force m·g·(sin θ_X, sin θ_Y) along world X, Y, not measured by the accelerometer"

    x: float = off_at_zero("rad", (-0.1, 0.1), 0.003, "slope θ_X, downhill along world X")
    y: float = off_at_zero("rad", (-0.1, 0.1), 0.003, "slope θ_Y, downhill along world Y")

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        return local_vector(m, psi, gravity * m.sin(self.x), gravity * m.sin(self.y))


@frozen
class Coriolis(HovercraftEffect):
    """Rotation of the body axes, neglected in the thesis: v̇x −= κ·ψ̇·vy, v̇y += κ·ψ̇·vx."""

    name = "coriolis"
    equation = "v̇x −= κ·ψ̇·vy, v̇y += κ·ψ̇·vx; κ = 1 is physics"

    gain: float = off_at_zero("1", (-5, 5), 0.5, "gain κ; physics says 1")

    def acceleration(self, m: Namespace, gravity: Number, psi: Number, vx: Number, vy: Number, psi_dot: Number) -> Pair:
        return -self.gain * psi_dot * vy, self.gain * psi_dot * vx


# in the order of their action on a command
CATALOGUE = (
    ActuatorDelay,
    ServoBacklash,
    TiltOffset,
    ServoDeadBand,
    ActuatorSecondOrder,
    ServoRateLimit,
    ThrustAsymmetry,
    BatterySag,
    InflowThrustLoss,
    CoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    YawDamping,
    YawCoulombFriction,
    ComOffset,
    TableTilt,
    Coriolis,
)
