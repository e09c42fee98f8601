"""Logs of a craft: sensor noise at rest (5.44-5.46), and a parameter from the distance covered (§5.5).

name: The craft at rest, and over 1.5 m
model: base                       # or a model.yaml, or file.py:Class
rest: {files: [rest.csv]}
distance: {parameter: friction, output: x, covered: 1.5, files: [a.csv, b.csv, c.csv]}
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from cosim.base.errors import Fault, InputError, NotExecuted, refuse
from cosim.base.registry import BASE
from cosim.loading.file import LoadedModel, load_model
from cosim.logs.log import Log, read_log
from cosim.storage.yaml_file import NotNegative, Number, Part, YamlFile, did_you_mean
from plant.identification.distance import matching_faults
from plant.identification.estimates import Estimate, Result
from plant.identification.rest_noise import rest_faults

LEAST = 3  # runs over the distance: the interval comes from the scatter between them


class RestFile(Part):
    """Logs of the craft at rest; `window` [s] of each, by default the whole log."""

    files: Annotated[list[str], Field(min_length=1)]
    window: tuple[NotNegative, NotNegative] | None = None


class DistanceFile(Part):
    """Runs over a measured distance `covered`, common or separate, in the unit of `output`."""

    files: Annotated[list[str], Field(min_length=1)]
    parameter: str
    output: str
    covered: Number | list[Number]


class CraftFile(Part):
    """Identification from logs of a craft."""

    schema_version: Literal[1] = 1
    name: str
    model: str = BASE
    rest: RestFile | None = None
    distance: DistanceFile | None = None


@dataclass(frozen=True)
class Craft:
    """The file and its logs."""

    yaml: YamlFile
    file: CraftFile
    loaded: LoadedModel
    rest: Sequence[Log] = ()
    runs: Sequence[Log] = ()

    @property
    def covered(self) -> list[float]:
        """Return the distance of each run."""
        assert self.file.distance is not None
        told = self.file.distance.covered
        return list(told) if isinstance(told, list) else [told] * len(self.runs)

    @property
    def files(self) -> list[Path]:
        """Return the files of the identification."""
        return [self.yaml.path, *(log.path for log in (*self.rest, *self.runs))]


@dataclass
class CraftOutcome:
    """Result of the identification."""

    craft: Craft
    results: list[Result] = field(default_factory=list)

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Return every estimate by test and name."""
        return {f"{r.test}.{e.name}": e for r in self.results for e in r.estimates}

    @property
    def sentences(self) -> list[str]:
        """Return one line per estimate, then notes."""
        lines = [
            f"{key} = {e.value:.5g} {e.unit} (95 % {e.low:.5g} … {e.high:.5g}; as the thesis {e.thesis:.5g})"
            for key, e in self.estimates.items()
        ]
        return [*lines, *(note for r in self.results for note in r.notes)]

    @property
    def warnings(self) -> list[str]:
        """Return the warnings about the estimates."""
        return [text for r in self.results for text in r.warnings]

    def closing(self, out: Path) -> str:
        """Return the places of the results."""
        return f"model: {out / 'model.yaml'}, numbers: {out / 'identify.json'}"


def read_craft(yaml: YamlFile) -> Craft:
    """Read the file and its logs.

    Raises:
        InputError: Every fault of the file and its logs.
    """
    content, faults = yaml.partly(CraftFile, "rest")
    if content is None:
        raise InputError(faults)
    if content.rest is None and content.distance is None:
        faults.append(yaml.fault((), "holds neither rest nor distance; add one", key=True))
    try:
        loaded = load_model(content.model, yaml.path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *error.faults]) from None
    except NotExecuted:
        if faults:
            raise InputError(faults) from None
        raise
    if content.distance is not None:
        faults += _names(yaml, content.distance, loaded)
    model = loaded.model
    rest = _logs(yaml, "rest", content.rest, lambda path: read_log(path, (), model.outputs), faults)
    runs = _logs(yaml, "distance", content.distance, lambda path: read_log(path, model.inputs, model.outputs), faults)
    if content.rest is not None and not faults:
        faults += rest_faults(yaml, rest, content.rest.window)
    if content.distance is not None and not faults:
        faults += matching_faults(model, runs)
    refuse(faults)
    return Craft(yaml, content, loaded, rest, runs)


def _logs(
    yaml: YamlFile,
    part: str,
    asked: RestFile | DistanceFile | None,
    read: Callable[[Path], Log],
    faults: list[Fault],
) -> list[Log]:
    """Return the logs of a part of the file, and extend `faults`."""
    logs, contents = list[Log](), dict[bytes, str]()
    for k, name in enumerate(asked.files if asked else ()):
        path, place = yaml.path.parent / name, (part, "files", k)
        if not path.is_file():
            faults.append(yaml.fault(place, f"no such file: {name}"))
        elif (content := path.read_bytes()) in contents:
            told = f"{name} holds what {contents[content]} does; each is a recording of its own, so leave one out"
            faults.append(yaml.fault(place, told))
        else:
            contents[content] = f"file {k + 1}, {name}"
            try:
                logs.append(read(path))
            except InputError as error:
                faults += error.faults
    return logs


def _names(yaml: YamlFile, asked: DistanceFile, loaded: LoadedModel) -> Iterator[Fault]:
    model = loaded.model
    numbers = [n for n, p in model.declared.items() if not isinstance(p.default, bool)]
    outputs = [q.name for q in model.outputs]
    if asked.parameter not in numbers:
        message = f'{model.title} has no parameter "{asked.parameter}"{did_you_mean(asked.parameter, numbers)}'
        yield yaml.fault(("distance", "parameter"), message)
    if asked.output not in outputs:
        message = f'{model.title} has no output "{asked.output}"{did_you_mean(asked.output, outputs)}'
        yield yaml.fault(("distance", "output"), message)
    if len(asked.files) < LEAST:
        message = f"{len(asked.files)} are too few: the interval comes from scatter between {LEAST} or more runs"
        yield yaml.fault(("distance", "files"), message)
    if isinstance(asked.covered, list) and len(asked.covered) != len(asked.files):
        message = f"{len(asked.covered)} distances for {len(asked.files)} files; give one each, or one for all"
        yield yaml.fault(("distance", "covered"), message)
