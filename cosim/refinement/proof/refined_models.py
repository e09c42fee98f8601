"""Variants of a subject for comparison: before, recalibrated, refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from cosim.estimation.expected import group_values, means
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Settings
from cosim.estimation.subject.interface import Subject
from cosim.refinement.search.hypotheses import Attribution, Hypothesis


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


def refined_subject(subject: Subject, settings: Settings, claimed: Hypothesis | None) -> Subject:
    """Return the subject with the fitted values of a claim; unchanged without a claim.

    A claim of sensor errors alone changes only sensor parameters and parameters with a stated tolerance. A parameter
    per log takes its mean.
    """
    if claimed is None:
        return subject
    fitted = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free if not f.group} | means(claimed.fit)
    stated = {p.name for p in subject.parameters if p.tolerance is not None} | {*settings.tolerance}
    unchanged = {n for n in fitted if n not in subject.sensor_parameters and n not in stated and claimed.is_of_sensors}
    return _with_values(subject, {n: v for n, v in fitted.items() if n not in unchanged})


def _with_values(subject: Subject, values: Mapping[str, float]) -> Subject:
    """Return the subject with other parameter values and the same horizon."""
    other = subject.refined(values)
    other.horizon = subject.horizon
    return other


def variants_of(
    subject: Subject, settings: Settings, a: Attribution, claimed: Hypothesis | None, refined: Subject
) -> dict[str, Variant]:
    """Return the variants before, recalibrated and after."""
    base = a.base.fit
    recalibrated = _with_values(subject, {f.name: float(base.values[f.name]) for f in base.free if not f.group})
    before = after = variant_of(subject, settings, a.unfitted)
    if claimed:
        after = variant_of(refined, settings, claimed.fit)
    return {"before": before, "recalibrated": variant_of(recalibrated, settings, base), "after": after}


def log_noise(fitted: Noise, free: Noise | None) -> Noise:
    """Return noise estimated from the logs.

    Args:
        free: Noise of a fit with free unknown inputs, if the fitted sensor noise includes model errors.
    """
    return fitted if free is None else replace(fitted, sensors=free.sensors)


def variant_of(subject: Subject, settings: Settings, f: Fit) -> Variant:
    """Return a subject with the noise and the parameters per log of a fit."""
    return Variant(subject, {**subject.values, **group_values(f, settings.groups.values())}, f.noise)
