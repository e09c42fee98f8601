"""A request to fit an FMU: from options, or from a study file, with the place of each of its parts."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cosim.core.errors import Fault, InputError, refuse
from cosim.files.artefact import FIT_STUDY, LOG, STUDY
from cosim.files.files import FilePath
from cosim.files.kinds import check_given, kind_of
from cosim.files.yaml_file import YamlFile
from cosim.isolation.limits import Limits, read_limits
from cosim.refinement.study import FileName, LogLists


class FitStudyFile(BaseModel):
    """A study of `cosim fit`: an FMU, its logs, and what to estimate.

    model:   FMU whose parameters are estimated.
    logs:    Files, relative to the study; those of `validation` are sealed until all decisions are made.
    vary:    Names, or name → bounds `0.3..2 kg`, prior `20%`, or nothing; default: what the logs determine.
    start:   Name → further value of the FMU, or first value of an estimated parameter.
    columns: Name in the logs → name in the FMU, if different.
    limits:  Limits of the FMU; `total` limits the estimate.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: FileName
    logs: LogLists
    vary: list[str] | dict[str, str | float | tuple[float, float] | None] = []
    start: dict[str, float | int | bool | str] = {}
    columns: dict[str, str] = {}
    limits: Limits | None = None


@dataclass(frozen=True)
class Request:
    """A request to fit an FMU.

    Attributes:
        vary: Parameters as NAME, NAME=20% or NAME=LOW..HIGH; none: those that the logs determine.
        start: Further values as NAME=VALUE; of a varied parameter: its first value.
        columns: Log column → variable, or COLUMN=VARIABLE texts.
        yaml: Study file of the request; None for options.
        unused: Keys of a study of `cosim refine` that a fit does not use.
    """

    fmu: Path
    estimation: Sequence[Path]
    sealed: Sequence[Path] = ()
    vary: Sequence[str] = ()
    start: Sequence[str] = ()
    columns: Sequence[str] | Mapping[str, str] = ()
    limits: Limits = field(default_factory=Limits)
    yaml: YamlFile | None = None
    unused: Sequence[str] = ()

    @property
    def logs(self) -> list[Path]:
        """Return all logs, sealed ones last."""
        return [*self.estimation, *self.sealed]

    def fault(self, place: Sequence[str | int], message: str, option: Path) -> Fault:
        """Return a fault of a key of the study; without a study, of an option or file."""
        if self.yaml is None:
            return Fault(option, 0, 0, message)
        return self.yaml.fault(tuple(place), message, key=place[0] == "vary")

    def log_fault(self, index: int, message: str) -> Fault:
        """Return a fault of a log's name."""
        part, first = ("estimation", 0) if index < len(self.estimation) else ("validation", len(self.estimation))
        return self.fault(("logs", part, index - first), message, self.logs[index])


def request_of(
    logs: Sequence[FilePath],
    fmu: FilePath | None,
    *,
    vary: Sequence[str] = (),
    start: Sequence[str] = (),
    sealed: Sequence[FilePath] = (),
    columns: Sequence[str] = (),
    limits: str = "",
) -> Request:
    """Return the request of options or of the study that is named in place of logs.

    Args:
        vary: Parameters as NAME, NAME=20% or NAME=LOW..HIGH; none: those of the study, or those that logs determine.
        start: Further values as NAME=VALUE; of a varied parameter: its first value.
        sealed: Logs for the proof.
        columns: Log columns with other names than in the FMU, `measured_speed=motor.w`.
        limits: Limits of the FMU; `total` limits the estimate.

    Raises:
        InputError: Options do not fit together, or the study has faults.
    """
    most = read_limits(limits)
    kind = kind_of(Path(logs[0])) if len(logs) == 1 else None
    if kind not in {STUDY, FIT_STUDY}:
        if fmu is None:
            for log in logs:
                check_given(Path(log), LOG, STUDY, FIT_STUDY)
            raise InputError.at(Path("--fmu"), "no FMU is named; add --fmu X.fmu, or give a study file alone")
        return Request(Path(fmu), [*map(Path, logs)], [*map(Path, sealed)], vary, start, columns, most)
    if fmu is not None or sealed or columns:
        message = f"is {kind}, which names its FMU, logs and columns; `cosim fit` takes it without --fmu, --sealed"
        raise InputError.at(Path(logs[0]), f"{message} and --column")
    path = Path(logs[0])
    yaml = YamlFile(path)
    unused = tuple(k for k in yaml.root if kind == STUDY and k not in FitStudyFile.model_fields)
    content = yaml.validate(FitStudyFile, {k: v for k, v in yaml.root.items() if k not in unused})
    if not content.model.lower().endswith(".fmu"):
        message = f"{content.model} is no FMU, and `cosim fit` needs one; `cosim refine` estimates the parameters"
        refuse([yaml.fault(("model",), f"{message} of a model file")])
    named = content.vary
    first = [f"{n}={str(v).lower() if isinstance(v, bool) else v}" for n, v in content.start.items()]
    return Request(
        _beside(path, content.model),
        [_beside(path, name) for name in content.logs.estimation],
        [_beside(path, name) for name in content.logs.validation],
        vary or ([f"{n}={json.dumps(v)}" for n, v in named.items()] if isinstance(named, dict) else named),
        [*first, *start],
        content.columns,
        most if limits else content.limits or Limits(),
        yaml,
        unused,
    )


def _beside(study: Path, name: str) -> Path:
    """Return a file that a study names, without steps out of its folder and back: `a.csv`, not `x/../a.csv`."""
    path = study.parent / name
    plain = Path(os.path.normpath(path))
    return plain if path.exists() and plain.exists() and plain.samefile(path) else path  # links may lead elsewhere
