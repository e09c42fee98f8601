"""A study: which model, which logs to learn from, which to be judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cosim.errors import Fault, InputError
from cosim.refine.gate import gate, gate_faults
from cosim.refine.log import Log, read_log
from cosim.refine.model_file import BASE, LoadedModel, load_model
from cosim.yaml_file import YamlFile, did_you_mean

Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]


class LogLists(BaseModel):
    """Files, relative to the study."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    estimation: list[str] = Field(min_length=1)
    validation: list[str] = []


class StudyFile(BaseModel):
    """study.yaml. `noise`: standard deviation of a measured output where it is not the model's own."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = BASE
    logs: LogLists
    noise: dict[str, Positive] = {}
    candidates: list[str] | None = None


@dataclass(frozen=True)
class Study:
    """A study that is read: the model and the estimation logs. Validation logs stay sealed until `unseal`."""

    path: Path
    content: StudyFile
    loaded: LoadedModel
    logs: tuple[Log, ...]

    def unseal(self) -> tuple[Log, ...]:
        """Read the validation logs; called once, when everything is decided."""
        return tuple(self._read(name) for name in self.content.logs.validation)

    def _read(self, name: str) -> Log:
        return read_log(self.path.parent / name, self.loaded.model.inputs, self.loaded.model.outputs)


def read_study(path: Path) -> Study:
    """Read a study and its estimation logs; InputError with every fault of all of them."""
    yaml = YamlFile(path)
    content = yaml.validate(StudyFile)
    faults = _listed_twice(yaml, content)
    for name in content.logs.validation:
        if not (path.parent / name).is_file():
            place = ("logs", "validation", content.logs.validation.index(name))
            faults.append(yaml.fault(place, f"no such log: {path.parent / name}"))
    try:
        loaded = load_model(content.model, path.parent)
    except InputError as error:
        raise InputError([*faults, *error.faults]) from None
    faults += _unknown_names(yaml, content, loaded)
    logs = []
    for name in content.logs.estimation:
        try:
            log = read_log(path.parent / name, loaded.model.inputs, loaded.model.outputs)
        except InputError as error:
            faults += error.faults
        else:
            faults += gate_faults(log, gate(log, loaded.model.rate))
            logs.append(log)
    if faults:
        raise InputError(faults)
    return Study(path, content, loaded, tuple(logs))


def _listed_twice(yaml: YamlFile, content: StudyFile) -> list[Fault]:
    estimation = {Path(name).as_posix() for name in content.logs.estimation}
    return [
        yaml.fault(
            ("logs", "validation", k), f"{name} is listed for estimation too; a validation log is never fitted on"
        )
        for k, name in enumerate(content.logs.validation)
        if Path(name).as_posix() in estimation
    ]


def _unknown_names(yaml: YamlFile, content: StudyFile, loaded: LoadedModel) -> list[Fault]:
    outputs = [q.name for q in loaded.model.outputs]
    faults = [
        yaml.fault(("noise", name), f'no output "{name}"{did_you_mean(name, outputs)}', key=True)
        for name in content.noise
        if name not in outputs
    ]
    known = candidate_names(loaded)
    for k, name in enumerate(content.candidates or ()):
        if name not in known:
            faults.append(yaml.fault(("candidates", k), f'no candidate "{name}"{did_you_mean(name, known)}'))
    return faults


def candidate_names(loaded: LoadedModel) -> Sequence[str]:
    """Everything a study may put on trial."""
    model = loaded.model
    return [*(k.name for k in (*model.catalogue, *model.sensors)), *model.calibrated, *model.suspect]
