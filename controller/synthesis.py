"""Offline design: parameters of the design model from a craft, and LQR gains from weights with `control`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from controller.design_model import Matrix, ModelNumbers, design_model
from cosim.model import SCALAR, Values
from cosim.model.symbolic.linearize import LinearModel, linearize
from plant.hovercraft import Hovercraft

NO_STABILISING_GAIN = "no stabilising gain for these weights: {reason}; weigh every position above 0"

Q_THESIS = (1.0, 0.5, 0.1, 0.01, 0.0)  # diagonal, eq 6.4
R_THESIS = (1.0, 1.0)
Q_INTEGRAL = (0.3, 0.05)  # diagonal for the integrals of x and ψ, chosen here
STABLE = 1e-6  # [rad/s] least distance of a pole from the imaginary axis
# Operating point of the viscous friction: about the mean of the manoeuvre. At rest, the slope of dry friction is no
# damping.
WORKING_SPEED, WORKING_YAW_RATE = 0.4, 1.0  # [m/s], [rad/s]


def numbers_of(craft: Hovercraft) -> dict[str, float]:
    """Return the design model parameters of a craft with its effects, named as in `Settings`.

        thrust_nominal: m/2·Σ ∂v̇x/∂α_i of the hovering craft
        lag: mean delay of a tilt after its command, −G'(0)/G(0) (τ of first order, 2ζ/ωₙ of second), plus the command
            delay
        friction, yaw_damping: opposing force or moment divided by the working speed or yaw rate

    Asymmetry, offsets, backlash, dead band, rate limit and inflow have no place in five symmetric states.
    """
    linear = linearize(craft)
    row = linear.states.index("vx")
    thrust = 0.5 * craft.mass * sum(linear.A[row, linear.states.index(f"tilt_{side}")] for side in ("right", "left"))
    delay = sum(effect.time for effect in craft.awake if effect.name == "actuator_delay")
    return {
        "mass": craft.mass,
        "izz": craft.izz,
        "arm": craft.arm,
        "friction": craft.mass * _damping(craft, "vx", WORKING_SPEED),
        "lag": _mean_delay(linear) + delay,
        "thrust_nominal": float(thrust),
        "yaw_damping": craft.izz * _damping(craft, "psi_dot", WORKING_YAW_RATE),
        "duty_nominal": craft.duty_nominal,
    }


def roll_numbers_of(craft: Hovercraft) -> dict[str, float]:
    """Return the roll and motor parameters that the predictive law uses for a hovering craft with effects.

    From the linearization: k/Ixx = −∂φ̈/∂φ, d_φ/Ixx = −∂φ̈/∂φ̇, L·Γ/Ixx = ∂φ̈/∂T, dT/dδ = τ·∂Ṫ/∂δ, averaged over both
    sides.
    """
    linear = linearize(craft)
    at = {name: k for k, name in enumerate(linear.states)}
    roll = linear.A[at["phi_dot"]]
    lift = 0.5 * (roll[at["thrust_right"]] - roll[at["thrust_left"]])
    duty = [linear.B[at[f"thrust_{side}"], linear.inputs.index(f"duty_{side}")] for side in ("right", "left")]
    return {
        "ixx": craft.ixx,
        "ground_gain": float(lift * craft.ixx / craft.arm),
        "thrust_per_duty": float(craft.lag * sum(duty) / 2.0),
        "roll_stiffness": float(-roll[at["phi"]] * craft.ixx),
        "roll_damping": float(-roll[at["phi_dot"]] * craft.ixx),
    }


def _damping(craft: Hovercraft, state: str, rate: float) -> float:
    """Return the deceleration per rate [1/s] at ±rate without constant forces: (f(−v) − f(v))/2v."""
    derivative = craft.equations(SCALAR).derivative
    row = [q.name for q in craft.states].index(state)

    def acceleration(at: float) -> float:
        moving: Values = craft.start({state: at})
        return float(derivative(0.0, moving, craft.start_command())[row])

    return (acceleration(-rate) - acceleration(rate)) / (2.0 * rate)


def _mean_delay(linear: LinearModel) -> float:
    """Return the mean delay [s] from the command of the right tilt to the tilt.

    The delay is −G'(0)/G(0) with the transfer function G(s) = C·(sI − A)⁻¹·B.
    """
    tilts = [k for k, name in enumerate(linear.states) if "tilt" in name]
    A = linear.A[np.ix_(tilts, tilts)]
    B = linear.B[tilts, linear.inputs.index("tilt_right")]
    right = [linear.states[k] for k in tilts].index("tilt_right")
    once = np.linalg.solve(A, B)
    return float(-np.linalg.solve(A, once)[right] / once[right])


def lqr_gain(p: ModelNumbers, Q: Sequence[float] = Q_THESIS, R: Sequence[float] = R_THESIS) -> Matrix:
    """Return the LQR gain K (2, 5), which minimises ∫ x'Qx + u'Ru for the design model, eqs 6.1-6.3.

    Args:
        Q: Diagonal of the state weights.
        R: Diagonal of the input weights.

    Raises:
        ValueError: No stabilising gain exists, or the weights are invalid.
    """
    if len(Q) != 5 or len(R) != 2 or min(Q) < 0 or min(R) <= 0:
        raise ValueError("Q has five diagonal entries ≥ 0 and R two > 0; correct them")
    return _lqr(*design_model(p), np.diag(Q), np.diag(R))


def integral_gain(
    p: ModelNumbers,
    Q: Sequence[float] = Q_THESIS,
    R: Sequence[float] = R_THESIS,
    Q_integral: Sequence[float] = Q_INTEGRAL,
) -> tuple[Matrix, Matrix]:
    """Return K (2, 5) and K_i (2, 2) of the LQR with integrals of x and ψ.

    All weights are diagonals.

    Raises:
        ValueError: No stabilising gain exists, or the weights are invalid.
    """
    if len(Q) != 5 or len(R) != 2 or len(Q_integral) != 2 or min(Q) < 0 or min(*R, *Q_integral) <= 0:
        raise ValueError("Q has five diagonal entries ≥ 0, R two > 0 and Q_integral two > 0; correct them")
    import control

    system = control.ss(*design_model(p), np.eye(5), 0)
    gain = _lqr(system, np.diag([*Q, *Q_integral]), np.diag(R), integral_action=np.eye(5)[[0, 2]])
    return gain[:, :5], gain[:, 5:]


def _lqr(*problem: Any, **options: Any) -> Matrix:
    """Return the gain of `control.lqr`.

    Raises:
        ValueError: No stabilising gain exists.
    """
    import control  # 1 s to import: only where a gain is designed

    try:
        K, _, poles = control.lqr(*problem, **options)
    except np.linalg.LinAlgError as error:
        raise ValueError(NO_STABILISING_GAIN.format(reason=str(error))) from error
    # An integrator without weight remains uncontrolled, and the solver does not report it.
    if (slowest := max(np.real(poles))) > -STABLE:
        raise ValueError(NO_STABILISING_GAIN.format(reason=f"a pole stays at {slowest:.2g} rad/s"))
    return np.asarray(K, dtype=float)
