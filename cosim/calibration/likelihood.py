"""Output-error maximum likelihood for simulations that are expensive and not smooth.

The noise levels are eliminated analytically: −ln L = Σ_c n_c·ln σ_c + ½ Σ ((p − p₀)/σ_p)², σ_c² = Σ e_c²/n_c. The
gradient equals that of least squares with the weights 1/σ_c². Derivatives are finite differences. If the FMU fails,
only one trial is lost.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from types import MappingProxyType

import numpy as np

from cosim.calibration.fit_study import Parameter
from cosim.core.arrays import Array, Flags, NamedValues, Rows
from cosim.core.errors import SimulationError
from cosim.residuals.drive import Drive, as_columns
from cosim.residuals.windows import first_start, free_run, self_started, sigma_of, start_parameters

MIN_NOISE_RATIO = 1e-8  # minimum standard deviation of a residual, relative to that of its channel
UNKNOWN_STEP = 1e-2  # step of differences, relative to the scale of an unknown, above the rounding of solvers
MAX_EVALUATIONS = 40
# gain of a step in log-likelihood, corresponding to one standard error, after which the next step is negligible
SETTLED_GAIN = 0.5
MIN_RELATIVE_STEP = 1e-4  # step size without expected gain, relative to the size of the unknowns
ALL_ROWS = slice(None)
Jacobian = list[Array]  # per log: array (rows, channels, unknowns); NaN where the residual is NaN


class OutOfTime(Exception):
    """The time budget of a fit is spent."""


class Logs:
    """Logs with drives that simulate the FMU along them, and data common to all simulations.

    Attributes:
        deadline: Clock time at which the time budget is spent.
        starts: Output → start parameter, for each log.
        channels: Outputs measured in any log.
        spread: Standard deviation of the measurements of each channel over all logs.
        noise: Noise level of the sensor of each channel, the median over the logs.
        horizon: Length of windows [s]; None for free runs.
        count: Number of simulations of a whole log so far.
        failed: Number of failed simulations, with values and reason of the first one.
    """

    def __init__(self, drives: Sequence[Drive], deadline: float = math.inf) -> None:
        self.drives, self.deadline = drives, deadline
        self.horizon: float | None = None
        self.count = self.failed = 0
        self.first_failure: tuple[dict[str, float], SimulationError] | None = None
        self.channels = tuple(dict.fromkeys(name for d in drives for name in d.log.outputs))
        readings = [[d.log.outputs[name] for d in drives if name in d.log.outputs] for name in self.channels]
        every = [*map(np.concatenate, readings)]
        self.spread = np.array([np.nanstd(values) or np.nanmax(np.abs(values)) or 1.0 for values in every])
        self.noise = np.array([np.median([*map(sigma_of, parts)]) for parts in readings])
        self.starts = [start_parameters(drive) for drive in drives]

    def shown_starts(self, values: NamedValues) -> list[Parameter]:
        """Return the start values that equal outputs and are not in `values`, with a first estimate for each log."""
        unknowns = []
        for k, (drive, starts) in enumerate(zip(self.drives, self.starts, strict=True)):
            known = {*values, *drive.given}
            shown = {p.name: (n, p) for n, p in starts.items() if n in drive.log.outputs and p.name not in known}
            first = first_start(drive.with_values(values), dict(shown.values())) if shown else {}
            for name, (output, p) in shown.items():
                spread = 0.1 * float(self.spread[self.channels.index(output)]) / abs(p.gain)
                unit = drive.units[output]
                start = first.get(name, p.tried[0])
                unknowns.append(Parameter(name, unit, start, p.low, p.high, None, True, True, k, spread))
        return unknowns

    def errors(self, k: int, values: NamedValues, horizon: float | None = None) -> Array | None:
        """Return measured − model for log k, shape (rows, channels), NaN if either is missing; None if the FMU fails.

        Args:
            horizon: Length of windows, if it differs from that of the estimate.
        """
        if time.monotonic() > self.deadline:
            raise OutOfTime
        self.count += 1
        drive, horizon = self.drives[k].with_values(values), horizon or self.horizon
        log = drive.log
        try:
            if horizon is None:
                outputs = as_columns(drive.run(0, log.rows - 1, {}), drive.outputs)
            else:
                replay = self_started(drive, free_run(drive, self.starts[k]), horizon)
                outputs = {} if replay is None else dict(replay.outputs)
        except SimulationError as error:
            self.failed += 1
            self.first_failure = self.first_failure or (dict(values), error)
            return None
        nothing = np.full(log.rows, np.nan)
        return np.column_stack([log.outputs.get(n, nothing) - outputs.get(n, nothing) for n in self.channels])


@dataclass(frozen=True, eq=False)
class Point:
    """Values of the unknowns with the residuals of all logs.

    Attributes:
        tables: Residuals of each log, shape (rows, channels); NaN without a value.
        counts, sigma: Number of values and standard deviation of each channel.
        cost: Negative log-likelihood with eliminated noise levels, up to a constant: Σ n·ln σ plus the priors.
    """

    x: Array
    tables: Sequence[Array]
    counts: Array
    sigma: Array
    cost: float


class Likelihood:
    """The likelihood of the logs as a function of the unknowns.

    Attributes:
        given: Values of other variables, set in every simulation.
        best: Point with the largest likelihood so far.
        slopes: Derivatives of the residuals by the unknowns, for intervals and identifiability.
    """

    best: Point
    slopes: Jacobian

    def __init__(self, logs: Logs, unknowns: Sequence[Parameter], given: NamedValues = MappingProxyType({})) -> None:
        self.logs, self.unknowns, self.given = logs, unknowns, given
        rows = [(u.low, u.high, u.start, u.scale, u.sigma) for u in unknowns]
        self.low, self.high, self.prior, self.scales, sigma = np.array(rows).reshape(-1, 5).T
        self.precision = sigma**-2.0

    # -- residuals ----------------------------------------------------------------------------

    def values(self, x: Array, k: int) -> dict[str, float]:
        """Return variable → value to set for the simulation of log k."""
        chosen = {u.name: float(v) for u, v in zip(self.unknowns, x, strict=True) if u.log in (None, k)}
        return {**self.given, **chosen}

    def tables(self, x: Array) -> list[Array] | None:
        """Return the residuals of all logs, None if a simulation fails.

        Logs with unchanged values are not simulated again.
        """
        tables, best = [], getattr(self, "best", None)
        for k in range(len(self.logs.drives)):
            values = self.values(x, k)
            same = best is not None and values == self.values(best.x, k)
            table = best.tables[k] if best is not None and same else self.logs.errors(k, values)
            if table is None:
                return None
            tables.append(table)
        return tables

    def point(self, x: Array) -> Point | None:
        """Return residuals and cost at x; None if a simulation fails."""
        tables = self.tables(x)
        if tables is None:
            return None
        counts = np.asarray(sum(np.isfinite(t).sum(axis=0) for t in tables), float)
        squares = sum(np.nansum(t * t, axis=0) for t in tables)
        sigma = np.maximum(np.sqrt(squares / np.maximum(counts, 1)), MIN_NOISE_RATIO * self.logs.spread)
        cost = float(counts @ np.log(sigma)) + 0.5 * float(self.precision @ (x - self.prior) ** 2)
        point = Point(x, tables, counts, sigma, cost)
        if not np.isfinite(point.cost):
            return None
        if not hasattr(self, "best") or point.cost < self.best.cost:
            self.best = point
        return point

    def restricted(self, kept: Flags, at: float | None = None) -> Likelihood:
        """Return the likelihood as a function of some unknowns.

        Other shared unknowns are fixed, and unknowns of single logs have the values of the FMU, both without priors.

        Args:
            kept: True for each unknown that remains.
            at: Value of the fixed unknowns; None for their best values, with which the result starts at the best point.
        """
        pairs = [*zip(self.unknowns, self.best.x, kept, strict=True)]
        held = {u.name: float(v) if at is None else at for u, v, k in pairs if not k and u.log is None}
        inner = Likelihood(self.logs, [u for u, _, k in pairs if k], {**self.given, **held})
        if at is None:
            inner.best = replace(self.best, x=self.best.x[kept])
        if hasattr(self, "slopes"):
            inner.slopes = [s[..., kept] for s in self.slopes]
        return inner

    # -- slopes -------------------------------------------------------------------------------

    def measure_slopes(self, central: bool = False) -> Jacobian:
        """Return the Jacobian of the residuals at the best point, by differences."""
        nothing = np.full(len(self.unknowns), np.nan)
        slopes = [np.where(np.isfinite(t)[..., None], 0.0, nothing) for t in self.best.tables]
        for j, unknown in enumerate(self.unknowns):
            for k in range(len(slopes)) if unknown.log is None else (unknown.log,):
                # the effect of a start value is nearly linear
                column = self._slope(j, k, central=central and not unknown.spread)
                if column is not None:
                    slopes[k][..., j] = column
        return slopes

    def _slope(self, j: int, k: int, *, central: bool) -> Array | None:
        """Return the derivative of log k's residuals by unknown j; None if the FMU fails on both sides."""
        size, sides = UNKNOWN_STEP * self.scales[j], []
        for side in (size, -size):
            moved = self.best.x.copy()
            moved[j] += side
            if not self.low[j] <= moved[j] <= self.high[j]:
                continue
            if (table := self.logs.errors(k, self.values(moved, k))) is not None:
                sides.append((side, table))
                if not central:
                    break
        if len(sides) == 2:
            return np.asarray((sides[0][1] - sides[1][1]) / (2.0 * size))
        return (sides[0][1] - self.best.tables[k]) / sides[0][0] if sides else None

    def weight_of(self, k: int, rows: Rows | slice = ALL_ROWS) -> tuple[Array, Array]:
        """Return information matrix and score of the residuals in some rows of log k, at the best point."""
        table, slopes = self.best.tables[k][rows], self.slopes[k][rows]
        good = np.isfinite(table)
        design = (slopes / self.best.sigma[:, None])[good]
        return design.T @ design, design.T @ (table / self.best.sigma)[good]

    def maximize(self, report: Callable[[int], None]) -> bool:
        """Move from the best point to the maximum likelihood by scipy's trust region; return True after convergence.

        The loss −2·ln L is passed as a function of squared residuals; its derivatives weight each output by the noise
        level.
        """
        from scipy.optimize import least_squares

        begin, before, latest, iterations = self.best, self.best, self.slopes, count()
        scales, roots = np.maximum(self.scales, np.abs(begin.x)), np.sqrt(self.precision)
        low, high = (self.low - begin.x) / scales, (self.high - begin.x) / scales
        cells = sum(table.size for table in begin.tables)
        least = (MIN_NOISE_RATIO * self.logs.spread / begin.sigma) ** 2

        def misses(x: Array) -> Array:
            """Return residuals in initial standard deviations, and deviations from the priors."""
            point = self.point(np.select([x <= low, x >= high], [self.low, self.high], begin.x + x * scales))
            if point is None:
                return np.full(cells + x.size, np.nan)
            errors = [np.nan_to_num(table / begin.sigma).ravel() for table in point.tables]
            return np.concatenate([*errors, roots * (point.x - self.prior)])

        def slopes(x: Array) -> Array:
            """Return the Jacobian of `misses` at the best point; after a small gain the last one, to save runs."""
            nonlocal before, latest
            report(next(iterations))
            if before.cost - self.best.cost > SETTLED_GAIN:
                latest = self.measure_slopes()
            before = self.best
            tables = [np.nan_to_num(slope / begin.sigma[:, None]).reshape(-1, x.size) for slope in latest]
            return np.asarray(np.vstack([*tables, np.diag(roots)]) * scales)

        def loss(squares: Array) -> Array:
            errors = squares[:cells].reshape(-1, least.size)
            variances = np.maximum(errors.sum(axis=0) / np.maximum(begin.counts, 1), least)
            values = np.vstack([np.zeros_like(squares), np.ones_like(squares), np.zeros_like(squares)])
            values[0, 0], values[0, cells:] = begin.counts @ np.log(variances / least), squares[cells:]
            values[1, :cells] = np.tile(1.0 / variances, len(errors))
            return values

        size = max(1.0, -0.5 * float(begin.counts @ np.log(least)))
        found = least_squares(
            *(misses, np.zeros(begin.x.size), slopes, (low, high), "dogbox"),
            **{
                "loss": loss,
                "ftol": SETTLED_GAIN / size,
                "xtol": MIN_RELATIVE_STEP,
                "gtol": None,
                "max_nfev": MAX_EVALUATIONS,
            },
        )
        return bool(found.status > 0)
