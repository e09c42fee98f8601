"""Simulations of the logs at trial values: residuals, failures that cost one trial, and a time budget."""

from __future__ import annotations

import math
import time
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.calibration.vary import Parameter
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.residuals.drive import Drive
from cosim.residuals.starts import first_start, sigma_of, start_parameters
from cosim.residuals.windows import free_run, self_started


class OutOfTime(Exception):
    """The time budget of a fit is spent."""


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


class Logs:
    """Logs with their drives, and everything that their simulations have in common.

    Attributes:
        deadline: Clock time at which the budget is spent.
        all_starts: For each log, start parameters by output; `starts` has those of measured outputs.
        channels: Measured outputs of any log.
        spread: Channel → standard deviation of its measurements over all logs.
        noise: Channel → noise level of its sensor, the median over the logs.
        horizon: Length of windows [s]; None for free runs.
        count: Number of simulations of a whole log so far.
        failed: Number of rejected simulations, with values and reason of the first.
    """

    def __init__(self, drives: Sequence[Drive], deadline: float = math.inf) -> None:
        self.drives, self.deadline = drives, deadline
        self.horizon: float | None = None
        self.count = self.failed = 0
        self.first_failure: tuple[dict[str, float], SimulationError] | None = None
        outputs = [d.log.outputs for d in drives]
        self.channels = tuple(dict.fromkeys(name for each in outputs for name in each))
        self.spread, self.noise = dict[str, float](), dict[str, float]()
        for name in self.channels:
            parts = [each[name] for each in outputs if name in each]
            values = np.concatenate(parts)
            size = float(np.nanstd(values)) or float(np.nanmax(np.abs(values)))
            self.spread[name] = size if size > 0.0 else 1.0
            self.noise[name] = float(np.median([sigma_of(part) for part in parts]))
        self.all_starts = [start_parameters(drive) for drive in drives]
        self.starts = [
            {n: p for n, p in every.items() if n in drive.log.outputs and p.name not in drive.given}
            for drive, every in zip(drives, self.all_starts, strict=True)
        ]

    def start_unknowns(self, values: Mapping[str, float], varied: Container[str]) -> list[tuple[Unknown, float]]:
        """Return the start values that outputs show, with a first estimate for each log."""
        unknowns = []
        for k, (drive, starts) in enumerate(zip(self.drives, self.starts, strict=True)):
            shown = {p.name: (output, p) for output, p in starts.items() if p.name not in varied}
            if not shown:
                continue
            first = first_start(drive.with_values(values), dict(shown.values()))
            units = drive.units
            for name, (output, p) in shown.items():
                start = first.get(name, p.tried[0])
                parameter = Parameter(name, units.get(output, ""), start, p.low, p.high, None, per_log=True)
                unknowns.append((Unknown(parameter, k), start))
        return unknowns

    def errors(self, k: int, values: Mapping[str, float]) -> Array | None:
        """Return measured − model of a log, shape (rows, channels), NaN without both; None if the FMU fails."""
        log = self.drives[k].log
        if time.monotonic() > self.deadline:
            raise OutOfTime
        try:
            outputs = self.outputs(k, values, self.horizon)
        except SimulationError as error:
            self.failed += 1
            self.first_failure = self.first_failure or (dict(values), error)
            return None
        nothing = np.full(log.rows, np.nan)
        return np.column_stack([log.outputs[n] - outputs[n] if n in log.outputs else nothing for n in self.channels])

    def outputs(self, k: int, values: Mapping[str, float], horizon: float | None) -> Mapping[str, Array]:
        """Return the outputs of a free run of a log, or of its windows; nothing where it has no windows."""
        self.count += 1
        drive = self.drives[k].with_values(values)
        if horizon is None:
            return dict(zip(drive.outputs, drive.run(0, drive.log.rows - 1, {}).T, strict=True))
        replay = self_started(drive, self.all_starts[k], free_run(drive), horizon)
        return {} if replay is None else replay.outputs
