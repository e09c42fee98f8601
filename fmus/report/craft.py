"""Crafts of a run: estimators, references, responses, effort, saturation, estimate against truth.

Component names are the user's, so variables define the roles: a craft has `x_world`, `y_world` and `psi`, an estimator
has `x_hat` and `x_sigma`. Connections assign the estimators to crafts. Figures use every row and SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from controller.settings import Settings
from cosim.core.arrays import Array
from cosim.core.units import read_quantity
from cosim.simulation import criteria
from cosim.simulation.report.recorded import Run, number

SIDES = ("right", "left")
COLOURS = {"right": "warm", "left": "cool"}
BAND = 0.02  # m and rad: 2 % of the thesis' unit steps
MERGE = 0.1  # s; changes of a reference closer than this are one ramp
MAX_SETTLED_DISTANCE = 0.05  # m; a craft farther from its target has not settled
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


@dataclass(frozen=True)
class Response:
    """Response of a signal to one change of its reference, in SI units."""

    variable: str
    time: float
    start: float
    target: float
    ramp: float
    settling: float
    believed: float
    overshoot: float
    rms: float
    final: float


def reference_steps(time: Array, reference: Array) -> list[tuple[int, int, int]]:
    """Return the rows of begin, arrival and end of each change of a reference.

    Row 0 counts as a change. Changes within MERGE form one ramp; a change ends at the next one.
    """
    changes = [0, *(int(k) for k in np.flatnonzero(np.abs(np.diff(reference)) > 1e-12) + 1)]
    groups: list[list[int]] = [[0, 0]]
    for previous, row in pairwise(changes):
        near = row - previous <= 1 or time[row] - time[previous] <= MERGE
        if near and previous > 0:
            groups[-1][1] = row
        else:
            groups.append([row, row])
    ends = [group[0] for group in groups[1:]] + [reference.size]
    return [(begin, arrived, end) for (begin, arrived), end in zip(groups, ends, strict=True)]


def responses(craft: Craft, variable: str) -> list[Response]:
    """Return the responses to each change of a reference."""
    (good, signal, target), estimate = finite(craft.signal(variable), craft.reference(variable)), None
    if not good.any():
        return []
    time, line = craft.run.time[good], craft.estimate(f"{variable}_hat")
    if line is not None:
        estimate = line[good]
    steps = reference_steps(time, target)
    # A start on target is a response only if the reference never changes.
    if len(steps) > 1 and abs(signal[0] - target[0]) <= BAND:
        steps = steps[1:]
    found = []
    for begin, arrived, end in steps:
        final, after = float(target[end - 1]), slice(arrived, end)
        moving = end - arrived < 2  # an unfinished ramp, or a change in the last row
        settling, believed = (
            math.nan if line is None or moving else criteria.settling_time(time[after], line[after], final, BAND)
            for line in (signal, estimate)
        )
        whole = signal[begin:end], target[begin:end]
        found.append(
            Response(
                variable,
                float(time[begin]),
                float(target[begin - 1]) if begin else float(signal[0]),
                final,
                float(time[arrived] - time[begin]),
                settling,
                believed,
                criteria.overshoot(whole[0], final),
                criteria.rms_error(*whole),
                criteria.final_error(*whole),
            )
        )
    return found


def finite(*lines: Array | None) -> list[Array]:
    """Return the rows in which every line is finite, none if one is missing, and the lines in these rows."""
    present = [line for line in lines if line is not None]
    if len(present) < len(lines):
        return [np.zeros(len(present[0]) if present else 0, dtype=bool), *(np.zeros(0) for _ in lines)]
    good = np.all(np.isfinite(present), axis=0)
    return [good, *(line[good] for line in present)]


def error_rms(signal: Array | None, target: Array | None) -> float:
    """Return the RMS error over finite rows, else NaN."""
    good, *lines = finite(signal, target)
    return criteria.rms_error(*lines) if good.any() else math.nan


def saturation(craft: Craft, side: str) -> float:
    """Return the share of time at the tilt limit.

    Each command is held until the next.
    """
    command, limit, time = craft.command(f"tilt_{side}"), craft.tilt_limit, craft.run.time
    if command is None or limit is None or time.size < 2:
        return math.nan
    steps = np.diff(time)
    at_limit = np.abs(command[:-1]) >= limit * (1 - 1e-6)
    return float(steps[at_limit].sum() / steps.sum())


def inside_band(craft: Craft, variable: str) -> float:
    """Return the share of rows with the truth within the estimator's ±2σ."""
    names = (f"{variable}_hat", f"{variable}_sigma")
    good, true, estimate, sigma = finite(craft.signal(variable), *map(craft.estimate, names))
    # At the start P = 0 and the estimate is exact: rounding must not count as outside.
    return float(np.mean(np.abs(estimate - true) <= 2 * sigma + 1e-9)) if good.any() else math.nan
