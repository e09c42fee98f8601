"""Who is who in a run: which component is the craft, which its estimator, what they were told to follow.

Component names are the user's, so roles are found by structure: a craft has `x_world`, `y_world` and `psi`,
an estimator has `x_hat` and `x_sigma`; the connections say which of them belong together.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.results import Results
from cosim.start_values import QUANTITY

Signal = NDArray[np.float64]

SIDES = ("right", "left")
TILT_MAX = 0.20944  # rad, what a controller FMU uses unless told otherwise

# For results read back from a file, which carry no units.
USUAL_UNITS = {
    **dict.fromkeys(("x", "y", "x_world", "y_world", "x_hat", "x_sigma", "x_ref"), "m"),
    **dict.fromkeys(("vx", "vy", "vx_hat"), "m/s"),
    **dict.fromkeys(("psi", "phi", "psi_hat", "psi_sigma", "psi_ref", "tilt_right", "tilt_left"), "rad"),
    **dict.fromkeys(("tilt_right_actual", "tilt_left_actual"), "rad"),
    **dict.fromkeys(("psi_dot", "phi_dot", "psi_dot_hat"), "rad/s"),
    **dict.fromkeys(("thrust_right", "thrust_left"), "N"),
    **dict.fromkeys(("duty_right", "duty_left"), "%"),
    **dict.fromkeys(("ax", "a_hat"), "m/s2"),
}


def mapping(value: Any) -> Mapping[str, Any]:
    """`value` if it is a mapping, else an empty one: a manifest may lack anything."""
    return value if isinstance(value, Mapping) else {}


def mappings(value: Any) -> list[Mapping[str, Any]]:
    """The mappings in a list that may be missing or hold other things."""
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list | tuple) else []


def texts(value: Any) -> list[str]:
    """The items of a list as text; one text stands for itself."""
    return (
        [value] if isinstance(value, str) else [str(item) for item in value] if isinstance(value, list | tuple) else []
    )


def number(value: Any, default: float = float("nan")) -> float:
    """`value` as a float, or `default` where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return default


def angle(value: Any) -> float:
    """An angle [rad], given as a number or as text such as `12 deg`; NaN where it is neither."""
    if match := QUANTITY.fullmatch(str(value)):
        return number(match[1]) * {"rad": 1.0, "deg": math.pi / 180}.get(match[2], math.nan)
    return number(value)


@dataclass(frozen=True)
class Run:
    """Results and manifest of one run, with names looked up tolerantly."""

    results: Results
    manifest: Mapping[str, Any]

    @property
    def time(self) -> Signal:
        """Communication points [s]."""
        return self.results.time

    @property
    def scenario(self) -> Mapping[str, Any]:
        """The scenario as the manifest keeps it."""
        return mapping(self.manifest.get("scenario"))

    @property
    def algorithm(self) -> str:
        """Order of the exchange; a scenario that does not say has the first."""
        return str(self.scenario.get("algorithm") or ("gauss-seidel" if self.links else ""))

    @cached_property
    def variables(self) -> dict[str, set[str]]:
        """Component → its variables, in the order of the columns."""
        found: dict[str, set[str]] = {}
        for column in self.results.columns:
            component, _, variable = column.partition(".")
            found.setdefault(component, set()).add(variable)
        return found

    @cached_property
    def links(self) -> list[tuple[str, str]]:
        """Connections as pairs of `component.variable`."""
        pairs = ((link.get("from"), link.get("to")) for link in mappings(self.scenario.get("connections")))
        return [(source, target) for source, target in pairs if isinstance(source, str) and isinstance(target, str)]

    def signal(self, column: str) -> Signal | None:
        """A column of the results, None where it was not recorded."""
        if column not in self.results:
            return None
        return self.results[column]

    def unit(self, column: str) -> str:
        """Unit of a column, by its usual name where the results carry none."""
        unit = self.results.units.get(column)
        return USUAL_UNITS.get(column.partition(".")[2], "") if unit is None else unit

    def start(self, component: str | None) -> Mapping[str, Any]:
        """Start values the scenario gave a component."""
        if component is None:
            return {}
        return mapping(mapping(mapping(self.scenario.get("components")).get(component)).get("start"))

    def source(self, target: str) -> str | None:
        """What is connected to the input `target`."""
        return next((source for source, end in self.links if end == target), None)


@dataclass(frozen=True)
class Craft:
    """A craft, and what estimates and steers it."""

    run: Run
    name: str
    estimator: str | None

    def signal(self, variable: str) -> Signal | None:
        """A variable of the craft."""
        return self.run.signal(f"{self.name}.{variable}")

    def tilt(self, side: str) -> Signal | None:
        """The tilt of a propeller as it followed its command [rad]."""
        return self.signal(f"tilt_{side}_actual")

    def estimate(self, variable: str) -> Signal | None:
        """A variable of its estimator."""
        return self.run.signal(f"{self.estimator}.{variable}") if self.estimator else None

    def reference_column(self, variable: str) -> str | None:
        """The column that `x` or `psi` had to follow: what is connected to the controller's input, else the input."""
        if self.estimator is None:
            return None
        wanted = f"{self.estimator}.{variable}_ref"
        columns = (self.run.source(wanted), wanted)
        return next((column for column in columns if column is not None and column in self.run.results), None)

    def reference(self, variable: str) -> Signal | None:
        """What `x` or `psi` had to follow: a recorded signal, else a constant start value."""
        column = self.reference_column(variable)
        if column is not None:
            return self.run.results[column]
        told = number(self.run.start(self.estimator).get(f"{variable}_ref"))
        return np.full(self.run.time.size, told) if np.isfinite(told) else None

    def command(self, variable: str) -> Signal | None:
        """A tilt command: at the craft's own input, else as the controller gave it."""
        here = self.signal(variable)
        return self.estimate(variable) if here is None else here

    @property
    def tilt_limit(self) -> float | None:
        """Largest tilt command [rad]; the usual one only where no command exceeds it."""
        told = angle(self.run.start(self.estimator).get("tilt_max"))
        if np.isfinite(told) and told > 0:
            return told
        commands = [self.command(f"tilt_{side}") for side in SIDES]
        if self.estimator is None or any(c is None for c in commands):
            return None
        largest = max(float(np.max(np.abs(c), initial=0.0, where=np.isfinite(c))) for c in commands if c is not None)
        return TILT_MAX if largest <= TILT_MAX * 1.001 else None


def find_crafts(run: Run) -> list[Craft]:
    """Every craft of the run with the estimator its signals reach."""
    names = [name for name, has in run.variables.items() if {"x_world", "y_world", "psi"} <= has]
    estimators = [name for name, has in run.variables.items() if {"x_hat", "x_sigma"} <= has]
    # One of each belongs together whatever the manifest still knows of the connections.
    alone = len(names) == len(estimators) == 1
    return [Craft(run, name, estimators[0] if alone else _reached(run, name, estimators, names)) for name in names]


def _reached(run: Run, start: str, wanted: Iterable[str], blocked: Iterable[str]) -> str | None:
    """The first of `wanted` downstream of `start`, by connections that do not lead through a `blocked` component."""
    edges = [(source.partition(".")[0], target.partition(".")[0]) for source, target in run.links]
    seen, front = {start, *blocked}, [start]
    while front:
        front = list(dict.fromkeys(target for source, target in edges if source in front and target not in seen))
        seen.update(front)
        for component in front:
            if component in wanted:
                return component
    return None
