"""Poles placed, each axis by its own: offline design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from controller.design_model import STATES, Matrix, ModelNumbers, design_model

# 6.2 prints no poles. Forward: those of the LQR (-10.68, -3.39, -1.56) with the slow ones drawn a little to the left;
# turn: its pair (-4.26 ± 0.77j) made real. -4 stands in both axes, none twice in one.
POLES = (-2.0, -4.0, -11.0, -4.0, -5.0)
# [rad/s] how far left of the imaginary axis a pole that is asked for must lie: nearer, whether it grows as it flies is
# within the rounding with which poles of the sampled loop are found (`GROWS` in `controller.stability`)
LEFT = 1e-3
FORWARD, TURN = (0, 1, 4), (2, 3)  # states (x, vx, a) and (psi, psi_dot)
SIGNS = ((1.0, 1.0), (1.0, -1.0))  # of the tilts: both forward, or against each other
ALIKE = 1e-9  # of its size: poles no further apart are equal


def placed_gain(p: ModelNumbers, poles: Sequence[complex] = POLES) -> Matrix:
    """K (2, 5) with which A − B·K has the five poles [rad/s]: three of the forward axis, then two of the turn.

    The tilts together move the craft forward and their difference turns it, so each axis has one input and its gain is
    unique: at most two poles are equal, one in either axis.
    Raises ValueError where a pole is not stable, equal within an axis, without its conjugate, or out of reach.
    """
    from scipy.signal import place_poles

    A, B = design_model(p)
    check_controllable(A, B)
    wanted = [complex(pole) for pole in poles]
    if faults := pole_faults(wanted):
        raise ValueError("; ".join(said for _, said in faults))
    K = np.zeros((2, 5))
    for states, own, signs in zip((FORWARD, TURN), (wanted[:3], wanted[3:]), SIGNS, strict=True):
        axis = np.ix_(states, states)
        gain = place_poles(A[axis], B[list(states)] @ np.array(signs)[:, None], own).gain_matrix[0]
        K[:, states] = np.outer(signs, gain)
    return K


def check_controllable(A: Matrix, B: Matrix, names: Sequence[str] = STATES) -> None:
    """ValueError with the pole that no input moves and the states it is seen in, by Hautus: rank [λI − A, B] < n."""
    poles, left = np.linalg.eig(A.T)
    for pole, vector in zip(poles, left.T, strict=True):
        reach = np.hstack([pole * np.eye(len(A)) - A, B])
        scale = np.linalg.norm(reach, axis=1)[:, None]
        if np.linalg.matrix_rank(reach / np.where(scale > 0, scale, 1.0), tol=1e-9) < len(A):
            seen = [n for n, v in zip(names, vector, strict=True) if abs(v) > 1e-6]
            raise ValueError(f"no input moves the pole {said(complex(pole))} rad/s, of {', '.join(seen)}")


def pole_faults(poles: Sequence[complex]) -> list[tuple[int, str]]:
    """What is wrong with poles that are asked for: which one of the five, and why."""
    of_axes = ("forward", 0, poles[:3]), ("turning", 3, poles[3:])
    return [(first + k, said) for axis, first, of in of_axes for k, said in _faults(axis, of)]


def _faults(axis: str, poles: Sequence[complex]) -> list[tuple[int, str]]:
    numbered = list(enumerate(poles))
    faults = [(k, _too_far_right(a)) for k, a in numbered if a.real > -LEFT]
    for k, a in numbered:
        if any(abs(a - b) <= ALIKE * abs(a) for b in poles[:k]):
            faults.append((k, f"{said(a)} stands twice in the {axis} axis; one input places a pole once"))
        if a.imag and not any(abs(a.conjugate() - b) <= ALIKE * abs(a) for b in poles):
            faults.append((k, f"{said(a)} needs {said(a.conjugate())} in the same axis"))
    return faults


def _too_far_right(pole: complex) -> str:
    """Why it is none to ask for."""
    if pole.real >= 0.0:
        return f"{said(pole)} rad/s is not stable; the real part of a pole is below 0"
    return (
        f"{said(pole)} rad/s is too slow: what it moves takes {1.0 / -pole.real:.0f} s to fall to 37 %, and nearer to 0"
        f" than {LEFT:g} rad/s it cannot be told from one that grows; take {-LEFT:g} rad/s or further left"
    )


def said(pole: complex) -> str:
    """A pole as one writes it."""
    return f"{pole.real:g}{pole.imag:+g}j" if pole.imag else f"{pole.real + 0.0:g}"
