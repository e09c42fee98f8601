"""SSP files as scenarios: a scenario.json with FMUs, and for each part its element in the SSP."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.blocks.coupling import Jacobi
from cosim.blocks.summary import experiment_of
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.scratch import temporary_folder
from cosim.core.text import unique_name
from cosim.files.artefact import SSP
from cosim.files.files import check_writable, write_json
from cosim.files.folders import remove_earlier
from cosim.files.kinds import kind_by_form
from cosim.files.yaml_file import Location
from cosim.scenario.scenario_file import SYSTEM, ScenarioFile, is_whole
from cosim.system.system import build_system

if TYPE_CHECKING:
    from cosim.ssp.read import Element, SspSystem

SCENARIO_JSON = "scenario.json"  # in SYSTEM, inside the results folder
DEFAULT_STOP_S, DEFAULT_STEP_S = 1.0, 0.01  # defaults [s] if neither the SSP nor its FMUs declare a value
ALGORITHM_OF_IMPORTERS = Jacobi()  # the coupling algorithm of libcosim, ecos and FMPy


def is_ssp(path: Path) -> bool:
    """Return True if a file is an SSP, by its suffix or content."""
    return kind_by_form(path) == SSP


def lay_out(path: Path, folder: Path, overrides: Sequence[str] = ()) -> tuple[ScenarioFile, list[str]]:
    """Write the scenario and the FMUs of an SSP to `folder`/system.

    The files of an earlier run are removed. For a faulty SSP, InputError with all faults is raised before a file is
    written.

    Returns:
        The scenario file and warnings.
    """
    from cosim.ssp.read import SspSystem, open_package

    with open_package(path) as package, temporary_folder("ssp") as scratch:
        system = SspSystem(package)
        files: dict[str, Path] = {}  # unique name → file
        for fmu in dict.fromkeys(part.fmu for part in system.parts.values()):
            files[unique_name(fmu.stem, files, fmu.suffix)] = fmu
        warnings = list(system.warnings)
        keys = frozenset(override.partition("=")[0].strip() for override in overrides)
        scenario, places = _scenario(system, files, warnings, keys)

        def fault(location: Location, message: str, exit_code: int = 2) -> Fault:
            """Return a fault of a part, with the file and place of its element in the SSP."""
            parts = (location[:end] for end in range(len(location), 0, -1))
            element = next((places[part] for part in parts if part in places), None)
            if element is None:
                return Fault(package.shown, 0, 0, message, exit_code)
            return replace(element.fault(message), exit_code=exit_code)

        trial = scratch / SCENARIO_JSON
        named = {name: {**c, "fmu": str(files[c["fmu"]])} for name, c in scenario["components"].items()}
        trial.write_text(json.dumps({**scenario, "components": named}), encoding="utf-8")
        faults = list(system.faults)
        if named:
            try:
                build_system(ScenarioFile(trial, overrides, fault))
            except InputError as error:
                faults += error.faults
        elif not faults:
            faults.append(system.element.fault("it has no FMU, so there is nothing to run"))
        if faults:
            if package.packed:  # true for a temporary folder
                faults = [
                    replace(f, message=f.message.replace(f"{package.folder}/", f"{package.shown}/")) for f in faults
                ]
            raise InputError([replace(f, file=package.shown) if f.file == trial else f for f in faults])
        within, inputs = folder / SYSTEM, [path, *files.values()]
        check_writable(within, (SCENARIO_JSON, *files), inputs)
        remove_earlier(folder, read=inputs)
        for name, source in files.items():
            with draft_of(within / name) as draft:
                shutil.copyfile(source, draft)
        write_json(within / SCENARIO_JSON, scenario)
        return ScenarioFile(within / SCENARIO_JSON, overrides, fault), warnings


def _scenario(
    system: SspSystem, files: dict[str, Path], warnings: list[str], overrides: Set[str]
) -> tuple[dict[str, Any], dict[Location, Element]]:
    """Return the scenario as a mapping, and the SSD element from which each of its keys was read.

    If a default is used, a warning is added, unless `overrides` contains the key.
    """
    places: dict[Location, Element] = {}
    name_of = {path: name for name, path in files.items()}
    components: dict[str, Any] = {}
    for part in system.parts.values():
        entry: dict[str, Any] = {"fmu": name_of[part.fmu]}
        if part.interface is not None:
            entry["interface"] = part.interface
        if part.start:
            entry["start"] = {variable: value for variable, (value, _) in part.start.items()}
        components[part.name] = entry
        places[("components", part.name)] = part.element
        for variable, (_, element) in part.start.items():
            places[("components", part.name, "start", variable)] = element
    connections = []
    for k, (source, target, linear, element) in enumerate(system.links):
        factors = {} if linear is None else {"factor": linear.factor, "offset": linear.offset}
        connections.append({"from": source, "to": target, **factors})
        places[("connections", k)] = element
    start, stop, step = system.start or 0.0, system.stop, system.step
    experiments, assumed = [experiment_of(part.description) for part in system.parts.values()], []
    if stop is None:
        stop = start + max((e["stop"] for e in experiments if e.get("stop", 0.0) > 0.0), default=DEFAULT_STOP_S)
        assumed.append(("duration", f"no stopTime, so the run lasts {stop - start:g} s"))
    if step is None:
        step = min((e["step"] for e in experiments if e.get("step", 0.0) > 0.0), default=DEFAULT_STEP_S)
        assumed.append(("step", f"no communication step, so {step:g} s is used"))
    warnings += [f"the SSP states {text}; to change it, use --set {k}=…" for k, text in assumed if k not in overrides]
    duration = stop - start
    if not is_whole(count := duration / step):
        duration = math.ceil(count) * step if count < 1e15 else duration
        if overrides.isdisjoint({"duration", "step"}):
            warnings.append(f"the run lasts {duration:g} s: stopTime is rounded up to whole steps of {step:g} s")
    for key in ("start_time", "duration", "step"):
        places[(key,)] = system.experiment
    scenario = {
        "name": system.name,
        "description": system.description,
        "start_time": start,
        "duration": duration,
        "step": step,
        "algorithm": ALGORITHM_OF_IMPORTERS.name,
        "components": components,
        "connections": connections,
    }
    return scenario, places
