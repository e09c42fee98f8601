"""Simulations of the logs at trial values: residuals, failures that cost one trial, and a time budget."""

from __future__ import annotations

import math
import time
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.calibration.vary import Parameter
from cosim.fmi.state import Memory, Own
from cosim.residuals.drive import Drive
from cosim.residuals.starts import StartParameter, first_start, sigma_of, start_parameters
from cosim.residuals.windows import free_run, self_started

SMALLEST = 1e-8  # least standard deviation of a residual, relative to the spread of its channel


class OutOfTime(Exception):
    """The time budget of a fit is spent."""


class SetDrive(Drive):
    """A drive that sets further values in every run; the FMU stays loaded in the drive it is made of."""

    def __init__(self, drive: Drive, values: Mapping[str, float]) -> None:
        self.__dict__.update(drive.__dict__)
        self._inner, self._values = drive, dict(values)
        self.given = {**drive.given, **values}

    def initial(self, start: Mapping[str, Any], row: int) -> dict[str, float]:
        """Return the initial outputs, as `Drive.initial`."""
        return self._inner.initial({**self._values, **start}, row)

    def own(self, start: Mapping[str, Any]) -> Own:
        """Return the initial state, as `Drive.own`."""
        return self._inner.own({**self._values, **start})

    def state(self) -> Own:
        """Return the final state, as `Drive.state`."""
        return self._inner.state()

    def run_and_keep(
        self, first: int, last: int, start: Mapping[str, Any], rows: Container[int]
    ) -> tuple[Array, dict[int, Own]]:
        """Run and return outputs and states, as `Drive.run_and_keep`."""
        return self._inner.run_and_keep(first, last, {**self._values, **start}, rows)

    def run(
        self, first: int, last: int, start: Mapping[str, Any], memory: Memory | None = None, visit: Any = None
    ) -> Array:
        """Run and return outputs, as `Drive.run`."""
        return self._inner.run(first, last, {**self._values, **start}, memory, visit)


@dataclass(frozen=True)
class Unknown:
    """One number to estimate: a parameter of all logs, or a start value of one log.

    Attributes:
        log: Index of the log of a start value; None for a parameter.
        hidden: True for a start value that no output shows, which was named.
    """

    parameter: Parameter
    log: int | None = None
    hidden: bool = False

    @property
    def name(self) -> str:
        """Return the name of the variable."""
        return self.parameter.name

    @property
    def is_shown(self) -> bool:
        """Return whether an output shows the start value."""
        return self.log is not None and not self.hidden


@dataclass
class Logs:
    """Logs with their drives, and everything that their simulations have in common.

    Attributes:
        starts: For each log, start parameters of its measured outputs by output.
        channels: Measured outputs of any log.
        spread: Channel → standard deviation of its measurements over all logs.
        horizon: Length of windows [s]; None for free runs.
        deadline: Clock time at which the budget is spent.
        count: Number of simulations of a whole log so far.
        failed: Number of rejected simulations, with values and reason of the first.
    """

    drives: Sequence[Drive]
    deadline: float = math.inf
    horizon: float | None = None
    count: int = 0
    failed: int = 0
    first_failure: tuple[dict[str, float], SimulationError] | None = None
    starts: list[dict[str, StartParameter]] = field(default_factory=list)

    def __post_init__(self) -> None:
        outputs = [d.log.outputs for d in self.drives]
        self.channels = tuple(dict.fromkeys(name for each in outputs for name in each))
        self.spread = {}
        for name in self.channels:
            values = np.concatenate([each[name] for each in outputs if name in each])
            size = float(np.nanstd(values)) or float(np.nanmax(np.abs(values)))
            self.spread[name] = size if size > 0.0 else 1.0
        self.all_starts = [start_parameters(drive) for drive in self.drives]
        self.starts = [
            {n: p for n, p in every.items() if n in drive.log.outputs and p.name not in drive.given}
            for drive, every in zip(self.drives, self.all_starts, strict=True)
        ]

    @property
    def noise(self) -> dict[str, float]:
        """Return channel → noise level of its sensor, the median over the logs."""
        return {
            name: float(np.median([sigma_of(d.log.outputs[name]) for d in self.drives if name in d.log.outputs]))
            for name in self.channels
        }

    def start_unknowns(self, values: Mapping[str, float], varied: Container[str]) -> list[tuple[Unknown, float]]:
        """Return the start values that outputs show, with a first estimate for each log."""
        unknowns = []
        for k, (drive, starts) in enumerate(zip(self.drives, self.starts, strict=True)):
            shown = {p.name: (output, p) for output, p in starts.items() if p.name not in varied}
            if not shown:
                continue
            first = first_start(SetDrive(drive, values), dict(shown.values()))
            units = drive.units
            for name, (output, p) in shown.items():
                start = first.get(name, p.tried[0])
                parameter = Parameter(name, units.get(output, ""), start, p.low, p.high, None, per_log=True)
                unknowns.append((Unknown(parameter, k), start))
        return unknowns

    def errors(self, k: int, values: Mapping[str, float]) -> Array | None:
        """Return measured − model of a log, shape (rows, channels), NaN without both; None if the FMU fails."""
        drive = self.drives[k]
        if time.monotonic() > self.deadline:
            raise OutOfTime
        self.count += 1
        try:
            outputs = self._outputs(k, values)
        except SimulationError as error:
            self.failed += 1
            self.first_failure = self.first_failure or (dict(values), error)
            return None
        nothing = np.full(drive.log.rows, np.nan)
        columns = [drive.log.outputs[n] - outputs[n] if n in drive.log.outputs else nothing for n in self.channels]
        return np.column_stack(columns)

    def _outputs(self, k: int, values: Mapping[str, float]) -> Mapping[str, Array]:
        """Return outputs of a free run or windows."""
        drive = self.drives[k]
        if self.horizon is None:
            table = drive.run(0, drive.log.rows - 1, values)
            return dict(zip(drive.outputs, table.T, strict=True))
        moved = SetDrive(drive, values)
        replay = self_started(moved, self.all_starts[k], free_run(moved), self.horizon)
        assert replay is not None, "windows were possible before"
        return replay.outputs


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all logs at one point.

    Attributes:
        tables: For each log (rows, channels), NaN without a value.
        counts, sigma: Number of values and standard deviation of each channel.
    """

    tables: tuple[Array, ...]
    counts: Array
    sigma: Array

    @classmethod
    def of(cls, tables: Sequence[Array], least: Array) -> Residuals:
        """Return residuals with their standard deviations, at least `least`."""
        counts = sum(np.isfinite(t).sum(axis=0) for t in tables)
        squares = sum(np.nansum(t * t, axis=0) for t in tables)
        sigma = np.sqrt(squares / np.maximum(counts, 1))
        return cls(tuple(tables), np.asarray(counts, float), np.maximum(sigma, least))

    @property
    def cost(self) -> float:
        """Return −log-likelihood with the noise levels concentrated out, up to a constant: Σ n·ln σ."""
        return float(self.counts @ np.log(self.sigma))
