"""Catalogue of effects missing in the base model of the hovercraft, and the hooks of its equations where they act.

    command → shape → lag ← tilt_rate → thrust_factor → wrench (sensed) → acceleration (not sensed)

An effect overrides some of these hooks. The craft calls only hooks that active effects override.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, dataclass_transform

from cosim.model import Delay, Effect, Namespace, Number, Quantity, Values, parameter, size
from cosim.model.planar import local_vector
from plant.powertrain import second_order

Pair = tuple[Number, Number]
Wrench = tuple[Number, Number, Number, Number]


@dataclass_transform(frozen_default=True, kw_only_default=True)
def frozen(kind: type[Any]) -> type[Any]:
    """Turn a class of parameters into a frozen dataclass with keyword-only fields."""
    return dataclass(frozen=True, kw_only=True)(kind)


def bounded(default: float, unit: str, bounds: tuple[float, float], doc: str) -> Any:
    """Declare a parameter by default, unit, bounds and meaning."""
    return parameter(default, unit=unit, bounds=bounds, doc=doc)


class Motion(NamedTuple):
    """Arguments of forces: velocities [m/s, rad/s] and the propellers' total force [N]."""

    vx: Number
    vy: Number
    psi_dot: Number
    thrust_x: Number
    thrust_z: Number


class HovercraftEffect(Effect):
    """An effect of the hovercraft's equations. Pairs contain the values for (right, left)."""

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        """Return tilt rates [rad/s] that replace `rate`, and the derivatives of the effect's states."""
        return rate, ()

    def thrust_factor(self, m: Namespace, t: Number, vx: Number) -> Pair:
        """Return the factors on the right and left thrust."""
        return 1.0, 1.0

    def wrench(self, m: Namespace, motion: Motion) -> Wrench:
        """Return the effect's contact force (forward, rightward [N]) and its yaw and roll moments [N m].

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

    width: float = size("rad", (0, 0.5), 0.02, "total width w of the play")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        half = 0.5 * self.width
        play = tuple(clip(m, p, a - half, a + half) for p, a in zip(memory, command[2:], strict=True))
        return (*command[:2], *play), play


TiltOffset = HovercraftEffect.named(
    "tilt_offset",  # of misaligned servo horns
    equation="α_cmd,R + r, α_cmd,L + l",
    right=size("rad", (-0.2, 0.2), 0.01, "offset r of the right tilt"),
    left=size("rad", (-0.2, 0.2), 0.01, "offset l of the left tilt"),
    shape=lambda e, m, t, h, u, memory: ((u[0], u[1], u[2] + e.right, u[3] + e.left), memory),
)
# α − clip(α, ±w) is the dead band without a branch
ServoDeadBand = HovercraftEffect.named(
    "servo_dead_band",
    equation="α_cmd − w·sign(α_cmd), 0 inside ±w",
    width=size("rad", (0, 0.3), 0.02, "half width w of the band"),
    shape=lambda e, m, t, h, u, memory: ((*u[:2], *(a - clip(m, a, -e.width, e.width) for a in u[2:])), memory),
)


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

    natural_frequency: float = size("rad/s", (0, 100), 15.0, "natural frequency ωₙ; 0 = off")
    damping_ratio: float = bounded(0.7, "1", (0.02, 2.5), "damping ratio ζ")

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        w, zeta = self.natural_frequency, self.damping_ratio
        rates = tuple(m.where(w > 0.0, own, first) for own, first in zip(states, rate, strict=True))
        return rates, tuple(
            second_order(target, alpha, own, w, zeta) for target, alpha, own in zip(command, tilt, states, strict=True)
        )


# rate limit after the lag; under load, r may be far below the 7.5 rad/s of the data sheet
ServoRateLimit = HovercraftEffect.named(
    "servo_rate_limit",
    equation="|α̇_i| ≤ r, after the lag",
    rate=size("rad/s", (0, 50), 1.0, "largest tilt rate r; 0 = off"),
    tilt_rate=lambda e, m, rates, command, tilt, states: (
        tuple(m.where(e.rate > 0.0, clip(m, rate, -e.rate, e.rate), rate) for rate in rates),
        (),
    ),
)

# -- thrust of the propellers

ThrustAsymmetry = HovercraftEffect.named(
    "thrust_asymmetry",
    equation="T_R·(1 + ε), T_L·(1 − ε)",
    ratio=size("1", (-0.5, 0.5), 0.02, "asymmetry ε"),
    thrust_factor=lambda e, m, t, vx: (1.0 + e.ratio, 1.0 - e.ratio),
)
BatterySag = HovercraftEffect.named(  # t is the simulation time
    "battery_sag",
    equation="both thrusts × (1 − p·(1 − e^(−t/θ)))",
    drop=size("1", (0, 0.9), 0.1, "share p of the thrust lost in the end"),
    time=bounded(15.0, "s", (0.5, 600), "time constant θ"),
    thrust_factor=lambda e, m, t, vx: (1.0 - e.drop * (1.0 - m.exp(-t / e.time)),) * 2,
)
InflowThrustLoss = HovercraftEffect.named(  # thrust loss by air flow into the propeller disc
    "inflow_thrust_loss",
    equation="both thrusts × (1 − κ·vx)",
    coefficient=size("s/m", (0, 2), 0.2, "loss κ per forward speed"),
    thrust_factor=lambda e, m, t, vx: (1.0 - e.coefficient * vx,) * 2,
)

# -- forces and moments against the motion, with the speed over the table s = √(vx² + vy²)

STICTION_SPEED = 0.01  # [m/s] speed below which dry friction is smoothed
STICTION_YAW_RATE = 0.02  # [rad/s] yaw rate below which dry friction is smoothed
# keeps 1/s finite at rest; far below the speed at which tanh(s/0.01) becomes nonlinear
REST = 1e-24


def speed(m: Namespace, motion: Motion) -> Number:
    """Return the positive speed over the table [m/s]."""
    return m.sqrt(motion.vx * motion.vx + motion.vy * motion.vy + REST)


def along(motion: Motion, gain: Number) -> Wrench:
    """Return a force of `gain` times the velocity vector, without moments."""
    return gain * motion.vx, gain * motion.vy, 0.0, 0.0


def dry(m: Namespace, motion: Motion, force: Number) -> Wrench:
    """Return the force of dry friction, −F·tanh(s/0.01)·(vx, vy)/s."""
    s = speed(m, motion)
    return along(motion, -force * m.tanh(s / STICTION_SPEED) / s)


CoulombFriction = HovercraftEffect.named(
    "coulomb_friction",
    equation="force −F·tanh(s/0.01)·(vx, vy)/s",
    force=size("N", (0, 2), 0.05, "dry friction force F"),
    wrench=lambda e, m, motion: dry(m, motion, e.force),
)
StribeckFriction = HovercraftEffect.named(
    "stribeck_friction",
    equation="force −(F + (F_s − F)·e^(−(s/v_s)²))·tanh(s/0.01)·(vx, vy)/s",
    at_least={"static_force": "force"},
    force=size("N", (0, 2), 0.05, "sliding friction force F"),
    static_force=size("N", (0, 2), 0.08, "breakaway force F_s"),
    speed=bounded(0.05, "m/s", (0.005, 1), "Stribeck speed v_s"),
    wrench=lambda e, m, motion: dry(
        m, motion, e.force + (e.static_force - e.force) * m.exp(-((speed(m, motion) / e.speed) ** 2))
    ),
)
QuadraticDrag = HovercraftEffect.named(  # aerodynamic
    "quadratic_drag",
    equation="force −k·s·(vx, vy)",
    coefficient=size("N.s2/m2", (0, 10), 0.3, "drag coefficient k"),
    wrench=lambda e, m, motion: along(motion, -e.coefficient * speed(m, motion)),
)
YawDamping = HovercraftEffect.named(
    "yaw_damping",
    equation="moment −d·ψ̇",
    coefficient=size("N.m.s/rad", (0, 0.5), 0.004, "damping coefficient d"),
    wrench=lambda e, m, motion: (0.0, 0.0, -e.coefficient * motion.psi_dot, 0.0),
)
YawCoulombFriction = HovercraftEffect.named(
    "yaw_coulomb_friction",
    equation="moment −M·tanh(ψ̇/0.02)",
    moment=size("N.m", (0, 0.1), 0.004, "dry friction moment M"),
    wrench=lambda e, m, motion: (0.0, 0.0, -e.moment * m.tanh(motion.psi_dot / STICTION_YAW_RATE), 0.0),
)

# -- rigid body and table

ComOffset = HovercraftEffect.named(
    "com_offset",
    equation="yaw moment −e·(F_Rx + F_Lx), roll moment −e·(F_Rz + F_Lz)",
    right=size("m", (-0.1, 0.1), 0.004, "offset e of the CoM to the right"),
    wrench=lambda e, m, motion: (0.0, 0.0, -e.right * motion.thrust_x, -e.right * motion.thrust_z),
)
TableTilt = HovercraftEffect.named(
    "table_tilt",
    equation="force m·g·(sin θ_X, sin θ_Y) along world X, Y, not felt by the accelerometer",
    x=size("rad", (-0.1, 0.1), 0.003, "slope θ_X, downhill along world X"),
    y=size("rad", (-0.1, 0.1), 0.003, "slope θ_Y, downhill along world Y"),
    acceleration=lambda e, m, g, psi, vx, vy, psi_dot: local_vector(m, psi, g * m.sin(e.x), g * m.sin(e.y)),
)
Coriolis = HovercraftEffect.named(  # rotation of the body axes, neglected in the thesis
    "coriolis",
    equation="v̇x −= κ·ψ̇·vy, v̇y += κ·ψ̇·vx; κ = 1 is physics",
    gain=size("1", (-5, 5), 0.5, "gain κ; physics says 1"),
    acceleration=lambda e, m, g, psi, vx, vy, psi_dot: (-e.gain * psi_dot * vy, e.gain * psi_dot * vx),
)

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
