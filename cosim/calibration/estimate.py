"""The estimate: screening, combinations, free runs or windows, largest likelihood, covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import InputError, SimulationError
from cosim.calibration.identifiability import Choice, Combination, find_combination, screen
from cosim.calibration.intervals import Covariance, covariance
from cosim.calibration.likelihood import Jacobian, Likelihood, Point
from cosim.calibration.simulations import Logs, SetDrive, Unknown
from cosim.calibration.vary import Parameter
from cosim.logs.channel_noise import noise_level
from cosim.residuals.windows import free_run, horizons, self_started

NOTHING_IDENTIFIABLE = (
    "no parameter is identifiable from these logs: {reasons}; name parameters as --vary, or log other inputs"
)

DRIFTS = 5.0  # error of free runs over that of windows, after the fit, from which free runs are useless
STAYS = 0.2  # effect of a start value in the last quarter relative to its largest, from which it does not fade
GROWS = 1e3  # effect of a start value in the last quarter relative to the first, from which a plant is unstable
REFINEMENTS = 3  # times that central differences may move the estimate
CLOSE = 0.05  # gain in log-likelihood of a move of a third of a standard error, over which slopes do not change
ABOVE = 1.5  # standard deviation of a residual relative to its white part, from which something is missing
COLOURED = 2.0  # variance of the mean of a residual relative to white noise, from which it is not white
NAMED_REASONS = 3
Report = Callable[[str, float], None]


@dataclass
class Estimate:
    """An estimate on its way, and its result.

    Attributes:
        screened: Choice among the parameters, empty if they were named.
        combinations: Parameters that are not identifiable one by one; `held` has those that keep their value.
        singular: Singular values of the scaled sensitivities.
        idle: Named parameters without effect.
        reason: Reason for windows in place of free runs, "" for free runs.
        dropped: Named start values that windows cannot estimate.
    """

    logs: Logs
    given: Mapping[str, float]
    report: Report
    likelihood: Likelihood | None = None
    screened: list[Choice] = field(default_factory=list)
    combinations: list[Combination] = field(default_factory=list)
    held: dict[str, Parameter] = field(default_factory=dict)
    singular: Array = field(default_factory=lambda: np.zeros(0))
    idle: tuple[str, ...] = ()
    reason: str = ""
    dropped: tuple[str, ...] = ()
    settled: bool = False
    covariance: Covariance | None = None

    @property
    def point(self) -> Point | None:
        """Return the best values so far."""
        return None if self.likelihood is None else self.likelihood.best

    def run(self, parameters: Sequence[Parameter], *, screening: bool) -> None:
        """Estimate parameters, with `screening` only determined ones.

        Raises:
            InputError: The logs determine no parameter.
            SimulationError: The FMU fails with the values before the fit.
        """
        likelihood, point = self._begin(parameters)
        if screening:
            self.report("screening the parameters", 0.0)
            self.screened, kept = screen(likelihood, point)
            if not any(c.estimated for c in self.screened):
                shown = [f"{c.name}: {c.reason}" for c in self.screened[:NAMED_REASONS]]
                raise InputError.at(Path("--vary"), NOTHING_IDENTIFIABLE.format(reasons="; ".join(shown)))
            likelihood, point = likelihood.restricted(kept, point)
            self.likelihood = likelihood
        rows, count = int(point.residuals.counts.sum()), len(likelihood.unknowns)
        if rows <= count:
            raise InputError.at(
                self.logs.drives[0].log.path,
                f"{rows} measured values cannot determine {count} unknowns; name fewer parameters or more logs",
            )
        slopes = self._fit(likelihood, point)
        if self.logs.horizon is None and (reason := self._why_windows(slopes)):
            self._use_windows(reason)
            chosen = [u.parameter for u in likelihood.unknowns if u.log is None]
            chosen += self.held.values()
            self.combinations, self.held = [], {}
            likelihood, point = self._begin(chosen)
            slopes = self._fit(likelihood, point)
        assert self.likelihood is not None
        assert self.point is not None
        self.covariance = covariance(self.likelihood, self.point, slopes)

    def _begin(self, parameters: Sequence[Parameter]) -> tuple[Likelihood, Point]:
        """Return the likelihood of these parameters and its value before the fit."""
        while True:
            unknowns = self._unknowns(parameters)
            likelihood = Likelihood(self.logs, [u for u, _ in unknowns], self.given)
            start = np.clip(np.array([value for _, value in unknowns]), likelihood.low, likelihood.high)
            point = likelihood.point(start)
            if point is not None:
                self.likelihood = likelihood
                return likelihood, point
            if self.logs.horizon is not None or not self._has_windows():
                assert self.logs.first_failure is not None
                raise self.logs.first_failure[1]
            self._use_windows("the free run fails with the values before the fit")

    def _unknowns(self, parameters: Sequence[Parameter]) -> list[tuple[Unknown, float]]:
        """Return everything to estimate with its first value; windows need no start values."""
        shared = [(Unknown(p), p.start) for p in parameters if not p.per_log]
        named = [p for p in parameters if p.per_log]
        if self.logs.horizon is not None:
            self.dropped = tuple(p.name for p in named)
            return shared
        values, count = {p.name: p.start for p in parameters}, len(self.logs.drives)
        own = [(Unknown(p, k, hidden=True), p.start) for k in range(count) for p in named]
        return [*shared, *own, *self.logs.start_unknowns(values, values)]

    def _fit(self, likelihood: Likelihood, point: Point) -> Jacobian:
        """Move to the largest likelihood; return central differences there."""
        self.report("measuring sensitivities", 0.0)
        slopes = likelihood.jacobian(point)
        likelihood, point, slopes = self._without_idle(likelihood, point, slopes)
        while True:
            found, self.singular = find_combination(likelihood, point, slopes)
            if found is None:
                break
            self.combinations.append(found)
            self.held |= {u.name: u.parameter for u in likelihood.unknowns if u.name == found.held}
            kept = np.array([u.log is not None or u.name != found.held for u in likelihood.unknowns])
            likelihood, point, slopes = self._keep(kept, likelihood, point, slopes)
        if self.logs.horizon is None and _growth(likelihood, point, slopes) > GROWS and self._has_windows():
            return slopes  # the plant is unstable: windows come next
        for number in range(REFINEMENTS):
            self.settled = likelihood.maximize(
                point, slopes, lambda iteration: self.report(f"fitting, iteration {iteration + 1}", 0.0)
            )
            assert likelihood.best is not None
            gain, point = point.cost - likelihood.best.cost, likelihood.best
            if number and gain < CLOSE:
                break
            self.report("measuring sensitivities", 0.0)
            slopes = likelihood.jacobian(point, central=True)
        return slopes

    def _without_idle(
        self, likelihood: Likelihood, point: Point, slopes: Jacobian
    ) -> tuple[Likelihood, Point, Jacobian]:
        """Return everything without the unknowns that change no output; these keep their values."""
        acts = np.zeros(len(likelihood.unknowns), bool)
        for slope in slopes:
            acts |= np.nanmax(np.abs(slope / point.residuals.sigma[:, None]), axis=(0, 1), initial=0.0) > 0.0
        idle = {u.name: u.parameter for u, act in zip(likelihood.unknowns, acts, strict=True) if not act}
        if not idle:
            return likelihood, point, slopes
        if not any(u.log is None and act for u, act in zip(likelihood.unknowns, acts, strict=True)):
            shown = "; ".join(f"{name}: no effect on any measured output" for name in idle)
            raise InputError.at(Path("--vary"), NOTHING_IDENTIFIABLE.format(reasons=shown))
        self.idle, self.held = tuple(idle), {**self.held, **idle}
        return self._keep(acts, likelihood, point, slopes)

    def _keep(
        self, kept: Flags, likelihood: Likelihood, point: Point, slopes: Jacobian
    ) -> tuple[Likelihood, Point, Jacobian]:
        """Return everything for some of the unknowns."""
        self.likelihood, point = likelihood.restricted(kept, point)
        return self.likelihood, point, [s[..., kept] for s in slopes]

    def above_noise(self) -> list[str]:
        """Return the outputs whose residual is larger than its white part and is not white."""
        assert self.point is not None
        assert self.covariance is not None
        names = []
        for c, name in enumerate(self.logs.channels):
            levels = [noise_level(t[:, c]) for t in self.point.residuals.tables if np.isfinite(t[:, c]).any()]
            above = self.point.residuals.sigma[c] > ABOVE * float(np.nanmedian(levels))
            if above and self.covariance.colour[c] > COLOURED:
                names.append(name)
        return names

    # -- windows ------------------------------------------------------------------------------

    def _has_windows(self) -> bool:
        """Return whether every log has windows."""
        return all(
            starts.keys() & d.log.outputs.keys() and float(d.log.time[-1] - d.log.time[0]) > 3.0 * horizons(d.log)[-1]
            for d, starts in zip(self.logs.drives, self.logs.all_starts, strict=True)
        )

    def _use_windows(self, reason: str) -> None:
        self.reason, self.logs.horizon = reason, max(horizons(d.log)[-1] for d in self.logs.drives)

    def _why_windows(self, slopes: Jacobian) -> str:
        """Return why free runs are useless, or ""."""
        likelihood, point = self.likelihood, self.point
        assert likelihood is not None
        assert point is not None
        if not self._has_windows():
            return ""
        if (growth := _growth(likelihood, point, slopes)) > GROWS:
            return f"the plant is unstable: a small change of the start grows {growth:.0e} times over a log"
        if not _stays(likelihood, slopes, point):
            return ""
        squares = [self._window_squares(k, likelihood.values(point.x, k)) for k in range(len(self.logs.drives))]
        before = [self._window_squares(k, _first(likelihood)) for k in range(len(self.logs.drives))]
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = np.fmin(np.mean(squares, axis=0), np.mean(before, axis=0))
            ratio = np.nan_to_num(point.residuals.sigma / np.sqrt(errors))
        worst = int(np.argmax(ratio))
        if not ratio[worst] > DRIFTS:
            return ""
        name = self.logs.channels[worst]
        return (
            f"the effect of the start does not fade, and a free run misses {name} {ratio[worst]:.0f} times "
            "as far as windows, even after a fit"
        )

    def _window_squares(self, k: int, values: Mapping[str, float]) -> Array:
        """Return the mean square errors of a log over windows, infinite after a failure."""
        drive, nothing = self.logs.drives[k], np.full(len(self.logs.channels), np.inf)
        moved = SetDrive(drive, values)
        self.logs.count += 1
        try:
            windowed = self_started(moved, self.logs.all_starts[k], free_run(moved), horizons(drive.log)[-1])
        except SimulationError:
            return nothing
        if windowed is None:
            return nothing
        errors = windowed.errors(drive.log)
        squares = {n: float(np.mean(e[np.isfinite(e)] ** 2)) for n, e in errors.items() if np.isfinite(e).any()}
        return np.array([squares.get(n, np.inf) for n in self.logs.channels])


def _first(likelihood: Likelihood) -> dict[str, float]:
    """Return the values of the parameters before the fit."""
    return {**likelihood.given, **{u.name: u.parameter.start for u in likelihood.unknowns if u.log is None}}


def _quarters(likelihood: Likelihood, point: Point, slopes: Jacobian) -> list[Array]:
    """Return the effect of each start value in the four quarters of its log."""
    effects = []
    for j, unknown in enumerate(likelihood.unknowns):
        if unknown.log is not None and unknown.is_shown:
            table = slopes[unknown.log][..., j] / point.residuals.sigma
            parts = np.array_split(table, 4)
            effects.append(np.array([np.sqrt(np.nanmean(p**2)) if np.isfinite(p).any() else 0.0 for p in parts]))
    return effects


def _growth(likelihood: Likelihood, point: Point, slopes: Jacobian) -> float:
    """Return the largest growth of the effect of a start value from the first quarter to the last."""
    return max((q[-1] / q[0] for q in _quarters(likelihood, point, slopes) if q[0] > 0.0), default=0.0)


def _stays(likelihood: Likelihood, slopes: Jacobian, point: Point) -> bool:
    """Return whether the effect of a start value does not fade over a log."""
    return any(q[-1] > STAYS * np.max(q) for q in _quarters(likelihood, point, slopes))
