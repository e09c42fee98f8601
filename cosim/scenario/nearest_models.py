"""`cosim run --nearest`: replace refined models of a scenario by their nearest candidates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosim.base.errors import Fault
from cosim.loading.refined import NEAREST, REFINED, NoNearest, folder_of, names_refine, refined_file
from cosim.scenario.scenario import FmuComponent
from cosim.scenario.scenario_file import ScenarioFile


def take_nearest(file: ScenarioFile) -> None:
    """Replace refined FMUs and the design's model by the nearest. Failures become faults of the scenario file."""
    faults: list[Fault] = []
    components: dict[str, Any] = dict(file.scenario.components)
    taken = 0
    for name, component in components.items():
        if not isinstance(component, FmuComponent) or (path := _refined(file, component.fmu)) is None:
            continue
        taken += 1
        if component.sha256 is not None:
            message = "a manifest repeats its run as it was; leave --nearest out, or run the scenario"
            faults.append(file.fault(("components", name, "fmu"), message))
            continue
        try:
            found = refined_file(path, nearest=True)
        except NoNearest as error:
            faults.append(file.fault(("components", name, "fmu"), str(error)))
        else:
            components[name] = component.model_copy(update={"fmu": str(found)})
    design = file.scenario.design
    if design is not None and design.model is not None and _refined(file, design.model) is not None:
        taken += 1
        design = design.model_copy(update={"nearest": True})
    if not taken:
        cure = "name the FMU or the model.yaml that `cosim refine` left, or leave --nearest out"
        faults.append(Fault(file.path, 0, 0, f"nothing in it comes from a refine, so --nearest says nothing; {cure}"))
    file.faults += faults
    file.scenario = file.scenario.model_copy(update={"components": components, "design": design})


def _refined(file: ScenarioFile, name: str) -> Path | None:
    """Return the path of a file or folder of a refine."""
    path = file.resolve(name)
    return path if folder_of(path) and (path.name in (*REFINED, *NEAREST) or names_refine(path)) else None
