"""Jacobians of a model's equations, exact and for any parameters: differentiated as symbols, printed as Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from plant.model import Model
from plant.symbolic.functions import Body
from plant.symbolic.languages import Python


def printed_jacobians(model: Model, outputs: Sequence[str]) -> str:
    """Source of a Python module with ∂f/∂x of the base model, and ∂h/∂x of these outputs; it needs `math` alone.

    PARAMETERS: names, in the order in which `p` takes them; Booleans are as the model has them
    STATE, OUTPUT: (row, column) of each entry that is not zero everywhere
    state_jacobian, output_jacobian: (t, x, u, p, out) write these entries to `out`
    """
    import sympy

    body = Body.of(model, effects=False)
    functions = {
        "state": [body.derivative[q.name] for q in model.base_states],
        "output": [body.outputs[name] for name in outputs],
    }
    lines = [
        '"""Jacobians of a model, printed from its equations."""',
        "",
        "import math",
        "",
        f"PARAMETERS = {tuple(body.parameters)!r}",
    ]
    for name, rows in functions.items():
        slopes = [
            (i, j, slope)
            for i, row in enumerate(rows)
            for j, x in enumerate(body.symbols.state)
            if (slope := sympy.diff(row, x)) != 0
        ]
        lines.append(f"{name.upper()} = {tuple((i, j) for i, j, _ in slopes)!r}")
        lines += ["", "", body.function(Python(), f"{name}_jacobian", [slope for _, _, slope in slopes])]
    return "\n".join(lines)


def loaded(source: str) -> Mapping[str, Any]:
    """What a printed module defines, by name."""
    names: dict[str, Any] = {}
    exec(compile(source, "<jacobians>", "exec"), names)
    return names
