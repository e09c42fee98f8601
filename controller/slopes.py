"""Jacobians of the craft's equations at given states and commands, computed by functions printed at build time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from controller.design_model import Matrix
from plant.hovercraft import Hovercraft


class Slopes:
    """Jacobians ∂f/∂x (`state`), ∂f/∂u (`command`) and ∂h/∂x (`output`) of a craft.

    Args:
        printed: Loaded module of `cosim.model.symbolic.jacobian.printed_jacobians` for the craft.
    """

    def __init__(self, craft: Hovercraft, printed: Mapping[str, Any]) -> None:
        self.printed = printed
        self.numbers = [_value(craft, name) for name in printed["PARAMETERS"]]

    def along(self, name: str, states: Matrix, commands: Matrix, shape: tuple[int, int]) -> Matrix:
        """Return a Jacobian (points, *shape) at states (points, 14) and commands (points, 4)."""
        places, function = self.printed[name.upper()], self.printed[f"{name}_jacobian"]
        entries: list[Any] = [0.0] * len(places)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # both sides of branches are computed
            function(0.0, tuple(states.T), tuple(commands.T), self.numbers, entries)
        matrices = np.zeros((len(states), *shape))
        for (row, column), entry in zip(places, entries, strict=True):
            matrices[:, row, column] = entry
        return matrices

    def at(self, name: str, state: Matrix, command: Sequence[float], shape: tuple[int, int]) -> Matrix:
        """Return a Jacobian at one point."""
        matrix: Matrix = self.along(name, state[None], np.array([command]), shape)[0]
        return matrix


def _value(craft: Hovercraft, name: str) -> float:
    """Return a parameter by its full name, the default for a missing effect."""
    owner, _, own = name.rpartition(".")
    owners = {"": craft} | {e.name: e for e in craft.effects}
    return float(getattr(owners[owner], own) if owner in owners else craft.declared[name].default)
