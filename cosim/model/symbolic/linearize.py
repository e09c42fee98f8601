"""Linear models and exact Jacobians by symbolic differentiation of the equations."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.model.model import Model, Values
from cosim.model.namespaces import SymbolNamespace
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import Arrays, Python
from cosim.model.symbolic.symbols import sympified

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LinearModel:
    """Linear model ẋ = A·x + B·u, y = C·x + D·u at an operating point; rows and columns in the order of the names."""

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class Linearizer:
    """Jacobians of a model's equations, differentiated and printed once: `linearizer(state, command, t)`."""

    def __init__(self, model: Model) -> None:
        import sympy

        self.model = model
        n, m = len(model.states), len(model.inputs)
        t = sympy.Symbol("t", real=True)
        x = sympy.symbols([f"x{k}" for k in range(n)], real=True)
        u = sympy.symbols([f"u{k}" for k in range(m)], real=True)
        derivative, output = model.acting(SymbolNamespace())
        at = t, tuple(x), tuple(u)
        rows = sympified((*derivative(*at), *output(*at)))
        slopes = _slopes(rows, (*x, *u))
        self._places = list(slopes)
        self._shape = len(rows), n + m
        places = {s: f"x[{k}]" for k, s in enumerate(x)} | {s: f"u[{k}]" for k, s in enumerate(u)}
        text = Python().function("jacobian", "t x u", list(slopes.values()), {**places, t: "t"})
        scope: dict[str, Any] = {"math": math}
        exec(text, scope)  # text from the code generator of this package
        self._jacobian = scope["jacobian"]

    def __call__(self, state: Values, command: Values, t: float = 0.0) -> LinearModel:
        """Return the linear model at a point.

        Raises:
            ArithmeticError, ValueError: A derivative is not finite.
        """
        values = [0.0] * len(self._places)
        self._jacobian(t, tuple(map(float, state)), tuple(map(float, command)), values)
        whole = np.zeros(self._shape)
        for place, value in zip(self._places, values, strict=True):
            whole[place] = value
        model, n = self.model, len(self.model.states)
        names = (tuple(q.name for q in group) for group in (model.states, model.inputs, model.outputs))
        return LinearModel(whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:], *names)


def linearize(model: Model, state: Values | None = None, command: Values | None = None, t: float = 0.0) -> LinearModel:
    """Return the linear model at a state and command, by default at the start values of the model."""
    point_x = model.start() if state is None else state
    point_u = model.start_command() if command is None else command
    return Linearizer(model)(point_x, point_u, t)


def printed_jacobians(model: Model, outputs: Sequence[str], effects: Collection[str] = ()) -> str:
    """Return the text of a Python module with ∂f/∂x, ∂f/∂u and ∂h/∂x on arrays of points.

    The module defines PARAMETERS (names in the order of `p`); STATE, COMMAND and OUTPUT, the (row, column) of each
    nonzero entry; and the functions state_jacobian, command_jacobian and output_jacobian of (t, x, u, p, out), which
    store these entries in the list `out`. Numbers are floats or arrays. Booleans have the values of the model.

    Args:
        effects: Effects of the catalogue to include, except effects with states.
    """
    body = Body.of(model, effects=effects)
    rates, symbols = [body.derivative[q.name] for q in model.base_states], body.symbols
    functions: dict[str, tuple[Sequence[Any], Sequence[Any]]] = {
        "state": (rates, symbols.state),
        "command": (rates, symbols.command),
        "output": ([body.outputs[name] for name in outputs], symbols.state),
    }
    lines = [
        '"""Jacobians of a model, printed from its equations."""',
        "",
        "import numpy as math",
        "",
        f"PARAMETERS = {tuple(body.parameters)!r}",
    ]
    for name, (rows, columns) in functions.items():
        slopes = _slopes(rows, columns)
        lines += [f"{name.upper()} = {tuple(slopes)!r}", "", ""]
        lines.append(body.function(Arrays(), f"{name}_jacobian", [*slopes.values()]))
    return "\n".join(lines)


def _slopes(rows: Sequence[Any], columns: Sequence[Any]) -> dict[tuple[int, int], Any]:
    """Return (row, column) → derivative of the row by the column, unless it is zero."""
    import sympy

    return {
        (i, k): slope
        for i, row in enumerate(rows)
        for k, symbol in enumerate(columns)
        if symbol in row.free_symbols and (slope := sympy.diff(row, symbol)) != 0
    }


def load_names(source: str) -> Mapping[str, Any]:
    """Return the names defined by a printed module."""
    names: dict[str, Any] = {}
    exec(compile(source, "<jacobians>", "exec"), names)
    return names
