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
from cosim.storage.kinds import check_given
from cosim.storage.yaml_file import NotNegative, Number, Part, YamlFile, did_you_mean
from plant.identification import messages
from plant.identification.artefacts import PROTOCOL
from plant.identification.distance import matching_faults
from plant.identification.estimates import Estimate, Result
from plant.identification.rest_noise import rest_faults

MIN_RUNS = 3  # runs over the distance: the interval comes from the scatter between them


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


def craft_file(path: Path) -> YamlFile | None:
    """Return the content of a file about craft logs, None for a protocol of a bench."""
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    return yaml if {"rest", "distance"} & set(yaml.root) and not {"cells", "tests"} & set(yaml.root) else None


def results_of(path: Path) -> str:
    """Return the name of the results of an input file: the file's key `name`, or else like the file."""
    try:
        name = YamlFile(path).root.get("name")
    except InputError:  # reported by the reader
        name = None
    return name if isinstance(name, str) else path.stem


@dataclass(frozen=True)
class CraftUnderTest:
    """A file of craft identification, the model and the logs that it names."""

    yaml: YamlFile
    file: CraftFile
    loaded: LoadedModel
    rest: Sequence[Log] = ()
    runs: Sequence[Log] = ()

    @property
    def distances(self) -> list[float]:
        """Return the measured travel distance of each run."""
        assert self.file.distance is not None
        covered = self.file.distance.covered
        return covered if isinstance(covered, list) else [covered] * len(self.runs)

    @property
    def files(self) -> list[Path]:
        """Return all files that the identification reads."""
        return [self.yaml.path, *(log.path for log in (*self.rest, *self.runs))]


@dataclass
class CraftOutcome:
    """Result of an identification from logs of a craft."""

    craft: CraftUnderTest
    results: list[Result] = field(default_factory=list)

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Return the estimates by `test.name`."""
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
        """Return a text naming the result files."""
        return f"model: {out / 'model.yaml'}, numbers: {out / 'identify.json'}"


def read_craft(yaml: YamlFile) -> CraftUnderTest:
    """Read the file and its logs.

    Raises:
        InputError: Every fault of the file and its logs.
    """
    content, faults = yaml.partly(CraftFile, "rest")
    if content.rest is None and content.distance is None:
        faults.append(yaml.fault((), messages.NEITHER_REST_NOR_DISTANCE(), key=True))
    try:
        loaded = load_model(content.model, yaml.path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *error.faults]) from None
    except NotExecuted:
        if faults:
            raise InputError(faults) from None
        raise
    if content.distance is not None:
        faults += _distance_faults(yaml, content.distance, loaded)
    model = loaded.model
    rest = _logs(yaml, "rest", content.rest, lambda path: read_log(path, (), model.outputs), faults)
    runs = _logs(yaml, "distance", content.distance, lambda path: read_log(path, model.inputs, model.outputs), faults)
    if content.rest is not None and not faults:
        faults += rest_faults(yaml, rest, content.rest.window)
    if content.distance is not None and not faults:
        faults += matching_faults(model, runs)
    refuse(faults)
    return CraftUnderTest(yaml, content, loaded, rest, runs)


def _logs(
    yaml: YamlFile,
    part: str,
    content: RestFile | DistanceFile | None,
    read: Callable[[Path], Log],
    faults: list[Fault],
) -> list[Log]:
    """Return the logs that a part of the file names; append faults to `faults`."""
    logs, names = list[Log](), dict[bytes, str]()
    for k, name in enumerate(content.files if content else ()):
        path, place = yaml.path.parent / name, (part, "files", k)
        if not path.is_file():
            faults.append(yaml.fault(place, messages.NO_LOG(name=name)))
        elif (bytes_ := path.read_bytes()) in names:
            faults.append(yaml.fault(place, messages.COPY_OF_LOG(name=name, other=names[bytes_])))
        else:
            names[bytes_] = f"file {k + 1}, {name}"
            try:
                logs.append(read(path))
            except InputError as error:
                faults += error.faults
    return logs


def _distance_faults(yaml: YamlFile, distance: DistanceFile, loaded: LoadedModel) -> Iterator[Fault]:
    title, name, output = loaded.model.title, distance.parameter, distance.output
    numbers = [n for n, p in loaded.model.declared.items() if not isinstance(p.default, bool)]
    outputs = [q.name for q in loaded.model.outputs]
    count, covered = len(distance.files), distance.covered
    if name not in numbers:
        message = messages.NO_PARAMETER(model=title, name=name, hint=did_you_mean(name, numbers))
        yield yaml.fault(("distance", "parameter"), message)
    if output not in outputs:
        message = messages.NO_OUTPUT(model=title, name=output, hint=did_you_mean(output, outputs))
        yield yaml.fault(("distance", "output"), message)
    if count < MIN_RUNS:
        yield yaml.fault(("distance", "files"), messages.TOO_FEW_RUNS(count=count, least=MIN_RUNS))
    if isinstance(covered, list) and len(covered) != count:
        message = messages.DISTANCES_UNLIKE_FILES(distances=len(covered), files=count)
        yield yaml.fault(("distance", "covered"), message)
