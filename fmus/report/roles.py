"""Roles of components in a run: crafts, their estimators and their references.

Component names are the user's, so variables define the roles: a craft has `x_world`, `y_world` and `psi`, an estimator
has `x_hat` and `x_sigma`. Connections assign the estimators to crafts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from controller.settings import Settings
from cosim.core.arrays import Array
from cosim.core.units import read_quantity
from cosim.simulation.report.recorded import Run, number

SIDES = ("right", "left")
COLOURS = {"right": "warm", "left": "cool"}
TILT_MAX = Settings().tilt_max  # [rad], default of the controller FMUs


@dataclass(frozen=True)
class Craft:
    """A craft with its estimator and controller."""

    run: Run
    name: str
    estimator: str | None

    def signal(self, variable: str) -> Array | None:
        """Return a variable of the craft."""
        return self.run.signal(f"{self.name}.{variable}")

    def estimate(self, variable: str) -> Array | None:
        """Return a variable of the estimator."""
        return self.run.signal(f"{self.estimator}.{variable}") if self.estimator else None

    def reference_column(self, variable: str) -> str | None:
        """Return the reference column of `x` or `psi`.

        The column is the source of the controller's input, else the input.
        """
        if self.estimator is None:
            return None
        own = f"{self.estimator}.{variable}_ref"
        columns = (self.run.source(own), own)
        return next((column for column in columns if column is not None and column in self.run.results), None)

    def reference(self, variable: str) -> Array | None:
        """Return the reference of `x` or `psi`, recorded or constant."""
        column = self.reference_column(variable)
        if column is not None:
            return self.run.results[column]
        value = number(self.run.start(self.estimator).get(f"{variable}_ref"))
        return np.full(self.run.time.size, value) if np.isfinite(value) else None

    def command(self, variable: str) -> Array | None:
        """Return a tilt command of the craft or controller."""
        here = self.signal(variable)
        return self.estimate(variable) if here is None else here

    @property
    def tilt_limit(self) -> float | None:
        """Return the limit of the tilt commands [rad].

        Without a start value, the default applies if no command exceeds it.
        """
        given = self.run.start(self.estimator).get("tilt_max")
        try:
            limit = read_quantity(given, "rad") if isinstance(given, str) else number(given)  # such as `12 deg`
        except ValueError:
            limit = math.nan
        if np.isfinite(limit) and limit > 0:
            return limit
        commands = [self.command(f"tilt_{side}") for side in SIDES]
        if self.estimator is None or any(c is None for c in commands):
            return None
        largest = max(float(np.max(np.abs(c), initial=0.0, where=np.isfinite(c))) for c in commands if c is not None)
        return TILT_MAX if largest <= TILT_MAX * 1.001 else None


def find_crafts(run: Run) -> list[Craft]:
    """Return every craft with the estimator downstream of it."""
    names = [name for name, has in run.variables.items() if {"x_world", "y_world", "psi"} <= has]
    estimators = [name for name, has in run.variables.items() if {"x_hat", "x_sigma"} <= has]
    # A single craft and a single estimator belong together, even without connections in the manifest.
    alone = len(names) == len(estimators) == 1
    return [Craft(run, name, estimators[0] if alone else _downstream(run, name, estimators, names)) for name in names]


def _downstream(run: Run, start: str, names: Iterable[str], blocked: Iterable[str]) -> str | None:
    """Return the first of `names` downstream of `start`, without a path through `blocked` ones."""
    edges = [(source.partition(".")[0], target.partition(".")[0]) for source, target in run.links]
    visited, front = {start, *blocked}, [start]
    while front:
        front = list(dict.fromkeys(target for source, target in edges if source in front and target not in visited))
        visited.update(front)
        for component in front:
            if component in names:
                return component
    return None
