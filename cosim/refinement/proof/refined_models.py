"""The models that are held against each other: before, recalibrated, refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cosim.base.arrays import Array
from cosim.estimation.candidates import neutral_values
from cosim.estimation.expected import means, of_every_log
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.loading.file import LoadedModel
from cosim.model.model import Model
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.refinement.study import Study


@dataclass(frozen=True)
class Variant:
    """A model under judgement: an FMU with parameters set, and the filter that gives its starts."""

    model: Model
    values: Mapping[str, float]  # everything the kernel takes, sensors included
    noise: Noise
    fmu: Path
    parameters: Mapping[str, Any]  # what is set on the FMU
    defaults: Mapping[str, Any] = field(default_factory=dict)  # what its FMU has in place of the declared defaults

    def natively(self, fmu: Path) -> Variant:
        """The same in the FMU of its class, which has the declared defaults."""
        return replace(self, fmu=fmu, parameters={**self.defaults, **self.parameters}, defaults={})


def refined_model(study: Study, claimed: Hypothesis | None) -> LoadedModel:
    """The model with what was claimed put in, base parameters recalibrated with it; unchanged where nothing was.

    Errors of sensors alone leave its parameters as they are, and so its FMU, but for those of which it is stated how
    far they may be off. Of a parameter per log it has the mean.
    """
    loaded = study.loaded
    if claimed is None:
        return loaded
    sensors = loaded.model.sensor_parameters
    moved = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free if not f.group} | means(claimed.fit)
    parameters = dict(loaded.parameters)
    stated = {p.name for p in loaded.model.parameters if p.tolerance is not None} | {*study.settings.tolerance}
    parameters |= {n: v for n, v in moved.items() if n not in sensors and (n in stated or not claimed.of_sensors)}
    known = {**loaded.sensors, **{n: v for n, v in moved.items() if n in sensors}}
    return LoadedModel(loaded.model.with_values(parameters), loaded.source, parameters, known)


def variants_of(
    study: Study,
    a: Attribution,
    claimed: Hypothesis | None,
    refined: LoadedModel,
    fmus: tuple[Path, Path],
    near: Variant | None = None,
) -> dict[str, Variant]:
    """The model before, recalibrated and after, and the nearest, each with the filter that starts its replays.

    fmus: of the model that was given, and of the refined one
    """
    given_fmu, refined_fmu = fmus
    given, base = study.loaded, a.base.fit
    nominal = _values(given)
    recalibrated = {f.name: float(base.values[f.name]) for f in base.free if not f.group}
    changed = given.model.with_values(recalibrated)
    groups = list(study.settings.groups.values())
    before = after = Variant(
        given.model, nominal | of_every_log(a.given, groups), a.given.noise, given_fmu, {}, given.parameters
    )
    if claimed:
        values = _values(refined) | of_every_log(claimed.fit, groups)
        after = Variant(refined.model, values, claimed.fit.noise, refined_fmu, {}, refined.parameters)
    nominal |= of_every_log(base, groups)
    found = {
        "before": before,
        "recalibrated": Variant(
            changed, {**nominal, **recalibrated}, base.noise, given_fmu, recalibrated, given.parameters
        ),
        "after": after,
    }
    return found if near is None else {**found, "nearest": near}


def of_noise(after: Variant, a: Attribution, claimed: Hypothesis | None, heard: Array | None) -> Variant:
    """The refined model with the noise that is in the logs: what a model misses that is far off is none.

    heard: ln of the variances of sensor noise, where those of a fit hold what its model misses too
    """
    noise = (claimed or a.base).fit.noise
    return replace(after, noise=noise if heard is None else replace(noise, sensors=heard))


def variant_of(study: Study, loaded: LoadedModel, f: Fit, fmu: Path) -> Variant:
    """A model and a fit of it, whose FMU has all of it."""
    values = _values(loaded) | of_every_log(f, study.settings.groups.values())
    return Variant(loaded.model, values, f.noise, fmu, {}, loaded.parameters)


def _values(loaded: LoadedModel) -> dict[str, float]:
    """Every number the kernel takes, sensors included."""
    return {**neutral_values(loaded.model), **loaded.values}
