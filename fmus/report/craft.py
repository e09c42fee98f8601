"""Analysis of the crafts in a run: estimators, references, responses, effort, saturation, errors of the estimate.

Component names are chosen by the user, so variables define the roles: a craft has `x_world`, `y_world` and `psi`,
an
estimator has `x_hat` and `x_sigma`. Connections assign the estimators to crafts. Figures use every row and SI
units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from controller.settings import Settings
from cosim.core.arrays import Array
from cosim.core.units import read_quantity
from cosim.report.panels import extent
from cosim.simulation import criteria
from cosim.simulation.report.recorded import Run, number

SIDES = ("right", "left")
COLOURS = {"right": "warm", "left": "cool"}
BAND = 0.02  # m and rad: 2 % of the unit steps in the thesis
MERGE = 0.1  # s; changes of a reference closer than this are one ramp
MAX_SETTLED_DISTANCE = 0.05  # m; a craft farther from its target has not settled
TILT_MAX = Settings().tilt_max  # [rad], default of the controller FMUs


@dataclass(frozen=True)
class Craft:
    """A craft with its estimator and controller; a signal that is not recorded is NaN."""

    run: Run
    name: str
    estimator: str | None

    def recorded(self, column: str | None) -> Array:
        """Return a column of the results."""
        line = self.run.signal(column or "")
        return np.full(self.run.time.size, math.nan) if line is None else line

    def signal(self, variable: str) -> Array:
        """Return a variable of the craft."""
        return self.recorded(f"{self.name}.{variable}")

    def estimate(self, variable: str) -> Array:
        """Return a variable of the estimator."""
        return self.recorded(self.estimator and f"{self.estimator}.{variable}")

    def reference_column(self, variable: str) -> str | None:
        """Return the reference column of `x` or `psi`.

        The column is the source of the controller's input, else the input.
        """
        own = f"{self.estimator}.{variable}_ref"
        columns = (self.run.source(own), own) if self.estimator else ()
        return next((column for column in columns if column is not None and column in self.run.results), None)

    def reference(self, variable: str) -> Array:
        """Return the reference of `x` or `psi`, recorded or constant."""
        if column := self.reference_column(variable):
            return self.run.results[column]
        return np.full(self.run.time.size, number(self.run.start(self.estimator).get(f"{variable}_ref")))

    def command(self, variable: str) -> Array:
        """Return a tilt command of the craft or controller."""
        here = self.signal(variable)
        return here if is_drawn(here) else self.estimate(variable)

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
        spans = [extent([self.command(f"tilt_{side}")]) for side in SIDES]
        if self.estimator is None or None in spans:
            return None
        return TILT_MAX if max(abs(end) for span in spans for end in span or ()) <= TILT_MAX * 1.001 else None


def is_drawn(*lines: Array) -> bool:
    """Return True if each line has a finite value."""
    return all(np.isfinite(line).any() for line in lines)


def find_crafts(run: Run) -> list[Craft]:
    """Return every craft with the estimator downstream of it."""
    names = [name for name, has in run.variables.items() if {"x_world", "y_world", "psi"} <= has]
    estimators = [name for name, has in run.variables.items() if {"x_hat", "x_sigma"} <= has]
    # A single craft and a single estimator belong together, even without connections in the manifest.
    alone = len(names) == len(estimators) == 1
    return [Craft(run, name, estimators[0] if alone else _downstream(run, name, estimators, names)) for name in names]


def _downstream(run: Run, start: str, names: Iterable[str], blocked: Iterable[str]) -> str | None:
    """Return the first of `names` downstream of `start`, without passing through `blocked` components."""
    edges = [(source.partition(".")[0], target.partition(".")[0]) for source, target in run.links]
    visited, front = {start, *blocked}, [start]
    while front:
        front = list(dict.fromkeys(target for source, target in edges if source in front and target not in visited))
        visited.update(front)
        for component in front:
            if component in names:
                return component
    return None


class Response(NamedTuple):
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
    rows = np.flatnonzero(np.abs(np.diff(reference)) > 1e-12) + 1
    apart = (np.diff(rows) > 1) & (np.diff(time[rows]) > MERGE)
    ramps = [ramp.tolist() for ramp in np.split(rows, np.flatnonzero(apart) + 1) if ramp.size]
    begins = [0, *(ramp[0] for ramp in ramps)]
    return list(zip(begins, [0, *(ramp[-1] for ramp in ramps)], [*begins[1:], reference.size], strict=True))


def responses(craft: Craft, variable: str) -> list[Response]:
    """Return the responses to each change of a reference."""
    good, signal, target = finite(craft.signal(variable), craft.reference(variable))
    if not good.any():
        return []
    time, estimate = craft.run.time[good], craft.estimate(f"{variable}_hat")[good]
    steps = reference_steps(time, target)
    # A start on target is a response only if the reference never changes.
    if len(steps) > 1 and abs(signal[0] - target[0]) <= BAND:
        steps = steps[1:]
    found = []
    for begin, arrived, end in steps:
        final, after = float(target[end - 1]), slice(arrived, end)
        moving = end - arrived < 2  # an unfinished ramp, or a change in the last row
        settling, believed = (
            criteria.settling_time(time[after], line[after], final, BAND) if is_drawn(line) and not moving else math.nan
            for line in (signal, estimate)
        )
        whole, wanted = signal[begin:end], target[begin:end]
        found.append(
            Response(
                variable,
                float(time[begin]),
                float(target[begin - 1] if begin else signal[0]),
                final,
                float(time[arrived] - time[begin]),
                settling,
                believed,
                criteria.overshoot(whole, final),
                criteria.rms_error(whole, wanted),
                criteria.final_error(whole, wanted),
            )
        )
    return found


def finite(*lines: Array) -> list[Array]:
    """Return the rows in which every line is finite, and the lines in these rows."""
    good = np.all(np.isfinite(lines), axis=0)
    return [good, *(line[good] for line in lines)]


def error_rms(signal: Array, target: Array) -> float:
    """Return the RMS error over finite rows, else NaN."""
    good, *lines = finite(signal, target)
    return criteria.rms_error(*lines) if good.any() else math.nan


def saturation(craft: Craft, side: str) -> float:
    """Return the share of time at the tilt limit; commands are constant between rows."""
    command, limit, time = craft.command(f"tilt_{side}"), craft.tilt_limit, craft.run.time
    if limit is None or time.size < 2 or not is_drawn(command):
        return math.nan
    steps = np.diff(time)
    at_limit = np.abs(command[:-1]) >= limit * (1 - 1e-6)
    return float(steps[at_limit].sum() / steps.sum())


def inside_band(craft: Craft, variable: str) -> float:
    """Return the share of rows in which the truth is within the estimator's ±2σ band."""
    names = (f"{variable}_hat", f"{variable}_sigma")
    good, true, estimate, sigma = finite(craft.signal(variable), *map(craft.estimate, names))
    # At the start P = 0 and the estimate is exact, so rounding must not count as outside.
    return float(np.mean(np.abs(estimate - true) <= 2 * sigma + 1e-9)) if good.any() else math.nan
