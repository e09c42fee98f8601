"""Jacobians of a model's equations, exact and for any parameters: differentiated as symbols, printed as Python."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from cosim.model.model import Model
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import Arrays


def printed_jacobians(model: Model, outputs: Sequence[str], effects: Collection[str] = ()) -> str:
    """Print a Python module with ∂f/∂x and ∂f/∂u of the base model, and ∂h/∂x of these outputs, on arrays of points.

    effects: of the catalogue, which the equations have besides; none of them with states
    PARAMETERS: names, in the order in which `p` takes them; Booleans are as the model has them
    STATE, COMMAND, OUTPUT: (row, column) of each entry that is not zero everywhere
    state_jacobian, command_jacobian, output_jacobian: (t, x, u, p, out) write these entries to the list `out`; numbers
        are floats or arrays
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


def loaded(source: str) -> Mapping[str, Any]:
    """What a printed module defines, by name."""
    names: dict[str, Any] = {}
    exec(compile(source, "<jacobians>", "exec"), names)
    return names
