"""Effects between command and propeller: delay, backlash, offset, dead band, then lag and rate limit."""

from __future__ import annotations

from dataclasses import dataclass

from cosim.model import Delay, Namespace, Number, Quantity, Values, parameter
from plant.effects.hooks import HovercraftEffect, Pair
from plant.powertrain import second_order


def clip(m: Namespace, value: Number, low: Number, high: Number) -> Number:
    """Return `value` limited to `low` … `high`."""
    return m.minimum(m.maximum(value, low), high)


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True, kw_only=True)
class ServoBacklash(HovercraftEffect):
    """Backlash of total width w on the tilt commands: p ← clip(p, α_cmd − w/2, α_cmd + w/2)."""

    name = "servo_backlash"
    equation = "p ← clip(p, α_cmd − w/2, α_cmd + w/2), p in place of α_cmd"
    memory = (
        Quantity("play_right", "rad", "right tilt command after the play"),
        Quantity("play_left", "rad", "left tilt command after the play"),
    )

    width: float = parameter(
        0.0, unit="rad", bounds=(0, 0.5), neutral=0.0, typical=0.02, doc="total width w of the play"
    )

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        half = 0.5 * self.width
        play = tuple(clip(m, p, a - half, a + half) for p, a in zip(memory, command[2:], strict=True))
        return (*command[:2], *play), play


@dataclass(frozen=True, kw_only=True)
class TiltOffset(HovercraftEffect):
    """Offset of misaligned servo horns: α_cmd,R + r, α_cmd,L + l."""

    name = "tilt_offset"
    equation = "α_cmd,R + r, α_cmd,L + l"

    right: float = parameter(
        0.0, unit="rad", bounds=(-0.2, 0.2), neutral=0.0, typical=0.01, doc="offset r of the right tilt"
    )
    left: float = parameter(
        0.0, unit="rad", bounds=(-0.2, 0.2), neutral=0.0, typical=0.01, doc="offset l of the left tilt"
    )

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        duty_right, duty_left, tilt_right, tilt_left = command
        return (duty_right, duty_left, tilt_right + self.right, tilt_left + self.left), memory


@dataclass(frozen=True, kw_only=True)
class ServoDeadBand(HovercraftEffect):
    """Dead band around neutral: α_cmd − w·sign(α_cmd), 0 inside ±w."""

    name = "servo_dead_band"
    equation = "α_cmd − w·sign(α_cmd), 0 inside ±w"

    width: float = parameter(
        0.0, unit="rad", bounds=(0, 0.3), neutral=0.0, typical=0.02, doc="half width w of the band"
    )

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        w = self.width
        # α − clip(α, ±w) is the equation without a branch
        return (*command[:2], *(a - clip(m, a, -w, w) for a in command[2:])), memory


@dataclass(frozen=True, kw_only=True)
class ActuatorSecondOrder(HovercraftEffect):
    """Second-order tilt instead of the first-order lag: α̈ = ωₙ²·(α_cmd − α) − 2ζωₙ·α̇ (overshoot in §4.5.4)."""

    name = "actuator_second_order"
    equation = "α̈ = ωₙ²·(α_cmd − α) − 2ζωₙ·α̇ in place of the first-order tilt lag"
    states = (
        Quantity("tilt_rate_right", "rad/s", "rate of the right tilt"),
        Quantity("tilt_rate_left", "rad/s", "rate of the left tilt"),
    )
    starts = ({"natural_frequency": 25.0, "damping_ratio": 1.0},)  # fast and overdamped resembles slow and underdamped

    natural_frequency: float = parameter(
        0.0, unit="rad/s", bounds=(0, 100), neutral=0.0, typical=15.0, doc="natural frequency ωₙ; 0 = off"
    )
    damping_ratio: float = parameter(0.7, unit="1", bounds=(0.02, 2.5), doc="damping ratio ζ")

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        w, zeta = self.natural_frequency, self.damping_ratio
        rates = tuple(m.where(w > 0.0, own, first) for own, first in zip(states, rate, strict=True))
        return rates, tuple(
            second_order(target, alpha, own, w, zeta) for target, alpha, own in zip(command, tilt, states, strict=True)
        )


@dataclass(frozen=True, kw_only=True)
class ServoRateLimit(HovercraftEffect):
    """Slew limit after the lag: |α̇_i| ≤ r. Under load, r may be far below the 7.5 rad/s of the data sheet."""

    name = "servo_rate_limit"
    equation = "|α̇_i| ≤ r, after the lag"

    rate: float = parameter(
        0.0, unit="rad/s", bounds=(0, 50), neutral=0.0, typical=1.0, doc="largest tilt rate r; 0 = off"
    )

    def tilt_rate(self, m: Namespace, rate: Pair, command: Pair, tilt: Pair, states: Values) -> tuple[Pair, Values]:
        r = self.rate
        right, left = (m.where(r > 0.0, clip(m, rate_i, -r, r), rate_i) for rate_i in rate)
        return (right, left), ()
