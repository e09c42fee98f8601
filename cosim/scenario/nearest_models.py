"""`cosim run --nearest`: replace refined models of a scenario by their nearest candidates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosim.base.errors import Fault
from cosim.loading.refined import NEAREST, REFINED, NoNearest, folder_of, names_refine, refined_file
from cosim.scenario.scenario import FmuComponent
from cosim.scenario.scenario_file import ScenarioFile


def take_nearest(file: ScenarioFile) -> None:
    """Replace refined FMUs by the nearest. Failures become faults of the scenario file."""
    components: dict[str, Any] = dict(file.scenario.components)
    has_refined = False
    for name, component in components.items():
        if not isinstance(component, FmuComponent):
            continue
        if (path := _refined_path(file, component.fmu)) is None:
            continue
        has_refined = True
        try:
            if component.sha256 is not None:
                raise NoNearest("a manifest repeats its run as it was; leave --nearest out, or run the scenario")
            components[name] = component.model_copy(update={"fmu": str(refined_file(path, nearest=True))})
        except NoNearest as error:
            file.faults.append(file.fault(("components", name, "fmu"), str(error)))
    if not has_refined:
        reason = (
            "no component uses a result of `cosim refine`, so --nearest has no effect; name the FMU of such a result"
        )
        file.faults.append(Fault(file.path, 0, 0, f"{reason}, or leave --nearest out"))
    file.scenario = file.scenario.model_copy(update={"components": components})


def _refined_path(file: ScenarioFile, name: str) -> Path | None:
    """Return the resolved path if it is a result folder of `refine` or a model file in one, else None."""
    path = file.resolve(name)
    return path if folder_of(path) and (path.name in (*REFINED, *NEAREST) or names_refine(path)) else None
