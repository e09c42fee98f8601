"""Exact Jacobians of a model for any parameters, printed as Python."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from cosim.model.model import Model
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import Arrays


def printed_jacobians(model: Model, outputs: Sequence[str], effects: Collection[str] = ()) -> str:
    """Return a Python module with ∂f/∂x, ∂f/∂u and ∂h/∂x on arrays of points.

    The module defines PARAMETERS (names in the order of `p`), STATE, COMMAND and OUTPUT ((row, column) of each nonzero
    entry), and state_jacobian, command_jacobian and output_jacobian: (t, x, u, p, out) with entries written to the list
    `out`. Numbers are floats or arrays. Booleans keep the model's values.

    Args:
        effects: Effects of the catalogue to include, without states.
    """
    import sympy

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
        slopes = [
            (i, j, slope)
            for i, row in enumerate(rows)
            for j, variable in enumerate(columns)
            if (slope := sympy.diff(row, variable)) != 0
        ]
        lines.append(f"{name.upper()} = {tuple((i, j) for i, j, _ in slopes)!r}")
        lines += ["", "", body.function(Arrays(), f"{name}_jacobian", [slope for _, _, slope in slopes])]
    return "\n".join(lines)


def load_names(source: str) -> Mapping[str, Any]:
    """Return the names defined by a printed module."""
    names: dict[str, Any] = {}
    exec(compile(source, "<jacobians>", "exec"), names)
    return names
