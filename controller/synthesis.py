"""Offline design: parameters of a craft, LQR gains from weights, pole placement, stability of the sampled loop."""

from __future__ import annotations

import cmath
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from controller.design_model import Matrix, design_model, discretize
from controller.observers import kalman_filter
from controller.settings import SIDES, Numbers, Settings
from cosim.model import SCALAR
from cosim.model.symbolic.linearize import linearize
from plant.hovercraft import Hovercraft

Q_THESIS = (1.0, 0.5, 0.1, 0.01, 0.0)  # diagonal, eq 6.4
R_THESIS = (1.0, 1.0)
Q_INTEGRAL = (0.3, 0.05)  # diagonal for the integrals of x and ψ, chosen here
STABLE_DECAY = 1e-6  # [rad/s] smallest distance of a pole of an LQR from the imaginary axis
# Operating point of the viscous friction: about the mean of the manoeuvre. At rest, the slope of dry friction is no
# damping.
WORKING_SPEED, WORKING_YAW_RATE = 0.4, 1.0  # [m/s], [rad/s]
# Section 6.2 prints no poles. Forward: those of the LQR (-10.68, -3.39, -1.56), the slow ones moved slightly left;
# turn: its pair (-4.26 ± 0.77j) made real. -4 occurs in both axes, but only once in each.
POLES = (-2.0, -4.0, -11.0, -4.0, -5.0)
# [rad/s] least distance of requested poles from the imaginary axis; closer poles would be indistinguishable from
# growing ones within the rounding of the sampled loop (`MAX_GROWTH`)
MIN_DECAY = 1e-3
SAME_POLE = 1e-9  # relative distance below which poles are equal
# states (x, vx, a) and (psi, psi_dot) of the axes, and the signs of the tilts: common, or differential
CONTROLLED_AXES = (((0, 1, 4), (1.0, 1.0)), ((2, 3), (1.0, -1.0)))


def numbers_of(craft: Hovercraft) -> dict[str, float]:
    """Return the design model parameters of a hovering craft with its effects, named as in `Settings`.

        thrust_nominal: m/2·Σ ∂v̇x/∂α_i of the hovering craft
        lag: mean delay of a tilt after its command, −G'(0)/G(0) of G(s) = C·(sI − A)⁻¹·B (τ of first order, 2ζ/ωₙ of
            second), plus the command delay
        friction, yaw_damping: opposing force or moment divided by the working speed or yaw rate

    Asymmetry, offsets, backlash, dead band, rate limit and inflow cannot be represented by five symmetric states.
    """
    linear = linearize(craft)
    names, inputs = linear.states, linear.inputs

    def slope(rate: str, of: str) -> float:
        return float(linear.A[names.index(rate), names.index(of)])

    tilts = [k for k, name in enumerate(names) if "tilt" in name]
    A, B = linear.A[np.ix_(tilts, tilts)], linear.B[tilts, inputs.index("tilt_right")]
    right, once = [names[k] for k in tilts].index("tilt_right"), np.linalg.solve(A, B)
    mean_delay = float(-np.linalg.solve(A, once)[right] / once[right])
    derivative = craft.equations(SCALAR).derivative

    def damping(state: str, rate: float) -> float:
        """Return the deceleration per rate [1/s] at ±rate without constant forces: (f(−v) − f(v))/2v."""
        back, forth = (
            float(derivative(0.0, craft.start({state: at}), craft.start_command())[names.index(state)])
            for at in (-rate, rate)
        )
        return (back - forth) / (2.0 * rate)

    return {
        "mass": craft.mass,
        "izz": craft.izz,
        "arm": craft.arm,
        "friction": craft.mass * damping("vx", WORKING_SPEED),
        "lag": mean_delay + sum(effect.time for effect in craft.awake if effect.name == "actuator_delay"),
        "thrust_nominal": 0.5 * craft.mass * sum(slope("vx", f"tilt_{side}") for side in SIDES),
        "yaw_damping": craft.izz * damping("psi_dot", WORKING_YAW_RATE),
        "duty_nominal": craft.duty_nominal,
    }


def lqr_gain(p: Settings, Q: Numbers = Q_THESIS, R: Numbers = R_THESIS, Q_integral: Numbers = ()) -> Matrix:
    """Return the LQR gain K (2, 5), which minimises ∫ x'Qx + u'Ru for the design model, eqs 6.1-6.3.

    Args:
        Q: Diagonal of the state weights.
        R: Diagonal of the input weights.
        Q_integral: Diagonal of the weights of the integrals of x and ψ; with it, K (2, 7) has their gains last.

    Raises:
        ValueError: No stabilising gain exists.
    """
    import control  # 1 s to import: only where a gain is designed

    integrated = np.eye(5)[[0, 2]] if len(Q_integral) else None
    try:
        K, _, poles = control.lqr(*design_model(p), np.diag([*Q, *Q_integral]), np.diag(R), integral_action=integrated)
        # An integrator without weight remains uncontrolled, and the solver does not report it.
        slowest = max(np.real(poles))
        reason = f"a pole is at {slowest:.2g} rad/s" if slowest > -STABLE_DECAY else ""
    except np.linalg.LinAlgError as error:
        reason = str(error)
    if reason:
        raise ValueError(
            f"no stabilising gain exists for these weights: {reason}; give every position a weight above 0"
        )
    return np.asarray(K, dtype=float)


def placed_gain(p: Settings, poles: Sequence[complex] = POLES) -> Matrix:
    """Return K (2, 5) for the five poles of A − B·K [rad/s]: three of the forward axis, then two of the turn.

    The common tilt moves the craft forward, the tilt difference turns the craft. Each axis thus has a single input, a
    unique gain and poles distinct within the axis (`pole_faults`).
    """
    from scipy.signal import place_poles

    A, B = design_model(p)
    K = np.zeros((2, 5))
    for (states, signs), own in zip(CONTROLLED_AXES, (poles[:3], poles[3:]), strict=True):
        axis = np.ix_(states, states)
        gain = place_poles(A[axis], B[list(states)] @ np.array(signs)[:, None], np.array(own)).gain_matrix[0]
        K[:, states] = np.outer(signs, gain)
    return K


def pole_faults(poles: Sequence[complex]) -> Iterator[tuple[int, str]]:
    """Yield the index of each invalid pole, and a sentence on its fault."""
    for axis, first, of in (("forward", 0, poles[:3]), ("turning", 3, poles[3:])):
        for k, a in enumerate(of):
            pole = format_pole(a)
            if a.real >= 0.0:
                yield first + k, f"{pole} rad/s is not stable; the real part of a pole must be below 0"
            elif a.real > -MIN_DECAY:
                text = f"{pole} rad/s is so close to 0 that it cannot be distinguished from an unstable pole"
                yield first + k, f"{text}; make its real part -{MIN_DECAY:g} rad/s or more negative"
            if any(abs(a - b) <= SAME_POLE * abs(a) for b in of[:k]):
                yield first + k, f"{pole} occurs twice in the {axis} axis; with one input, poles must be distinct"
            if a.imag and not any(abs(a.conjugate() - b) <= SAME_POLE * abs(a) for b in of):
                yield first + k, f"{pole} needs {format_pole(a.conjugate())} in the same axis"


def format_pole(pole: complex) -> str:
    """Return a pole as text."""
    return f"{pole.real:g}{pole.imag:+g}j" if pole.imag else f"{pole.real + 0.0:g}"


# -- stability of fixed gains in the sampled loop -------------------------------------------------
# Eqs 5.33/5.34 describe the turn without lag and without sampling. The real loop has both, and it feeds back the
# filter's estimate instead of the true state.

# States of the craft (vx, psi, psi_dot, tilt_right, tilt_left): the tilts, and what they move that acts on the IMU
PSI, PSI_DOT, RIGHT, LEFT = 1, 2, 3, 4  # indices among these states
TURNING = {PSI, PSI_DOT, 5 + 2, 5 + 3, 10 + 1}  # indices among all states of the loop, without tilts
MAX_GROWTH = 1e-3  # [rad/s] poles further right grow; uncontrolled poles are at 0 within rounding
MIN_DAMPING = 0.1  # damping ratio; an oscillation keeps exp(-2π·0.1), more than half of its amplitude, in each period
MAX_CHANGE, MAX_UPDATES = 1e-9, 3000  # convergence of the filter gain


class LoopMode(NamedTuple):
    """A pole of the sampled loop, written as s = ln(z)/Δt [rad/s], and the axis of its motion: forward or turning."""

    pole: complex
    axis: str

    @property
    def grows(self) -> bool:
        """Return True if the mode grows: its pole z is outside the unit circle."""
        return self.pole.real > MAX_GROWTH

    @property
    def damping(self) -> float:
        """Return ζ = −Re s/|s|, 1 without oscillation."""
        return -self.pole.real / abs(self.pole) if self.pole.imag else 1.0


def flown_modes(p: Settings, K: Matrix) -> list[LoopMode]:
    """Return the modes of craft, hold and filter at hover with ψ = 0, without saturation and fixes, fastest first.

         xₖ₊₁ = F·xₖ + G·uₖ,   zₖ₊₁ = H·xₖ₊₁,   x̂ₖ₊₁ = F̂·x̂ₖ + Ĝ·uₖ + L·(zₖ₊₁ − Ĥ·(F̂·x̂ₖ + Ĝ·uₖ)),   uₖ = −K·(x̂ₖ, ξₖ)

    F, G belong to the craft with lag on both axes and held inputs; F̂, Ĝ, Ĥ to the design model, both with the numbers
    p of the controller; L is the steady gain of the estimator. The modes are those of the craft's five states, x̂, and
    the integrals ξ of x and ψ where K (2, 7) has their gains.

    Raises:
        LinAlgError: The estimator has no steady gain.
    """
    push, turn = p.thrust_nominal / p.mass, p.arm * p.thrust_nominal / p.izz
    A, B = np.diag([-p.friction / p.mass, 0.0, -p.yaw_damping / p.izz, *[-1.0 / p.lag] * 2]), np.zeros((5, 2))
    A[0, RIGHT:], A[PSI, PSI_DOT], A[PSI_DOT, RIGHT:], B[RIGHT:] = push, 1.0, (turn, -turn), np.eye(2) / p.lag
    F, G = discretize(A, B, p.sample_time)
    H = np.vstack([np.eye(len(A))[[PSI, PSI_DOT]], A[:1]])  # a_x = v̇x
    kf, last = kalman_filter(p, np.zeros(5)), np.zeros((5, 3))
    for _ in range(MAX_UPDATES):
        kf.predict()
        kf.update(np.zeros(3))
        if np.abs(kf.K - last).max() <= MAX_CHANGE:
            break
        last = kf.K.copy()
    u = -np.hstack([np.zeros((2, 5)), K])
    n = u.shape[1]
    now = np.eye(n)
    x = F @ now[:5] + G @ u
    predicted = kf.F @ now[5:10] + kf.B @ u
    x_hat = predicted + kf.K @ (H @ x - kf.H @ predicted)
    integrals = now[10:] + p.sample_time * np.vstack([x_hat[:1], x[PSI : PSI + 1]]) if n > 10 else now[10:]
    values, vectors = np.linalg.eig(np.vstack([x, x_hat, integrals]))
    modes = []
    for z, vector in zip(values.tolist(), vectors.T, strict=True):
        if z:  # common tilt for forward, tilt difference for turning
            weight = np.abs(vector) ** 2
            turning = abs(vector[RIGHT] - vector[LEFT]) ** 2 / 2 + sum(weight[k] for k in TURNING if k < n)
            axis = "turning" if turning > 0.5 * weight.sum() else "forward"
            modes.append(LoopMode(cmath.log(z) / p.sample_time, axis))
    return sorted(modes, key=lambda mode: -mode.pole.real)


def worst_modes(modes: Sequence[LoopMode]) -> list[LoopMode]:
    """Return the worst growing or weakly damped mode of each axis."""
    by_axis: dict[str, LoopMode] = {}
    for mode in sorted(modes, key=lambda m: (not m.grows, -m.pole.real if m.grows else m.damping)):
        if mode.grows or mode.damping < MIN_DAMPING:
            by_axis.setdefault(mode.axis, mode)
    return list(by_axis.values())
