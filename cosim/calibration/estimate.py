"""The estimate: screening, combinations, free runs or windows, largest likelihood, covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosim.calibration.identifiability import Choice, Combination, find_combination, screen
from cosim.calibration.intervals import Covariance, covariance
from cosim.calibration.likelihood import Jacobian, Likelihood, Point
from cosim.calibration.simulations import Logs, Unknown
from cosim.calibration.vary import Parameter
from cosim.core.arrays import Array, Flags
from cosim.core.errors import InputError, SimulationError
from cosim.logs.channel_noise import noise_level
from cosim.residuals.windows import horizons

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
    def best(self) -> tuple[Likelihood, Point]:
        """Return the likelihood and the best values so far."""
        assert self.likelihood is not None
        assert self.likelihood.best is not None
        return self.likelihood, self.likelihood.best

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
                raise _nothing_identifiable([f"{c.name}: {c.reason}" for c in self.screened[:NAMED_REASONS]])
            likelihood, point = likelihood.restricted(kept, point)
            self.likelihood = likelihood
        rows, count = int(point.counts.sum()), len(likelihood.unknowns)
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
            slopes = self._fit(*self._begin(chosen))
        self.covariance = covariance(*self.best, slopes)

    def _begin(self, parameters: Sequence[Parameter]) -> tuple[Likelihood, Point]:
        """Return the likelihood of these parameters and its value before the fit; windows need no start values."""
        named, values = [p for p in parameters if p.per_log], {p.name: p.start for p in parameters}
        while True:
            unknowns = [(Unknown(p), p.start) for p in parameters if not p.per_log]
            if self.logs.horizon is None:
                count = len(self.logs.drives)
                unknowns += [(Unknown(p, k, hidden=True), p.start) for k in range(count) for p in named]
                unknowns += self.logs.start_unknowns(values, values)
            else:
                self.dropped = tuple(p.name for p in named)
            likelihood = Likelihood(self.logs, [u for u, _ in unknowns])
            start = np.clip(np.array([value for _, value in unknowns]), likelihood.low, likelihood.high)
            point = likelihood.point(start)
            if point is not None:
                self.likelihood = likelihood
                return likelihood, point
            if self.logs.horizon is not None or not self._has_windows():
                assert self.logs.first_failure is not None
                raise self.logs.first_failure[1]
            self._use_windows("the free run fails with the values before the fit")

    def _fit(self, likelihood: Likelihood, point: Point) -> Jacobian:
        """Move to the largest likelihood; return central differences there."""
        self.report("measuring sensitivities", 0.0)
        slopes = likelihood.jacobian(point)

        def keep(kept: Flags) -> tuple[Likelihood, Point, Jacobian]:
            self.likelihood, inner = likelihood.restricted(kept, point)
            return self.likelihood, inner, [s[..., kept] for s in slopes]

        acts = np.zeros(len(likelihood.unknowns), bool)
        for slope in slopes:
            acts |= np.nanmax(np.abs(slope / point.sigma[:, None]), axis=(0, 1), initial=0.0) > 0.0
        if idle := {u.name: u.parameter for u, act in zip(likelihood.unknowns, acts, strict=True) if not act}:
            if not any(u.log is None and act for u, act in zip(likelihood.unknowns, acts, strict=True)):
                raise _nothing_identifiable([f"{name}: no effect on any measured output" for name in idle])
            self.idle, self.held = tuple(idle), {**self.held, **idle}
            likelihood, point, slopes = keep(acts)
        while True:
            found, self.singular = find_combination(likelihood, point, slopes)
            if found is None:
                break
            self.combinations.append(found)
            self.held |= {u.name: u.parameter for u in likelihood.unknowns if u.name == found.held}
            likelihood, point, slopes = keep(
                np.array([u.log is not None or u.name != found.held for u in likelihood.unknowns])
            )
        if self.logs.horizon is None and self._start_effects(slopes, point)[0] > GROWS and self._has_windows():
            return slopes  # the plant is unstable: windows come next
        for number in range(REFINEMENTS):
            self.settled = likelihood.maximize(
                point, slopes, lambda iteration: self.report(f"fitting, iteration {iteration + 1}", 0.0)
            )
            before = point
            _, point = self.best
            if number and before.cost - point.cost < CLOSE:
                break
            self.report("measuring sensitivities", 0.0)
            slopes = likelihood.jacobian(point, central=True)
        return slopes

    def above_noise(self) -> list[str]:
        """Return the outputs whose residual is larger than its white part and is not white."""
        assert self.covariance is not None
        _, point = self.best
        names = []
        for c, name in enumerate(self.logs.channels):
            levels = [noise_level(t[:, c]) for t in point.tables if np.isfinite(t[:, c]).any()]
            above = point.sigma[c] > ABOVE * float(np.nanmedian(levels))
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

    def _start_effects(self, slopes: Jacobian, point: Point) -> tuple[float, bool]:
        """Return the largest growth of the effect of a start value from the first quarter to the last of its log.

        Returns:
            The growth, and whether the effect of some start value does not fade over its log.
        """
        likelihood, _ = self.best
        growth, stays = 0.0, False
        for j, unknown in enumerate(likelihood.unknowns):
            if unknown.log is not None and unknown.is_shown:
                parts = np.array_split(slopes[unknown.log][..., j] / point.sigma, 4)
                sizes = [float(np.sqrt(np.nanmean(p**2))) if np.isfinite(p).any() else 0.0 for p in parts]
                growth = max(growth, sizes[-1] / sizes[0] if sizes[0] > 0.0 else 0.0)
                stays = stays or sizes[-1] > STAYS * max(sizes)
        return growth, stays

    def _why_windows(self, slopes: Jacobian) -> str:
        """Return why free runs are useless, or ""."""
        if not self._has_windows():
            return ""
        likelihood, point = self.best
        growth, stays = self._start_effects(slopes, point)
        if growth > GROWS:
            return f"the plant is unstable: a small change of the start grows {growth:.0e} times over a log"
        if not stays:
            return ""
        first = {u.name: u.parameter.start for u in likelihood.unknowns if u.log is None}
        every = range(len(self.logs.drives))
        after = [self._window_squares(k, likelihood.values(point.x, k)) for k in every]
        before = [self._window_squares(k, {**likelihood.given, **first}) for k in every]
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = np.fmin(np.mean(after, axis=0), np.mean(before, axis=0))
            ratio = np.nan_to_num(point.sigma / np.sqrt(errors))
        worst = int(np.argmax(ratio))
        if not ratio[worst] > DRIFTS:
            return ""
        name = self.logs.channels[worst]
        return (
            f"the effect of the start does not fade, and a free run misses {name} {ratio[worst]:.0f} times "
            "as far as windows, even after a fit"
        )

    def _window_squares(self, k: int, values: Mapping[str, float]) -> list[float]:
        """Return the mean square errors of a log over windows, infinite after a failure."""
        log = self.logs.drives[k].log
        try:
            outputs = self.logs.outputs(k, values, horizons(log)[-1])
        except SimulationError:
            outputs = {}
        squares = []
        for name in self.logs.channels:
            error = log.outputs[name] - outputs[name] if name in outputs and name in log.outputs else np.zeros(0)
            known = error[np.isfinite(error)]
            squares.append(float(np.mean(known**2)) if known.size else np.inf)
        return squares


def _nothing_identifiable(reasons: Sequence[str]) -> InputError:
    message = (
        f"no parameter is identifiable from these logs: {'; '.join(reasons)}; name parameters as --vary, or log other "
        "inputs"
    )
    return InputError.at(Path("--vary"), message)
