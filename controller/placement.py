"""Offline pole placement, separate for each axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from controller.design_model import STATES, Matrix, ModelNumbers, design_model

# Section 6.2 prints no poles. Forward: those of the LQR (-10.68, -3.39, -1.56), the slow ones moved slightly left;
# turn: its pair (-4.26 ± 0.77j) made real. -4 occurs in both axes, but only once in each.
POLES = (-2.0, -4.0, -11.0, -4.0, -5.0)
# [rad/s] least distance of requested poles from the imaginary axis; closer poles would be indistinguishable from
# growing ones within the rounding of the sampled loop (`GROWS` in `controller.stability`)
MIN_DECAY = 1e-3
FORWARD, TURN = (0, 1, 4), (2, 3)  # states (x, vx, a) and (psi, psi_dot)
SIGNS = ((1.0, 1.0), (1.0, -1.0))  # signs of the tilts: common, or differential
ALIKE = 1e-9  # relative distance below which poles are equal


def placed_gain(p: ModelNumbers, poles: Sequence[complex] = POLES) -> Matrix:
    """Return K (2, 5) for the five poles of A − B·K [rad/s]: three of the forward axis, then two of the turn.

    The common tilt moves the craft forward, the tilt difference turns the craft. Each axis thus has a single input, a
    unique gain and poles distinct within the axis.

    Raises:
        ValueError: A pole is unstable, repeated within an axis, without its conjugate, or uncontrollable.
    """
    from scipy.signal import place_poles

    A, B = design_model(p)
    check_controllable(A, B)
    numbers = [complex(pole) for pole in poles]
    if faults := pole_faults(numbers):
        raise ValueError(f"the poles cannot be placed: {'; '.join((reason for _, reason in faults))}")
    K = np.zeros((2, 5))
    for states, own, signs in zip((FORWARD, TURN), (numbers[:3], numbers[3:]), SIGNS, strict=True):
        axis = np.ix_(states, states)
        gain = place_poles(A[axis], B[list(states)] @ np.array(signs)[:, None], own).gain_matrix[0]
        K[:, states] = np.outer(signs, gain)
    return K


def check_controllable(A: Matrix, B: Matrix, names: Sequence[str] = STATES) -> None:
    """Check controllability by Hautus: rank [λI − A, B] = n.

    Raises:
        ValueError: A pole is uncontrollable; the message lists its states.
    """
    poles, vectors = np.linalg.eig(A.T)
    for pole, vector in zip(poles, vectors.T, strict=True):
        reach = np.hstack([pole * np.eye(len(A)) - A, B])
        scale = np.linalg.norm(reach, axis=1)[:, None]
        if np.linalg.matrix_rank(reach / np.where(scale > 0, scale, 1.0), tol=1e-9) < len(A):
            states = ", ".join(n for n, v in zip(names, vector, strict=True) if abs(v) > 1e-6)
            raise ValueError(
                f"no input moves the pole {format_pole(complex(pole))} rad/s, of {states}; correct the craft's "
                "parameters"
            )


def pole_faults(poles: Sequence[complex]) -> list[tuple[int, str]]:
    """Return index and fault of each invalid pole."""
    of_axes = ("forward", 0, poles[:3]), ("turning", 3, poles[3:])
    return [(first + k, reason) for axis, first, of in of_axes for k, reason in _faults(axis, of)]


def _faults(axis: str, poles: Sequence[complex]) -> Iterator[tuple[int, str]]:
    for k, a in enumerate(poles):
        pole = format_pole(a)
        if a.real >= 0.0:
            yield k, f"{pole} rad/s is not stable; the real part of a pole is below 0"
        elif a.real > -MIN_DECAY:
            yield (
                k,
                (
                    f"{pole} rad/s is too slow: what it moves takes {1.0 / -a.real:.0f} s to fall to 37 %, and "
                    f"nearer to 0 than {MIN_DECAY:g} rad/s it cannot be distinguished from one that grows; take "
                    f"-{MIN_DECAY:g} rad/s or further left"
                ),
            )
        if any(abs(a - b) <= ALIKE * abs(a) for b in poles[:k]):
            yield k, f"{pole} stands twice in the {axis} axis; one input places a pole once"
        if a.imag and not any(abs(a.conjugate() - b) <= ALIKE * abs(a) for b in poles):
            yield k, f"{pole} needs {format_pole(a.conjugate())} in the same axis"


def format_pole(pole: complex) -> str:
    """Return a pole as text."""
    return f"{pole.real:g}{pole.imag:+g}j" if pole.imag else f"{pole.real + 0.0:g}"
