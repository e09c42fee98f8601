"""An SSP as a scenario: its FMUs beside a scenario.json, and the place in the SSP of each part of that."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError
from cosim.base.scratch import temporary_folder
from cosim.coupling.algorithms import Jacobi
from cosim.scenario.pinned import SYSTEM
from cosim.scenario.scenario_file import ROUNDING, ScenarioFile
from cosim.ssp.elements import Element
from cosim.ssp.flatten import read
from cosim.ssp.levels import Flat
from cosim.ssp.read import Reader
from cosim.ssp.ssp_package import Package, opened
from cosim.ssp.structure import Structure
from cosim.storage.files import check_writable, write_json
from cosim.storage.folders import keep_earlier
from cosim.storage.kinds import SSP, kind_by_form
from cosim.storage.yaml_nodes import Location
from cosim.system.system import build_system

FOLDER, SCENARIO = SYSTEM, "scenario.json"  # within that of the results
STOP, STEP = 1.0, 0.01  # [s] where neither the SSP nor its FMUs say
IMPORTERS = Jacobi()  # by which libcosim, ecos and FMPy step


def is_ssp(path: Path) -> bool:
    """Whether a file is taken for an SSP, by its name or what is in it."""
    return kind_by_form(path) == SSP


@dataclass
class Places:
    """Where in an SSP the parts of the scenario made from it stand."""

    package: Package
    whole: Element
    known: dict[Location, Element]

    def fault(self, location: Location, message: str, exit_code: int = 2) -> Fault:
        """A fault at a part of the scenario, told of the element it comes from."""
        parts = (location[:end] for end in range(len(location), 0, -1))
        element = next((self.known[part] for part in parts if part in self.known), None)
        if element is None:
            return Fault(self.package.shown, 0, 0, message, exit_code)
        return replace(element.fault(message), exit_code=exit_code)


@dataclass(frozen=True)
class Unpacked:
    """A scenario made from an SSP that is sound; `files`: name → what is to lie under it beside the scenario."""

    scenario: dict[str, Any]
    files: dict[str, Path]
    places: Places
    warnings: list[str]


@contextmanager
def unpacked(path: Path, overrides: Sequence[str] = ()) -> Iterator[Unpacked]:
    """An SSP as a scenario that has been checked, as long as the block lasts; InputError with all of its faults."""
    with opened(path) as package, temporary_folder("ssp") as made:
        reader = Reader(package)
        structure, flat = read(reader)
        files = _files(flat)
        slips = list(dict.fromkeys(package.slips))
        warnings = [*map(str, slips), *reader.warnings]
        given = frozenset(override.partition("=")[0].strip() for override in overrides)
        scenario, places = _scenario(package, structure, flat, files, (warnings, given))
        trial = made / SCENARIO
        named = {name: {**c, "fmu": str(files[c["fmu"]])} for name, c in scenario["components"].items()}
        trial.write_text(json.dumps({**scenario, "components": named}), encoding="utf-8")
        faults = list(reader.faults)
        if named:
            try:
                build_system(ScenarioFile(trial, overrides, places.fault))
            except InputError as error:
                faults += [_shown(fault, trial, package) for fault in error.faults]
        elif not faults:
            faults.append(structure.system.element.fault("it has no FMU, so there is nothing to run"))
        if faults:
            faults += slips  # which may be why
            raise InputError([_shown(fault, trial, package) for fault in faults])
        yield Unpacked(scenario, files, places, warnings)


def lay_out(
    path: Path, folder: Path, overrides: Sequence[str] = (), *, keep: bool = False
) -> tuple[ScenarioFile, list[str]]:
    """The scenario of an SSP, written with its FMUs into `folder`/system, and warnings; InputError before it is.

    keep: the files of an earlier run move to `runs` in the folder
    """
    with unpacked(path, overrides) as found:
        within = folder / FOLDER
        check_writable(within, (SCENARIO, *found.files), [path, *found.files.values()])
        if keep:
            keep_earlier(folder, "cosim run")
        for name, source in found.files.items():
            with draft_of(within / name) as draft:
                shutil.copyfile(source, draft)
        write_json(within / SCENARIO, found.scenario)
        return ScenarioFile(within / SCENARIO, overrides, found.places.fault), found.warnings


def _shown(fault: Fault, trial: Path, package: Package) -> Fault:
    """A fault without the folders in which the SSP lies unpacked."""
    if package.packed:
        fault = replace(fault, message=fault.message.replace(f"{package.folder}/", f"{package.shown}/"))
    return replace(fault, file=package.shown) if fault.file == trial else fault


def _files(flat: Flat) -> dict[str, Path]:
    """The FMUs under names of their own."""
    names: dict[str, Path] = {}
    for fmu in dict.fromkeys(part.component.fmu for part in flat.parts):
        name, number = fmu.name, 2
        while name in names:
            name, number = f"{fmu.stem}_{number}{fmu.suffix}", number + 1
        names[name] = fmu
    return names


def _scenario(
    package: Package, structure: Structure, flat: Flat, files: dict[str, Path], told: tuple[list[str], frozenset[str]]
) -> tuple[dict[str, Any], Places]:
    """The scenario, and where its parts come from."""
    places = Places(package, structure.experiment, {})
    name_of = {path: name for name, path in files.items()}
    components: dict[str, Any] = {}
    for part in flat.parts:
        entry: dict[str, Any] = {"fmu": name_of[part.component.fmu]}
        if part.component.interface is not None:
            entry["interface"] = part.component.interface
        if part.start:
            entry["start"] = {variable: value for variable, (value, _) in part.start.items()}
        components[part.name] = entry
        places.known[("components", part.name)] = part.component.element
        for variable, (_, element) in part.start.items():
            places.known[("components", part.name, "start", variable)] = element
    connections = []
    for k, link in enumerate(flat.links):
        linear = {} if link.linear is None else {"factor": link.linear.factor, "offset": link.linear.offset}
        connections.append({"from": link.source, "to": link.target, **linear})
        places.known[("connections", k)] = link.element
    start, duration, step = _times(structure, flat, *told)
    for key in ("start_time", "duration", "step"):
        places.known[(key,)] = structure.experiment
    scenario = {
        "name": structure.name,
        "description": structure.description,
        "start_time": start,
        "duration": duration,
        "step": step,
        "algorithm": IMPORTERS.name,
        "components": components,
        "connections": connections,
    }
    return scenario, places


def _times(structure: Structure, flat: Flat, warnings: list[str], given: Set[str]) -> tuple[float, float, float]:
    """Start, duration and communication step [s]; a warning for each that neither the SSP says nor is `given`."""
    experiments = [part.description.defaultExperiment for part in flat.parts]

    def said(name: str) -> list[float]:
        texts = (getattr(experiment, name, None) for experiment in experiments)
        return [value for text in texts if text is not None and (value := float(text)) > 0.0]

    start, stop, step = structure.start or 0.0, structure.stop, structure.step
    if stop is None:
        stop = start + max(said("stopTime"), default=STOP)
        if "duration" not in given:
            warnings.append(f"the SSP names no stopTime: {stop - start:g} s are run; --set duration=… for others")
    duration = stop - start
    if step is None:
        step = min(said("stepSize"), default=STEP)
        if "step" not in given:
            warnings.append(f"the SSP names no communication step: {step:g} s is taken; --set step=… for another")
    count = duration / step
    if abs(count - round(count)) > ROUNDING * max(1.0, count) or round(count) < 1:
        duration = math.ceil(count) * step if count < 1e15 else duration
        if given.isdisjoint({"duration", "step"}):
            warnings.append(f"{duration:g} s are run, the next whole number of steps of {step:g} s after stopTime")
    return start, duration, step
