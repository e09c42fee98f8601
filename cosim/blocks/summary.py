"""What an FMU says of itself, for people and for scripts: variables, capabilities, platforms, default experiment."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, FmuError, InputError, refuse
from cosim.blocks.description import (
    platform_of,
    platforms_among,
    read_description,
    slips_of,
    state_names,
    unit_of,
    ways,
)
from cosim.storage.kinds import FMU, check_given


@dataclass(frozen=True)
class Variable:
    """One variable: start as the FMU writes it, limits in its unit, `items` of an enumeration."""

    name: str
    causality: str
    variability: str
    type: str
    unit: str = ""
    display_unit: str = ""
    start: str | None = None
    min: str | None = None
    max: str | None = None
    description: str = ""
    dimensions: list[int] = field(default_factory=list)
    items: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Summary:
    """An FMU at a glance.

    ways:         co-simulation, model-exchange: as it can be run here
    capabilities: way → the flags and numbers of FMI that it sets
    runs_here:    it has a library for this machine; sources (`c-code` among the platforms) make one, where asked for
    experiment:   start, stop, step [s] and tolerance, of those that it declares
    states:       names of its continuous states; of FMI 1.0, which tells them at run time only, those with a der(…)
    state_count:  number of its continuous states
    slips:        where its description breaks FMI's schema and runs all the same
    """

    file: str
    name: str
    fmi_version: str
    tool: str
    description: str
    ways: list[str]
    capabilities: dict[str, dict[str, Any]]
    platforms: list[str]
    runs_here: bool
    experiment: dict[str, float]
    states: list[str]
    variables: list[Variable]
    slips: list[str]
    state_count: int

    def of(self, *causalities: str) -> list[Variable]:
        """Variables of these causalities, in the order of the file."""
        return [v for v in self.variables if v.causality in causalities]

    def as_json(self) -> dict[str, Any]:
        """Everything, as plain data."""
        return asdict(self)


def read_fmus(paths: Sequence[Path]) -> list[Any]:
    """Descriptions of FMUs; InputError with what is wrong with every one of them."""
    faults: list[Fault] = []
    found = []
    for path in paths:
        try:
            check_given(path, FMU)
            found.append(read_description(path))
        except InputError as error:
            faults += error.faults
        except FmuError as error:
            faults.append(Fault(path, 0, 0, str(error).removeprefix(f"{path} "), FmuError.exit_code))
    refuse(faults)
    return found


def summaries(paths: Sequence[Path]) -> list[Summary]:
    """What FMUs say of themselves; InputError with what is wrong with every one of them."""
    return [summary_of(path, description) for path, description in zip(paths, read_fmus(paths), strict=True)]


def summary_of(path: Path, description: Any) -> Summary:
    """What an FMU says of itself, of its description."""
    return Summary(
        file=str(path),
        name=description.modelName or path.stem,
        fmi_version=description.fmiVersion,
        tool=description.generationTool or "",
        description=" ".join((description.description or "").split()),
        ways=list(ways(description)),
        capabilities=_capabilities(description),
        platforms=platforms_of(path),
        runs_here=platform_of(description) in platforms_of(path),
        experiment=experiment_of(description),
        states=state_names(description),
        variables=[_variable(v) for v in description.modelVariables],
        slips=[" ".join(str(s).split()) for s in slips_of(description)],
        state_count=int(description.numberOfContinuousStates or 0),
    )


def experiment_of(description: Any) -> dict[str, float]:
    """start, stop, step [s] and tolerance of the default experiment, those that are declared and numbers."""
    named = {"start": "startTime", "stop": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
    found = {}
    for key, attribute in named.items():
        try:
            found[key] = float(getattr(description.defaultExperiment, attribute))
        except (AttributeError, TypeError, ValueError):
            continue
    return found


def _capabilities(description: Any) -> dict[str, dict[str, Any]]:
    """Return the flags and numbers of each way that are set, by FMI's names."""
    parts = {"co-simulation": description.coSimulation, "model-exchange": description.modelExchange}
    return {way: _flags(part) for way, part in parts.items() if part is not None}


def _flags(part: Any) -> dict[str, Any]:
    values = {field.name: getattr(part, field.name) for field in type(part).__attrs_attrs__}
    return {name: value for name, value in values.items() if value and isinstance(value, (bool, int, float))}


def platforms_of(path: Path) -> list[str]:
    """Platforms with a library; `c-code` where the sources are there too."""
    with zipfile.ZipFile(path) as archive:
        return platforms_among(archive.namelist())


def _variable(v: Any) -> Variable:
    declared = v.declaredType
    is_enumeration = v.type == "Enumeration" and declared
    return Variable(
        name=v.name,
        causality=v.causality or "local",
        variability=v.variability or "continuous",
        type=v.type,
        unit=unit_of(v),
        display_unit=v.displayUnit or getattr(declared, "displayUnit", None) or "",
        start=_text(v.start),
        min=_text(getattr(declared, "min", None) if v.min is None else v.min),
        max=_text(getattr(declared, "max", None) if v.max is None else v.max),
        description=" ".join((v.description or "").split()),
        dimensions=list(v.shape or ()),
        items={i.name: int(i.value) for i in declared.items or ()} if is_enumeration else {},
    )


def _text(value: Any) -> str | None:
    return None if value is None else str(value)
