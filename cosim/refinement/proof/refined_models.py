"""The subjects that are held against each other: before, recalibrated, refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from cosim.base.arrays import Array
from cosim.estimation.expected import means, of_every_log
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Settings
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.subject.interface import Subject


@dataclass(frozen=True, eq=False)
class Variant:
    """A subject under judgement, and the filter that gives its starts.

    values: every number that the kernel takes, parameters of sensors and per log among them
    """

    subject: Subject
    values: Mapping[str, float]
    noise: Noise


def refined_subject(subject: Subject, settings: Settings, claimed: Hypothesis | None) -> Subject:
    """Return the subject with what was claimed put in, base parameters recalibrated with it; itself without a claim.

    Errors of sensors alone leave its parameters as they are, and so what is delivered, but for those of which it is
    stated how far they may be off. Of a parameter per log it has the mean.
    """
    if claimed is None:
        return subject
    moved = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free if not f.group} | means(claimed.fit)
    stated = {p.name for p in subject.parameters if p.tolerance is not None} | {*settings.tolerance}
    stays = {n for n in moved if n not in subject.sensor_parameters and n not in stated and claimed.of_sensors}
    return subject.refined({n: v for n, v in moved.items() if n not in stays})


def variants_of(
    subject: Subject, settings: Settings, a: Attribution, claimed: Hypothesis | None, refined: Subject
) -> dict[str, Variant]:
    """Return the subject before, recalibrated and after, each with the filter that starts its replays."""
    base = a.base.fit
    recalibrated = subject.refined({f.name: float(base.values[f.name]) for f in base.free if not f.group})
    before = after = variant_of(subject, settings, a.given)
    if claimed:
        after = variant_of(refined, settings, claimed.fit)
    return {"before": before, "recalibrated": variant_of(recalibrated, settings, base), "after": after}


def of_noise(after: Variant, a: Attribution, claimed: Hypothesis | None, heard: Array | None) -> Variant:
    """Return the refined subject with the noise that is in the logs: what a model misses that is far off is none.

    heard: ln of the variances of sensor noise, where those of a fit hold what its model misses too
    """
    noise = (claimed or a.base).fit.noise
    return replace(after, noise=noise if heard is None else replace(noise, sensors=heard))


def variant_of(subject: Subject, settings: Settings, f: Fit) -> Variant:
    """Return a subject with the noise of a fit, and its parameters per log."""
    return Variant(subject, {**subject.values, **of_every_log(f, settings.groups.values())}, f.noise)
