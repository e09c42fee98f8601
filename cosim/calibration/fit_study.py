"""The request of a fit, from options or a study file, and the parameters to estimate."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from cosim.core.errors import Fault, InputError, refuse
from cosim.core.settings import Given, texts
from cosim.core.text import did_you_mean, split_assignment
from cosim.core.units import split_quantity
from cosim.files.artefact import FIT_STUDY, LOG, STUDY
from cosim.files.files import FilePath
from cosim.files.kinds import check_given
from cosim.files.kinds import kind_of as kind_of_file
from cosim.files.yaml_file import YamlFile, short
from cosim.fmi.description import read_description, unit_of
from cosim.fmi.fmi_types import FLOAT_TYPES
from cosim.isolation.limits import Limits, read_limits
from cosim.logs.log import NORMAL_95, Log, read_column_names
from cosim.probing.prober import limits_of
from cosim.refinement.study import FileName, LogLists
from cosim.residuals.drive import log_of_fmu, start_values
from cosim.scenario.start_values import convert_value, settable

NOT_VARIED = '--vary "{text}" must have the form NAME, NAME=20% or NAME=LOW..HIGH, such as mass=0.3..2'

FREE = {"", "free", "null"}  # values of NAME=… that are equivalent to NAME alone
MAX_OFFERED_NAMES = 8  # names in a message


class FitStudyFile(BaseModel):
    """A study of `cosim fit`: an FMU, its logs, and what to estimate.

    model:   FMU whose parameters are estimated.
    logs:    Files, relative to the study; those of `validation` are sealed until all decisions are made.
    vary:    Names; or name → bounds `0.3..2 kg`, prior `20%`, or nothing. Default: parameters that the logs determine.
    start:   Name → value of another variable of the FMU, or first value of an estimated parameter.
    per_log: Parameters with a separate value for each log, such as a load that changes between logs.
    profile: Parameters for which the profile likelihood is computed, for asymmetric intervals.
    columns: Name in the logs → name in the FMU, if different.
    limits:  Limits of time and memory for the FMU; `total` limits the estimation.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: FileName
    logs: LogLists
    vary: list[str] | dict[str, str | float | tuple[float, float] | None] = []
    start: dict[str, float | int | bool | str] = {}
    per_log: list[str] = []
    profile: list[str] = []
    columns: dict[str, str] = {}
    limits: Limits | None = None


@dataclass(frozen=True)
class Request:
    """A request to fit an FMU.

    Attributes:
        vary: Parameters as NAME, NAME=20% or NAME=LOW..HIGH; empty: parameters that the logs determine.
        start: Values as NAME=VALUE; for a varied parameter, its first value.
        per_log: Parameters with a separate value for each log.
        profile: Parameters for which the profile likelihood is computed.
        columns: Log column → variable.
        yaml: Study file of the request; None for options.
    """

    fmu: Path
    estimation: Sequence[Path]
    sealed: Sequence[Path] = ()
    vary: Sequence[str] = ()
    start: Sequence[str] = ()
    per_log: Sequence[str] = ()
    profile: Sequence[str] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    yaml: YamlFile | None = None

    @property
    def logs(self) -> list[Path]:
        """Return all logs, sealed ones last."""
        return [*self.estimation, *self.sealed]

    def fault(self, place: Sequence[str | int], message: str, file: Path | None = None) -> Fault:
        """Return a fault of a key of the study.

        Without a study, the fault concerns a file, or the option with the name of the key.
        """
        if self.yaml is None:
            return Fault(file or Path(f"--{place[0]}"), 0, 0, message)
        return self.yaml.fault(tuple(place), message, key=place[0] == "vary")

    def log_fault(self, index: int, message: str) -> Fault:
        """Return a fault of the name of a log."""
        part, first = ("estimation", 0) if index < len(self.estimation) else ("validation", len(self.estimation))
        return self.fault(("logs", part, index - first), message, self.logs[index])


def request_of(
    logs: Sequence[FilePath],
    fmu: FilePath | None,
    *,
    vary: Sequence[str] = (),
    start: Sequence[str] = (),
    sealed: Sequence[FilePath] = (),
    per_log: Sequence[str] = (),
    profile: Sequence[str] = (),
    columns: Given | None = None,
    limits: str = "",
) -> Request:
    """Return the request from the options of `fit`, or from the study that replaces the logs.

    Raises:
        InputError: Options do not fit together, or the study has faults.
    """
    most, path = read_limits(limits), Path(logs[0]) if logs else Path("LOG")
    kind = kind_of_file(path) if len(logs) == 1 else None
    if kind not in {STUDY, FIT_STUDY}:
        names = read_column_names(columns, path)
        if fmu is None:
            for log in logs:
                check_given(Path(log), LOG, STUDY, FIT_STUDY)
            raise InputError.at(Path("--fmu"), "no FMU is given; add --fmu X.fmu, or give a study file alone")
        return Request(Path(fmu), [*map(Path, logs)], [*map(Path, sealed)], vary, start, per_log, profile, names, most)
    if fmu is not None or sealed or columns:
        message = f"is {kind}, which names its FMU, logs and columns; give it without --fmu, --sealed"
        raise InputError.at(path, f"{message} and --column")
    yaml = YamlFile(path)
    # distinguishes a study of `cosim refine`, which has further keys
    root = {k: v for k, v in yaml.root.items() if kind != STUDY or k in FitStudyFile.model_fields}
    content = yaml.validate(FitStudyFile, root)
    if not content.model.lower().endswith(".fmu"):
        message = f"{content.model} is not an FMU; `cosim fit` needs an FMU, `cosim refine` estimates the parameters"
        refuse([yaml.fault(("model",), f"{message} of a model file")])
    return Request(
        path.parent / content.model,
        [path.parent / name for name in content.logs.estimation],
        [path.parent / name for name in content.logs.validation],
        vary or texts(content.vary),
        [*texts(content.start), *start],
        per_log or content.per_log,
        profile or content.profile,
        content.columns,
        most if limits else content.limits or Limits(),
        yaml,
    )


# -- what to estimate -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Parameter:
    """A parameter or start value to estimate.

    Attributes:
        start: Value before the estimate.
        low, high: Bounds; infinite if there are none.
        tolerance: Half-width of the 95 % interval of a normal prior around `start`; None without a prior.
        is_start: True for the start value of a state.
        per_log: True if a value is estimated for each log: for start values, and parameters that the user has named.
        log: Index of the log of a start value; None for a parameter that all logs share.
        spread: Typical size of a start value that equals an output; 0 for values that the user has named.
    """

    name: str
    unit: str
    start: float
    low: float = -math.inf
    high: float = math.inf
    tolerance: float | None = None
    is_start: bool = False
    per_log: bool = False
    log: int | None = None
    spread: float = 0.0

    @property
    def scale(self) -> float:
        """Return the typical size of the parameter: its value, or a tenth of its range if the value is zero."""
        width = 0.1 * (self.high - self.low)
        return self.spread or abs(self.start) or (width if math.isfinite(width) else 1.0)

    @property
    def sigma(self) -> float:
        """Return the prior's standard deviation, infinite without one."""
        return math.inf if self.tolerance is None else self.tolerance / NORMAL_95


class FitInput(NamedTuple):
    """Logs, parameters to estimate, values of `--start`, and those values that are not estimated."""

    logs: list[Log]
    parameters: list[Parameter]
    given: Mapping[str, Any]
    fixed: Mapping[str, Any]


def read_input(request: Request) -> FitInput:
    """Return the logs of a request, the parameters to estimate, and the values of `--start`.

    Raises:
        InputError: Logs or arguments have faults; the error names all of them.
        FmuError: Only the FMU has faults.
    """
    fmu, paths, yaml, faults = request.fmu, request.logs, request.yaml, list[Fault]()

    def attempt(function: Callable[..., Any], default: Any, *arguments: Any, **more: Any) -> Any:
        try:
            return function(*arguments, **more)
        except InputError as error:
            faults.extend(error.faults)
            return default

    if yaml is not None:
        beside = "does not exist; file names are relative to the study"
        if not fmu.is_file():
            faults.append(yaml.fault(("model",), f"{yaml.root['model']} {beside}"))
        faults += [request.log_fault(k, f"{p.name} {beside}") for k, p in enumerate(paths) if not p.exists()]
    existing = [p for p in paths if not faults or p.exists()]
    if not request.estimation:
        message = "has no log for the estimate; give at least one"
        faults.append(request.fault(("logs",), message, Path("LOG")))
    twice = "is given twice; use a log either for the estimate or as a sealed log"
    faults += [request.log_fault(k, twice) for k, p in enumerate(paths) if p in paths[:k]]
    refuse(faults if not existing or (yaml is not None and not fmu.exists()) else ())
    alone = len(existing) == 1
    logs = [attempt(log_of_fmu, None, path, fmu, request.columns, alone=alone) for path in existing]
    refuse(faults if any(f.file == fmu for f in faults) or not any(logs) else ())
    given = attempt(start_values, {}, fmu, request.start, lambda n, text: request.fault(("start", n), text))
    parameters: list[Parameter] = attempt(_parameters, [], request, read_description(fmu), given)
    varied = {p.name for p in parameters}
    for k, name in enumerate(request.profile if parameters else ()):
        if name not in {p.name for p in parameters if not p.per_log}:
            message = f"{name} is not estimated for all logs{did_you_mean(name, varied)}"
            faults.append(request.fault(("profile", k), f"{message}; add it to --vary"))
    refuse(faults)
    return FitInput(logs, parameters, given, {n: v for n, v in given.items() if n not in varied})


def _parameters(request: Request, description: Any, given: Mapping[str, Any]) -> list[Parameter]:
    """Return the parameters to estimate: those named in the request, or all.

    Candidates are scalar real parameters, and states with a settable start value; parameters come first, in the order
    of the FMU.

    Raises:
        InputError: Names have faults (the error names all of them), or there is no parameter.
    """
    names, offered = {v.name for v in description.modelVariables}, dict[str, Parameter]()
    for v in description.modelVariables:
        is_parameter = "parameter" in (v.causality, v.variability)  # in FMI 1.0
        is_state = v.causality in {"local", "internal", "output", None}
        if v.type in FLOAT_TYPES and not v.shape and v.start is not None and settable(v) and (is_parameter or is_state):
            first = float(given.get(v.name, v.start))
            # an FMU of cosim or pythonfmu sets the start value of x by a parameter x_start
            is_start = not is_parameter or v.name.removesuffix("_start") in names - {v.name}
            offered[v.name] = Parameter(v.name, unit_of(v), first, *limits_of(v), is_start=is_start, per_log=is_start)
    offered = dict(sorted(offered.items(), key=lambda item: item[1].is_start))
    own = _named(request, "per_log", description, offered)
    chosen = _named(request, "vary", description, offered)
    if not request.vary:
        every = {n: p for n, p in offered.items() if not p.is_start and n not in given}
        chosen = {n: p for n, p in every.items() if p.low <= p.start <= p.high}
        if not chosen:
            message = "has no parameter to estimate: no floating-point parameter with a start value may be set"
            raise InputError.at(request.fmu, f"{message} before a run")
    return [replace(p, per_log=p.per_log or n in own) for n, p in {**own, **chosen}.items()]


def _named(request: Request, key: str, description: Any, offered: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Return the parameters that a key of the request names: `mass`, `mass=20%` or `mass=0.3..2 kg`.

    Raises:
        InputError: Texts have faults; the error names all of them.
    """
    variables, faults = {v.name: v for v in description.modelVariables}, list[Fault]()
    chosen: dict[str, Parameter] = {}
    for text in getattr(request, key):
        name, _, value = split_assignment(text, variables)
        with suppress(ValueError):  # a value from Python: a pair is a range, None is an absent bound
            read = json.loads(value)
            is_pair = isinstance(read, list) and len(read) == 2
            value = f"{read[0]}..{read[1]}" if is_pair else "" if read is None else str(read)
        try:
            if not name:
                raise ValueError(NOT_VARIED.format(text=short(text)))
            if name not in offered:
                names = [n for n, p in offered.items() if not p.is_start][:MAX_OFFERED_NAMES]
                cure = f"name a floating-point parameter, or the start value of a state ({', '.join(names) or 'none'})"
                raise ValueError(f"{name} cannot be estimated{did_you_mean(name, offered)}; {cure}")
            if name in chosen:
                raise ValueError(f"{name} is named twice; name it once")
            chosen[name] = p = _bounded(description, variables[name], offered[name], value)
            if not p.low <= p.start <= p.high:
                outside = f"the start value {p.start:g} of {name} is outside {p.low:g} to {p.high:g}"
                raise ValueError(f"{outside}; give another --start {name}=VALUE")
        except ValueError as error:
            faults.append(request.fault((key, name) if key == "vary" else (key,), error.args[0]))
    refuse(faults)
    return chosen


def _bounded(description: Any, variable: Any, parameter: Parameter, text: str) -> Parameter:
    """Return a parameter with the bounds or prior in a text."""
    name, sides = parameter.name, [split_quantity(side) for side in text.split("..")]
    if text in FREE:
        return parameter
    match sides:
        case [(share, "%")] if 0.0 < share < math.inf and parameter.start != 0.0:
            return replace(parameter, tolerance=share / 100.0 * abs(parameter.start))
        case [(_, "%")]:
            raise ValueError(
                f"{name}: {short(text)} is no tolerance; give a percentage above 0 of a start value, or a range"
            )
        case [(first, first_unit), (second, unit)]:
            ends = (first, first_unit or unit), (second, unit)
        case _:
            raise ValueError(NOT_VARIED.format(text=short(f"{name}={text}")))
    try:
        low, high = (float(convert_value(description, variable, f"{v!r} {u}" if u else v)) for v, u in ends)
    except ValueError as error:
        raise ValueError(f"{name}: {short(text)} is not allowed: {error}") from None
    if not low < high:
        raise ValueError(f"{name}: {low:g} is not below {high:g}; give LOW..HIGH with LOW below HIGH")
    return replace(parameter, low=max(low, parameter.low), high=min(high, parameter.high))
