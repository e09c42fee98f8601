"""`cosim fit` against scipy's local search on the same binaries and logs: held-out error and effort.

Each plant of own C has wrong parameters, two logs of its true ones with white noise, and a held-out log. Every method
runs the same library, starts from the same values or searches within the same bounds. scipy runs it by the driver of
replays. A simulation is one run over one log. The held-out error is that of a free run, relative to the
noise, as the geometric mean over the outputs; 1 is the noise itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import cosim
from cosim.logs.log import Log
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import PLANTS, build
from tests.logs import write_log

FACTOR = 3.0  # bounds of each parameter about its first value, up and down
SHARE = 0.01  # noise relative to the spread of an output


@dataclass(frozen=True)
class Case:
    """A plant with its true parameters, and its experiment.

    Attributes:
        wrong: Parameter → first value relative to the true one.
        reach: Largest distance of each input from its start value.
        hold: Time for which a level of an input is held [s].
    """

    plant: str
    wrong: Mapping[str, float]
    reach: Mapping[str, float]
    step: float
    rows: int
    hold: float


PUMPS = ("pump_left", "pump_right")
CASES = (
    Case("dc_motor", {"resistance": 1.4, "inertia": 0.6, "damping": 2.0}, {"voltage": 6.0}, 0.02, 400, 0.6),
    Case("tanks", {"pipe.k": 0.6, "outlet.k": 1.5, "gain_left": 0.8}, dict.fromkeys(PUMPS, 3.0), 2.0, 400, 60.0),
    Case("heated_box", {"C_heater": 1.7, "C_air": 0.6, "G_wall": 1.5}, {"heater": 0.9}, 2.0, 400, 80.0),
    Case("drive", {"load.J": 0.6, "shaft.c": 1.3, "motor.b": 2.0}, {"torque": 1.0}, 0.01, 400, 0.3),
)  # fmt: skip


@dataclass(frozen=True)
class Answer:
    """Estimates of a method, its number of simulations and its time [s]."""

    values: Mapping[str, float]
    runs: int
    seconds: float


class Bench:
    """A case in a folder: the FMU, its logs, and free runs."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case, self.folder = case, folder
        self.fmu = build(folder / f"{case.plant}.fmu", case.plant, ways=("co_simulation",))
        declared = {v.name: v.start for v in PLANTS[case.plant].parameters}
        self.truth = {name: declared[name] for name in case.wrong}
        self.first = {name: self.truth[name] * factor for name, factor in case.wrong.items()}
        self.sigma: dict[str, float] = {}
        self.logs = [self._record(k) for k in range(2)]
        self.held_out = self._record(2)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the bounds of each parameter."""
        return {name: (value / FACTOR, value * FACTOR) for name, value in self.first.items()}

    def _record(self, number: int) -> Path:
        """Write a log of the true plant with noise, and return its path."""
        case, rng = self.case, np.random.default_rng([7, number])
        time_ = case.step * np.arange(case.rows)
        blocks = (time_ // case.hold).astype(int)
        columns: dict[str, Any] = {"time": time_}
        for v in PLANTS[case.plant].inputs:
            levels = rng.uniform(-1.0, 1.0, blocks[-1] + 1)
            if v.name == "heater":
                levels = np.abs(levels)
            columns[v.name] = v.start + case.reach.get(v.name, 0.0) * levels[blocks]
        empty = {n: np.zeros(case.rows) for n in PLANTS[case.plant].output_names}
        path = write_log(self.folder / f"{case.plant}{number}.csv", {**columns, **empty})
        with self.drive(path) as drive:
            outputs = dict(zip(drive.outputs, drive.run(0, case.rows - 1, self.truth).T, strict=True))
        self.sigma = self.sigma or {n: SHARE * float(np.std(outputs[n])) for n in empty}
        noisy = {n: outputs[n] + self.sigma[n] * rng.standard_normal(case.rows) for n in empty}
        return write_log(path, {**columns, **noisy})

    @contextmanager
    def drive(self, path: Path) -> Iterator[Drive]:
        """Yield the FMU with the inputs of a log."""
        with Drive(log_of_fmu(path, self.fmu), self.fmu) as drive:
            yield drive

    def error(self, values: Mapping[str, float]) -> float:
        """Return the error of a free run on the held-out log, relative to the noise."""
        with self.drive(self.held_out) as drive:
            errors = residuals(drive, values)
        return float(np.exp(np.mean([math.log(np.sqrt(np.mean(e**2)) / self.sigma[n]) for n, e in errors.items()])))


def residuals(drive: Drive, values: Mapping[str, float]) -> dict[str, Any]:
    """Return measured − model of each output in a free run."""
    log: Log = drive.log
    table = drive.run(0, log.rows - 1, values)
    return {n: log.outputs[n] - y for n, y in zip(drive.outputs, table.T, strict=True) if n in log.outputs}


# -- methods ------------------------------------------------------------------------------------------


def by_cosim(bench: Bench) -> Answer:
    """Return the answer of `cosim fit`."""
    begin = time.monotonic()
    fitted = cosim.fit(bench.logs, bench.fmu, vary=bench.bounds, start=bench.first, report=False, in_process=True)
    return Answer(fitted.values, fitted.record["simulations"], time.monotonic() - begin)


def by_scipy(bench: Bench) -> Answer:
    """Return the answer of scipy's least squares with its defaults; outputs are weighted by their spread."""
    begin, runs = time.monotonic(), 0
    names = [*bench.first]
    with bench.drive(bench.logs[0]) as one, bench.drive(bench.logs[1]) as two:
        spread = {n: float(np.std(v)) for n, v in one.log.outputs.items()}

        def miss(x: Any) -> Any:
            nonlocal runs
            runs += 2
            values = dict(zip(names, x.tolist(), strict=True))
            return np.concatenate([e / spread[n] for drive in (one, two) for n, e in residuals(drive, values).items()])

        first, ends = np.array([*bench.first.values()]), np.array([*bench.bounds.values()])
        found = least_squares(miss, first, bounds=(ends[:, 0], ends[:, 1]), x_scale=first)
    return Answer(dict(zip(names, found.x.tolist(), strict=True)), runs, time.monotonic() - begin)
