"""Linear model of the smooth part: the one body evaluated with symbols, differentiated, and put at a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.model import Model, Values
from plant.namespaces import SymbolNamespace

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LinearModel:
    """ẋ = A·x + B·u, y = C·x + D·u about an operating point; names give the order of rows and columns."""

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def linearize(model: Model, state: Values | None = None, command: Values | None = None, t: float = 0.0) -> LinearModel:
    """Jacobians of the equations at a state and command (default: the start of the model, which hovers)."""
    import sympy

    point_x = model.start() if state is None else state
    point_u = model.start_command() if command is None else command
    x = sympy.symbols([f"x{k}" for k in range(len(point_x))], real=True)
    u = sympy.symbols([f"u{k}" for k in range(len(point_u))], real=True)
    equations = model.acting(SymbolNamespace())
    point = dict(zip((*x, *u), (*point_x, *point_u), strict=True))

    def jacobian(expressions: Values, symbols: list[sympy.Symbol]) -> Matrix:
        matrix = sympy.Matrix(expressions).jacobian(symbols).subs(point)
        return np.array(matrix.tolist(), dtype=float)

    f = equations.derivative(t, tuple(x), tuple(u))
    g = equations.output(t, tuple(x), tuple(u))
    return LinearModel(
        jacobian(f, x),
        jacobian(f, u),
        jacobian(g, x),
        jacobian(g, u),
        tuple(q.name for q in model.states),
        tuple(q.name for q in model.inputs),
        tuple(q.name for q in model.outputs),
    )
