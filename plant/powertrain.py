"""Power-train of one tilting propeller: thrust line, ground effect, lag, thrust vector (thesis ch. 4)."""

from __future__ import annotations

from cosim.model import Namespace, Number


def thrust_out_of_ground(m: Namespace, duty: Number, offset: Number, slope: Number, gravity: Number) -> Number:
    """Return the static thrust [N] out of ground effect, eq 4.20: T_OGE = max(0, a + b·δ)·g/1000.

    δ is in %, a and b in gf.
    """
    return m.maximum(0.0, offset + slope * duty) * gravity / 1000.0


def ground_effect(m: Namespace, z: Number, radius: Number, exponent: Number) -> Number:
    """Return the thrust gain Γ of the ground effect at height z [m].

    Γ = 1/(1 − (R/4z)^k), with z at least R/2. Eq 4.11 is printed with a plus sign; the code of the thesis and Γ/m =
    1.620 of eq E.2 need the minus.
    """
    return 1.0 / (1.0 - (radius / (4.0 * m.maximum(z, 0.5 * radius))) ** exponent)


def lag(target: Number, value: Number, time_constant: Number) -> Number:
    """Return the rate of a first-order lag, eq 4.29: ẋ = (x_target − x)/τ."""
    return (target - value) / time_constant


def second_order(target: Number, value: Number, rate: Number, frequency: Number, damping: Number) -> Number:
    """Return the second derivative of a second-order response: ẍ = ωₙ²·(x_target − x) − 2ζωₙ·ẋ.

    The overshoot of this response was observed in §4.5.4.
    """
    return frequency * frequency * (target - value) - 2.0 * damping * frequency * rate


def servo_angle(duty: Number, neutral: Number, slope: Number) -> Number:
    """Return the commanded servo angle [rad], eq 3.1: α = 0.3927·(d − 7.5).

    d is in % of the frame, slope in rad/%.
    """
    return slope * (duty - neutral)


def servo_rate(
    m: Namespace, target: Number, angle: Number, time_constant: Number, dead_band: Number, fastest: Number
) -> Number:
    """Return the tilt rate of a servo, App. B.2: α̇ = clip((e − clip(e, ±w/2))/τ, ±r), e = α_target − α.

    The servo stops at the edge of the dead band, whose total width is w [rad], and does not reach the target.
    """
    return m.clip(lag(servo_error(m, target, angle, dead_band), 0.0, time_constant), -fastest, fastest)


def servo_error(m: Namespace, target: Number, angle: Number, dead_band: Number) -> Number:
    """Return the effective servo error, App. B.2: e − clip(e, ±w/2), e = α_target − α."""
    half, error = 0.5 * dead_band, target - angle
    return error - m.clip(error, -half, half)


def assembly_moment(m: Namespace, tilt: Number, mass: Number, gravity: Number, arm: Number) -> Number:
    """Return the moment about the tilting axis [N m], eq 4.10: M(α) = m_PA·g·l·sin α."""
    return mass * gravity * arm * m.sin(tilt)


def thrust_vector(m: Namespace, thrust: Number, alpha: Number) -> tuple[Number, Number]:
    """Return forward and upward force of a propeller tilted by α [rad], eq 5.1.

    F_x = T·sin α, F_z = T·cos α.
    """
    return thrust * m.sin(alpha), thrust * m.cos(alpha)
