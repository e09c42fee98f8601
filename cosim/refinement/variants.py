"""The models that are held against each other: before, recalibrated, refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.estimation.candidates import neutral_values
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.models.file import LoadedModel
from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.study import Study
from plant.model import Model


@dataclass(frozen=True)
class Variant:
    """A model under judgement: an FMU with parameters set, and the filter that gives its starts."""

    model: Model
    values: Mapping[str, float]  # everything the kernel takes, sensors included
    noise: Noise
    fmu: Path
    parameters: Mapping[str, Any]  # what is set on the FMU


def refined_model(loaded: LoadedModel, claimed: Hypothesis | None) -> LoadedModel:
    """The model with what was claimed put in, base parameters recalibrated with it; unchanged where nothing was.

    Errors of sensors alone leave its parameters as they are, and so its FMU.
    """
    if claimed is None:
        return loaded
    sensors = loaded.model.sensor_parameters
    moved = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free}
    parameters = dict(loaded.parameters)
    if not claimed.of_sensors:  # of which the plant knows nothing
        parameters |= {n: v for n, v in moved.items() if n not in sensors}
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
    recalibrated = {f.name: float(base.values[f.name]) for f in base.free}
    changed = given.model.with_values(recalibrated)
    before = after = Variant(given.model, nominal, base.noise, given_fmu, {})
    if claimed:
        after = Variant(refined.model, _values(refined), claimed.fit.noise, refined_fmu, {})
    found = {
        "before": before,
        "recalibrated": Variant(changed, {**nominal, **recalibrated}, base.noise, given_fmu, recalibrated),
        "after": after,
    }
    return found if near is None else {**found, "nearest": near}


def variant_of(loaded: LoadedModel, h: Hypothesis | None, base: Fit, fmu: Path) -> Variant:
    """A model with a hypothesis in it, or as it was given, whose FMU has all of it."""
    return Variant(loaded.model, _values(loaded), (h.fit if h else base).noise, fmu, {})


def _values(loaded: LoadedModel) -> dict[str, float]:
    """Every number the kernel takes, sensors included."""
    return {**neutral_values(loaded.model), **loaded.values}
