"""Offline design: the LQR gain from weights, by `control`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from controller.design_model import Matrix, ModelNumbers, design_model
from controller.gains import Settings

Q_THESIS = (1.0, 0.5, 0.1, 0.01, 0.0)  # diagonal, eq 6.4
R_THESIS = (1.0, 1.0)
STABLE = 1e-6  # [rad/s] how far left of the imaginary axis a pole must lie


def lqr_gain(p: ModelNumbers, Q: Sequence[float] = Q_THESIS, R: Sequence[float] = R_THESIS) -> Matrix:
    """K (2, 5) that minimises ∫ x'Qx + u'Ru for the design model, eqs 6.1-6.3; Q and R are diagonals.

    Raises ValueError where no stabilising gain exists or the weights are not of a regulator.
    """
    if len(Q) != 5 or len(R) != 2 or min(Q) < 0 or min(R) <= 0:
        raise ValueError("Q has five diagonal entries ≥ 0 and R two > 0")
    import control  # 1 s to import: only where a gain is designed

    A, B = design_model(p)
    try:
        K, _, poles = control.lqr(A, B, np.diag(Q), np.diag(R))
    except np.linalg.LinAlgError as error:
        raise ValueError(f"no stabilising gain for these weights: {error}") from error
    # an integrator without weight is left to itself, and the solver does not mind
    if max(np.real(poles)) > -STABLE:
        raise ValueError(f"no stabilising gain for these weights: a pole stays at {max(np.real(poles)):.2g} rad/s")
    return np.asarray(K, dtype=float)


def with_gain(settings: Settings, K: Matrix) -> Settings:
    """Settings with the gain put in."""
    entries: dict[str, Any] = {f"k_{i + 1}_{j + 1}": float(K[i, j]) for i in range(2) for j in range(5)}
    return replace(settings, **entries)
