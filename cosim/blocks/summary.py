"""Summary of an FMU for people and scripts: variables, capabilities, platforms and default experiment."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, FmuError, InputError, refuse
from cosim.files.artefact import FMU
from cosim.files.kinds import check_given
from cosim.fmi.description import (
    INTERFACE_ATTRIBUTES,
    display_unit_of,
    platform_of,
    platforms_among,
    read_description,
    slips_of,
    state_names,
    unit_of,
    ways,
)


@dataclass(frozen=True)
class Variable:
    """A variable with its start value as written in the FMU.

    Attributes:
        min: Limit in the variable's unit, like `max`.
        items: Name → number of an enumeration.
    """

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
    """Overview of an FMU.

    Attributes:
        ways: Usable interfaces: co-simulation, model-exchange, scheduled-execution.
        capabilities: Interface → capability flags and numbers from the model description.
        runs_here: True if the FMU has a library for this machine. Sources (`c-code` among the platforms) can be
            compiled on request.
        experiment: Declared start, stop, step [s] and tolerance.
        states: Names of continuous states; for FMI 1.0, each variable x for which der(x) exists.
        state_count: Number of continuous states.
        slips: Violations of FMI's schema that cosim accepts.
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
        """Return variables of given causalities in file order."""
        return [v for v in self.variables if v.causality in causalities]

    def as_json(self) -> dict[str, Any]:
        """Return the summary as plain data."""
        return asdict(self)


def read_fmus(paths: Sequence[Path]) -> list[Any]:
    """Return the descriptions of FMUs; raise InputError with all faults."""
    faults: list[Fault] = []
    descriptions = []
    for path in paths:
        try:
            check_given(path, FMU)
            descriptions.append(read_description(path))
        except InputError as error:
            faults += error.faults
        except FmuError as error:
            faults.append(error.fault(path))
    refuse(faults)
    return descriptions


def summaries(paths: Sequence[Path]) -> list[Summary]:
    """Return summaries of FMUs; InputError lists all faults."""
    return [summary_of(path, description) for path, description in zip(paths, read_fmus(paths), strict=True)]


def summary_of(path: Path, description: Any) -> Summary:
    """Return the summary of an FMU from its path and FMPy's model description."""
    platforms = platforms_of(path)
    capabilities: dict[str, dict[str, Any]] = {}
    for way, attribute in INTERFACE_ATTRIBUTES.items():
        if (part := getattr(description, attribute, None)) is not None:
            values = {field.name: getattr(part, field.name) for field in type(part).__attrs_attrs__}
            is_set = {name: value for name, value in values.items() if value and isinstance(value, (bool, int, float))}
            capabilities[way] = is_set
    return Summary(
        file=str(path),
        name=description.modelName or path.stem,
        fmi_version=description.fmiVersion,
        tool=description.generationTool or "",
        description=" ".join((description.description or "").split()),
        ways=list(ways(description)),
        capabilities=capabilities,
        platforms=platforms,
        runs_here=platform_of(description) in platforms,
        experiment=experiment_of(description),
        states=state_names(description),
        variables=[_variable(v) for v in description.modelVariables],
        slips=[" ".join(str(s).split()) for s in slips_of(description)],
        state_count=int(description.numberOfContinuousStates or 0),
    )


def experiment_of(description: Any) -> dict[str, float]:
    """Return the declared numbers of the default experiment: start, stop, step [s] and tolerance, if present."""
    attributes = {"start": "startTime", "stop": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
    numbers = {}
    for key, attribute in attributes.items():
        with suppress(AttributeError, TypeError, ValueError):
            numbers[key] = float(getattr(description.defaultExperiment, attribute))
    return numbers


def platforms_of(path: Path) -> list[str]:
    """Return the platforms for which an FMU has a library, and `c-code` if it has sources."""
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
        display_unit=display_unit_of(v),
        start=_text(v.start),
        min=_text(getattr(declared, "min", None) if v.min is None else v.min),
        max=_text(getattr(declared, "max", None) if v.max is None else v.max),
        description=" ".join((v.description or "").split()),
        dimensions=list(v.shape or ()),
        items={i.name: int(i.value) for i in declared.items or ()} if is_enumeration else {},
    )


def _text(value: Any) -> str | None:
    return None if value is None else str(value)
