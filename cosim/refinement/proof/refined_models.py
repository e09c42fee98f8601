"""Variants of a subject for comparison: before, recalibrated, refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.per_log import expected_values, group_values
from cosim.estimation.problem import Settings
from cosim.estimation.subject.interface import Subject
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.residuals.residual_statistics import FREE_RUN


@dataclass(frozen=True, eq=False)
class Variant:
    """A subject with parameter values and noise, for filters and replays.

    Attributes:
        values: All parameters of the kernel, including sensor errors and parameters per log.
        free_noise: Noise with which a filter follows the readings, where that of the fit does not.
    """

    subject: Subject
    values: Mapping[str, float]
    noise: Noise
    free_noise: Noise | None = None

    def noise_of_starts(self, horizon: float) -> Noise:
        """Return the noise of the filter from which replays over a horizon start.

        A fit that trusts the equations has a filter that hardly follows the readings; replays within a log begin where
        one that does follow them has arrived. A free run begins with the log.
        """
        return self.noise if self.free_noise is None or horizon == FREE_RUN else self.free_noise


def refined_subject(subject: Subject, settings: Settings, claimed: Hypothesis | None) -> Subject:
    """Return the subject with the fitted values of a claim; unchanged without a claim.

    A claim of sensor errors alone changes only sensor parameters and parameters with a stated tolerance. A parameter
    per log takes its mean.
    """
    if claimed is None:
        return subject
    fitted = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free if not f.group}
    fitted |= {name: mean for name, (mean, _) in expected_values(claimed.fit).items()}
    stated = {p.name for p in subject.parameters if p.tolerance is not None} | {*settings.tolerance}
    unchanged = {n for n in fitted if n not in subject.sensor_parameters and n not in stated and claimed.is_of_sensors}
    refined = subject.refined({n: v for n, v in fitted.items() if n not in unchanged})
    refined.horizon = subject.horizon
    return refined


def log_noise(fitted: Noise, free: Noise | None) -> Noise:
    """Return noise estimated from the logs.

    Args:
        free: Noise of a fit with free unknown inputs, if the fitted sensor noise includes model errors.
    """
    return fitted if free is None else replace(fitted, sensors=free.sensors)


def variant_of(subject: Subject, settings: Settings, f: Fit, free_noise: Noise | None) -> Variant:
    """Return a subject with the noise and the parameters per log of a fit."""
    return Variant(subject, {**subject.values, **group_values(f, settings.groups.values())}, f.noise, free_noise)
