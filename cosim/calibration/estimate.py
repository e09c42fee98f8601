"""Estimation of parameters: screening, identifiability, free runs or windows, maximum likelihood, covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.calibration.fit_record import ChoiceEntry, CombinationEntry, ProfileEntry
from cosim.calibration.fit_study import Parameter
from cosim.calibration.identifiability import Covariance, covariance, find_combination, profile, screen
from cosim.calibration.likelihood import Likelihood, Logs
from cosim.core.arrays import Array, NamedValues
from cosim.core.errors import InputError
from cosim.logs.log import noise_level
from cosim.residuals.residual_statistics import rmse
from cosim.residuals.windows import horizons

DRIFTING_ERROR_RATIO = 5.0  # ratio of errors, free runs to windows, after the fit, above which free runs are useless
# effect of a start value in the last quarter of a log relative to its largest effect, above which it does not fade
MIN_LASTING_EFFECT = 0.2
UNSTABLE_GROWTH = 1e3  # effect of a start value in the last quarter relative to the first in an unstable plant
MAX_REFINEMENTS = 3  # number of times that central differences may move the estimate
NEGLIGIBLE_GAIN = 0.05  # gain in log-likelihood of a third of a standard error, below which slopes are not recomputed
INCOMPLETE_RATIO = 1.5  # of the standard deviation of a residual to its white part, from which a model is incomplete
MAX_WHITE_RATIO = 2.0  # variance of the mean of a residual relative to white noise, above which it is not white
NAMED_REASONS = 3
Report = Callable[[str, float], None]


class Estimate:
    """An estimation and its result.

    Attributes:
        likelihood: Likelihood with the best values so far; None before the first simulation of all logs.
        screened: Selected and rejected parameters with reasons; empty if the user named the parameters.
        combinations: Parameters that are identifiable only in combination; `held` is the parameter that is not
            estimated.
        singular: Singular values of the scaled sensitivities.
        idle: Parameters named by the user that have no effect.
        reason: Reason why windows are used instead of free runs; "" for free runs.
        has_windows: True if every log is suitable for windows.
        dropped: Start values named by the user that windows cannot estimate.
        settled: True if the last search ended at a maximum.
        profiles: Parameter → its profile; None if it is not estimated or has no interval.
    """

    def __init__(self, logs: Logs, report: Report) -> None:
        self.logs, self.report = logs, report
        self.likelihood: Likelihood | None = None
        self.screened: Sequence[ChoiceEntry] = ()
        self.combinations: list[CombinationEntry] = []
        self.held: dict[str, Parameter] = {}
        self.singular = np.zeros(0)
        self.idle, self.dropped = list[str](), list[str]()
        self.reason, self.settled = "", False
        self.has_windows = all(
            starts.keys() & d.log.outputs.keys() and float(d.log.time[-1] - d.log.time[0]) > 3.0 * horizons(d.log)[-1]
            for d, starts in zip(logs.drives, logs.starts, strict=True)
        )
        self.covariance: Covariance | None = None
        self.profiles = dict[str, ProfileEntry | None]()

    def run(self, parameters: Sequence[Parameter], *, screening: bool, profiled: Sequence[str] = ()) -> None:
        """Estimate the parameters; with `screening`, only parameters that the logs determine.

        Args:
            profiled: Parameters for which the profile likelihood is computed.

        Raises:
            InputError: The logs do not determine any parameter.
            SimulationError: The FMU fails with the initial values.
        """
        likelihood = self._begin(parameters)
        if screening:
            self.report("screening the parameters", 0.0)
            self.screened, kept = screen(likelihood)
            if not any(c.estimated for c in self.screened):
                raise _nothing_identifiable(f"{c.name}: {c.reason}" for c in self.screened[:NAMED_REASONS])
            likelihood = self.likelihood = likelihood.restricted(kept)
        rows, count = int(likelihood.best.counts.sum()), len(likelihood.unknowns)
        if rows <= count:
            raise InputError.at(
                self.logs.drives[0].log.path,
                f"{rows} measured values cannot determine {count} unknowns; name fewer parameters or more logs",
            )
        likelihood = self._fit(likelihood)
        if self.logs.horizon is None and self.has_windows and (reason := self._why_windows(likelihood)):
            self._use_windows(reason)
            chosen = [u for u in likelihood.unknowns if u.log is None]
            chosen += [*self.held.values(), *(p for p in parameters if p.per_log and not p.is_start)]
            self.combinations, self.held = [], {}
            likelihood = self._fit(self._begin(chosen))
        self.covariance = covariance(likelihood)
        places = {u.name: j for j, u in enumerate(likelihood.unknowns) if u.log is None}
        alone = places.keys() - {n for c in self.combinations for n in c.names}
        for k, name in enumerate(profiled):
            self.report(f"profiling {name}", k / len(profiled))
            self.profiles[name] = profile(likelihood, self.covariance, places[name]) if name in alone else None

    def _begin(self, parameters: Sequence[Parameter]) -> Likelihood:
        """Return the likelihood of the parameters, evaluated at initial values; for windows, without start values."""
        logs = self.logs
        while True:
            own = [p for p in parameters if p.per_log and not (p.is_start and logs.horizon)]
            unknowns = [p for p in parameters if not p.per_log]
            unknowns += [replace(p, log=k) for k in range(len(logs.drives)) for p in own]
            if logs.horizon is None:
                unknowns += logs.shown_starts({p.name: p.start for p in parameters})
            else:
                self.dropped = [p.name for p in parameters if p.is_start]
            likelihood = Likelihood(logs, unknowns)
            if likelihood.point(np.clip(likelihood.prior, likelihood.low, likelihood.high)) is not None:
                self.likelihood = likelihood
                return likelihood
            if logs.horizon is not None or not self.has_windows:
                assert logs.first_failure is not None
                raise logs.first_failure[1]
            self._use_windows("the simulation of a whole log fails with the values before the fit")

    def _use_windows(self, reason: str) -> None:
        self.reason, self.logs.horizon = reason, max(horizons(d.log)[-1] for d in self.logs.drives)

    def _fit(self, likelihood: Likelihood) -> Likelihood:
        """Return the likelihood at its maximum, with derivatives by central differences."""
        self.report("measuring sensitivities", 0.0)
        likelihood.slopes = likelihood.measure_slopes()
        sigma, shared = likelihood.best.sigma[:, None], np.array([u.log is None for u in likelihood.unknowns])
        sizes = [np.nanmax(np.abs(slope / sigma), axis=(0, 1), initial=0.0) for slope in likelihood.slopes]
        acts = np.max(sizes, axis=0) > 0.0
        if idle := {u.name: u for u, act in zip(likelihood.unknowns, acts, strict=True) if not act}:
            if not (acts & shared).any():
                raise _nothing_identifiable(f"{name}: no effect on any measured output" for name in idle)
            self.idle, self.held = [*idle], {**self.held, **idle}
            likelihood = likelihood.restricted(acts)
        while True:
            combination, self.singular = find_combination(likelihood)
            if combination is None:
                break
            self.combinations.append(combination)
            is_held = np.array([u.log is None and u.name == combination.held for u in likelihood.unknowns])
            self.held |= {u.name: u for u in likelihood.unknowns if u.name == combination.held}
            likelihood = likelihood.restricted(~is_held)
        self.likelihood = likelihood
        if self.logs.horizon is None and self.has_windows and self._start_effects(likelihood)[0] > UNSTABLE_GROWTH:
            return likelihood  # the plant is unstable: windows are used next
        for number in range(MAX_REFINEMENTS):
            before = likelihood.best.cost
            self.settled = likelihood.maximize(lambda k: self.report(f"fitting, iteration {k + 1}", 0.0))
            if number and before - likelihood.best.cost < NEGLIGIBLE_GAIN:
                break
            self.report("measuring sensitivities", 0.0)
            likelihood.slopes = likelihood.measure_slopes(central=True)
        return likelihood

    def above_noise(self) -> list[str]:
        """Return the outputs whose residual is neither white nor as small as the noise."""
        assert self.likelihood is not None
        assert self.covariance is not None
        point, names = self.likelihood.best, []
        for c, name in enumerate(self.logs.channels):
            levels = [noise_level(t[:, c]) for t in point.tables if np.isfinite(t[:, c]).any()]
            if (
                point.sigma[c] > INCOMPLETE_RATIO * float(np.nanmedian(levels))
                and self.covariance.colour[c] > MAX_WHITE_RATIO
            ):
                names.append(name)
        return names

    def _start_effects(self, likelihood: Likelihood) -> tuple[float, bool]:
        """Return how start values affect the outputs from the first to the last quarter of their logs.

        Returns:
            The largest growth of an effect, as a factor; True if a start value still affects outputs at the end of its
            log.
        """
        growth, stays = 0.0, False
        for j, unknown in enumerate(likelihood.unknowns):
            if unknown.log is not None and unknown.spread:
                parts = np.array_split(likelihood.slopes[unknown.log][..., j] / likelihood.best.sigma, 4)
                first, *_, last = sizes = [rmse(part) if np.isfinite(part).any() else 0.0 for part in parts]
                growth = max(growth, last / first if first > 0.0 else 0.0)
                stays = stays or last > MIN_LASTING_EFFECT * max(sizes)
        return growth, stays

    def _why_windows(self, likelihood: Likelihood) -> str:
        """Return why windows must replace free runs; "" if free runs can be used."""
        growth, stays = self._start_effects(likelihood)
        if growth > UNSTABLE_GROWTH:
            return (
                f"the plant is unstable: a small change of the start value grows by a factor of {growth:.0e} over a log"
            )
        if not stays:
            return ""
        logs, point = self.logs, likelihood.best

        def squares(k: int, values: NamedValues) -> Array:
            """Return the mean square errors of windows of a log; infinite if the FMU fails."""
            table = logs.errors(k, values, horizons(logs.drives[k].log)[-1])
            if table is None:
                return np.full(len(logs.channels), np.inf)
            return np.asarray(np.nansum(table**2, axis=0) / np.isfinite(table).sum(axis=0))

        first = {**likelihood.given, **{u.name: u.start for u in likelihood.unknowns if u.log is None}}
        with np.errstate(invalid="ignore", divide="ignore"):
            places = range(len(logs.drives))
            after = np.mean([squares(k, likelihood.values(point.x, k)) for k in places], axis=0)
            before = np.mean([squares(k, first) for k in places], axis=0)
            ratio = np.nan_to_num(point.sigma / np.sqrt(np.fmin(after, before)))
        worst = int(np.argmax(ratio))
        if not ratio[worst] > DRIFTING_ERROR_RATIO:
            return ""
        return (
            f"the effect of the start value does not fade, and even after a fit, the error of {logs.channels[worst]} "
            f"over a whole log is {ratio[worst]:.0f} times the error over windows"
        )


def _nothing_identifiable(reasons: Iterable[str]) -> InputError:
    message = f"no parameter is identifiable from these logs: {'; '.join(reasons)}; name parameters with --vary, or log"
    return InputError.at(Path("--vary"), f"{message} other inputs")
