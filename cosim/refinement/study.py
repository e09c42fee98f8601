"""Studies: the model, the logs for estimation and the sealed logs for validation."""

from __future__ import annotations

import hashlib
import math
import os.path
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, ValidationError

from cosim.core.errors import Fault, InputError, NotExecuted, refuse
from cosim.core.messages import with_prefix
from cosim.core.registry import BASE
from cosim.core.text import counted, did_you_mean, plain
from cosim.core.units import has_unit, read_quantity
from cosim.estimation.problem import Settings
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.files.artefact import STUDY, kind_by_keys
from cosim.files.files import FilePath
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import UNIT_OF_KEY, Positive, PositiveSeconds, YamlFile
from cosim.fmi.building.file import load_model, own_terms
from cosim.fmi.building.substep import with_substep
from cosim.fmi.native.compiler import compiler, cure
from cosim.isolation.limits import Limits, read_limits
from cosim.logs.gate import gate, gate_faults
from cosim.logs.log import Log, fill_holes, read_log, rename_signals, stretches
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.probing.places import probe_places
from cosim.refinement.groups import Places, full_name, group_of, per_log_faults
from cosim.residuals.drive import log_of_fmu
from cosim.residuals.windows import SKIPPED

FMU_SUFFIX = ".fmu"
SCORED = 1.0  # [s] least scored time, beside the skipped start and one horizon
Interpolation = Literal["held", "interpolated"]
AnySubject = TypeVar("AnySubject", bound=Subject)
ROUNDING = float(np.finfo(np.float64).eps)
WIDEST = 2.0  # share of a parameter: a tolerance without information


def _check_share(value: Any) -> Any:
    """Return a valid tolerance; raise ValueError with the cure."""
    if isinstance(value, str) and has_unit(value):
        with suppress(ValueError):
            value = read_quantity(value, "1")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not ROUNDING < value <= WIDEST:
        raise ValueError(f"a tolerance is a share of the parameter, above 0 and at most {WIDEST:g}: 0.1 for 10 %")
    return value


ONE_OR_BY_NAME = Discriminator(lambda value: "«by name»" if isinstance(value, dict) else "«all»")
Share = Annotated[float, BeforeValidator(_check_share)]
FileName = Annotated[str, Field(pattern=r"^[^\x00]*$")]


class LogLists(BaseModel):
    """Log files, relative to the study.

    estimation: Logs for estimation.
    validation: Logs sealed until all decisions are made.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    estimation: list[FileName] = []
    validation: list[FileName] = []


class StudyFile(BaseModel):
    """A study: the model and its logs.

    model:      A registered name, a model.yaml, `file.py:Class`, or an FMU.
    logs:       Files, relative to the study.
    noise:      Output → standard deviation of its sensor, if different from the model's, in its unit or `2 deg`.
    start_noise: State → standard deviation of its start value in every log, without a measurement.
    tolerance:  Relative tolerance of base parameters, for all or by name.
    inputs:     Held from row to row, or interpolated, for all or by name.
    candidates: Effects, sensor errors and parameters on trial; default: all.
    columns:    Name in the logs → name in the model, if different.
    per_log:    Parameters with a separate value for each log.
    groups:     Name → logs with common values of per_log.
    limits:     Limits of each FMU call; `total` ends a search that takes longer.
    horizon:    Duration of the replays that measure errors, if different from the model's, or `free run` [s].
    terms:      File with further terms for an FMU, subclasses of `cosim.terms.Force`, `InputTerm` or `RateTerm`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = BASE
    logs: LogLists
    noise: dict[str, Annotated[Positive, UNIT_OF_KEY]] = {}
    start_noise: dict[str, Annotated[Positive, UNIT_OF_KEY]] = {}
    tolerance: Annotated[
        Annotated[Share, Tag("«all»")] | Annotated[dict[str, Share], Tag("«by name»")], ONE_OR_BY_NAME
    ] = {}
    inputs: Annotated[
        Annotated[Interpolation, Tag("«all»")] | Annotated[dict[str, Interpolation], Tag("«by name»")], ONE_OR_BY_NAME
    ] = "held"
    candidates: list[str] | None = None
    columns: dict[str, str] = {}
    per_log: list[str] | None = None
    groups: dict[str, list[FileName]] = {}
    limits: Limits | None = None
    terms: FileName = ""
    horizon: PositiveSeconds | Literal["free run"] | None = None

    def judged(self, subject: AnySubject) -> AnySubject:
        """Return a new subject with the horizon and the start values of the study."""
        subject.start_variance = {**subject.start_variance, **{n: s * s for n, s in self.start_noise.items()}}
        if self.horizon is not None:
            subject.horizon = math.inf if self.horizon == "free run" else self.horizon
        return subject


@dataclass(frozen=True)
class Study:
    """A study with its subject, its estimation logs cut at pauses, and warnings about all logs.

    Validation logs stay sealed until `unseal`; before, only their usability is checked.

    Attributes:
        path: Study file; None for a study written in Python with absolute paths.
    """

    path: Path | None
    content: StudyFile
    subject: Subject
    logs: tuple[Log, ...]
    warnings: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the files of study, model and logs."""
        logs = tuple(self.folder / name for _, name in _entries(self.content.logs))
        if self.path is None:
            return logs
        model = self.content.model.rpartition(":")[0] or self.content.model
        return self.path, self.folder / model, *logs

    @property
    def folder(self) -> Path:
        """Return the folder of relative file names."""
        return Path() if self.path is None else self.path.parent

    @property
    def name(self) -> str:
        """Return the name of the study."""
        return self.subject.title if self.path is None else self.path.resolve().parent.name

    @property
    def settings(self) -> Settings:
        """Return the settings of the logs for the fits."""
        subject, content = self.subject, self.content
        per_log = tuple(full_name(subject, n) for n in content.per_log or ())
        files = [name for _, name in _entries(content.logs)]
        groups = group_of(self.folder, files, content.groups) if per_log else {}
        ways, tolerance = content.inputs, content.tolerance
        if not isinstance(ways, dict):
            ways = {q.name: ways for q in subject.inputs}
        if not isinstance(tolerance, dict):
            base = [p.name for p in subject.parameters]
            given = [n for n in content.per_log or () if n in base]
            tolerance = dict.fromkeys((*subject.calibrated, *given), tolerance)
        interpolated = frozenset(name for name, way in ways.items() if way == "interpolated")
        return Settings(interpolated, dict(tolerance), per_log, groups)

    def unseal(self) -> tuple[Log, ...]:
        """Read the sealed logs; called once, after all decisions."""
        usable = []
        for name in self.content.logs.validation:
            log = _read(self.folder / name, self.content, self.subject)
            log = drop_outliers(log, find_spikes(log, self.subject.prediction(log)))
            usable += _usable_stretches(log, self.subject.horizon)[0]
        return tuple(usable)


def read_study(path: Path, limits: str = "") -> Study:
    """Read a study and its logs.

    Args:
        limits: Limits in place of those of the study, such as `total: 10 min`.

    Raises:
        InputError: Every fault of the study, its model and its logs.
    """
    yaml, content, faults = keys_of(path)
    if limits:
        content = content.model_copy(update={"limits": read_limits(limits)})
    if content.model.lower().endswith(FMU_SUFFIX):
        return _of_fmu(yaml, content, faults)
    if content.terms:
        message = f"terms are for an FMU, and {content.model} is none; a model lists its effects in its catalogue"
        faults.append(yaml.fault(("terms",), message, key=True))
    try:
        loaded = load_model(content.model, path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *_repeated_logs(yaml, content.logs, {}), *error.faults]) from None
    except NotExecuted:
        refuse([*faults, *_repeated_logs(yaml, content.logs, {})])
        raise
    subject = ModelSubject(loaded)
    _refuse_without_states(yaml, subject)
    content, unit_faults = _in_units(yaml, content, subject)
    subject = content.judged(subject)
    faults += [*unit_faults, *_key_faults(yaml, content, subject)]
    try:
        stepping = content.judged(ModelSubject(with_substep(loaded)[0]))
    except InputError as error:
        faults, stepping = [*faults, *error.faults], subject
    logs, warnings, log_faults = _read_logs(yaml, content, stepping)
    refuse([*faults, *log_faults])
    loaded, notes = with_substep(loaded, logs["estimation"])
    warnings += [with_prefix(f"{content.model}: ", text) for text in notes]
    return Study(path, content, content.judged(ModelSubject(loaded)), tuple(logs["estimation"]), tuple(warnings))


def keys_of(path: Path) -> tuple[YamlFile, StudyFile, list[Fault]]:
    """Return a study file, its keys without faulty parts, and the faults."""
    check_form(path, STUDY)
    yaml = YamlFile(path)
    refuse_other(path, kind_by_keys(yaml.root), STUDY)
    content, faults = yaml.partly(StudyFile, "model")
    return yaml, content, faults


def read_parts_of_fmu(
    yaml: YamlFile, content: StudyFile, faults: list[Fault]
) -> tuple[Path, list[Log], list[type[Any]]]:
    """Return the FMU, its estimation logs and the user's terms.

    Raises:
        InputError: Every fault of the study and its logs.
        FmuError: Only the FMU has faults.
    """
    folder = yaml.path.parent
    fmu = folder / content.model
    if not fmu.is_file():
        message = f"{content.model}: no such file; model names the FMU, relative to the study"
        raise InputError([*faults, yaml.fault(("model",), message)])
    logs, terms = list[Log](), list[type[Any]]()
    for part, name in _entries(content.logs):
        try:
            _check_exists(yaml, content, part, name)
            log = log_of_fmu(folder / name, fmu, content.columns, alone=False)
        except InputError as error:
            faults += error.faults
            continue
        logs += [log] if part == "estimation" else []
    if not content.logs.estimation:
        faults.append(yaml.fault(("logs", "estimation"), "no log is listed; list one"))
    if content.terms:
        try:
            terms = own_terms(folder / content.terms)
        except InputError as error:
            faults += error.faults
    refuse(faults)
    return fmu, logs, terms


def _of_fmu(yaml: YamlFile, content: StudyFile, faults: list[Fault]) -> Study:
    """Return the study of an FMU, probed along the estimation logs.

    Raises:
        InputError: Every fault of the study and its logs.
        FmuError: Only the FMU has faults.
    """
    fmu, logs, terms = read_parts_of_fmu(yaml, content, faults)
    if compiler() is None:
        raise InputError.at(fmu, f"a refinement of an FMU needs a C compiler; {cure('refine')}")
    probed = probe_places(fmu, logs)
    if probed.way == "co-simulation" and probed.own_step and probed.own_step.distorts:
        step, own = probed.structure.step, f"{probed.own_step.length:.3g} s"
        message = (
            f"{content.model} has no usable model exchange ({probed.reason}), and its co-simulation takes steps of its "
            f"own of about {own}, above the {step:.3g} s of the logs, so its results are wrong there; export it for "
            f"model exchange or with a shorter step, or record rows every {own}"
        )
        raise InputError([yaml.fault(("model",), message)])
    subject = FmuSubject.of_fmu(probed.structure, logs, terms, content.limits or Limits())
    subject.source += f", because {probed.reason}"
    names = subject.names  # in place of the FMU's variables
    update: dict[str, Any] = {}
    for key in ("noise", "start_noise", "tolerance", "inputs", "candidates"):
        setting = getattr(content, key)
        if isinstance(setting, dict):
            update[key] = {names.get(n, n): value for n, value in setting.items()}
        elif isinstance(setting, list):
            update[key] = [names.get(n, n) for n in setting]
    content, unit_faults = _in_units(yaml, content.model_copy(update=update), subject)
    subject = content.judged(subject)
    faults += [*unit_faults, *_key_faults(yaml, content, subject)]
    read, warnings, log_faults = _read_logs(yaml, content, subject)
    refuse([*faults, *log_faults])
    found = [f"{content.model}: {probed.own_step.finding}"] if probed.own_step else []
    return Study(yaml.path, content, subject, tuple(read["estimation"]), (*found, *warnings))


def _in_units(yaml: YamlFile, content: StudyFile, subject: Subject) -> tuple[StudyFile, list[Fault]]:
    """Return the study with standard deviations in the units of the subject, and faults."""
    faults = list[Fault]()
    for key, signals in (("noise", subject.outputs), ("start_noise", subject.states)):
        content, wrong = yaml.in_units(content, key, {q.name: q.unit for q in signals}, difference=True)
        faults += wrong
    return content, faults


@dataclass(frozen=True)
class _Arguments:
    """Places of faults in a study written in Python; `path` names the subject."""

    path: Path

    def fault(self, location: Sequence[str | int], message: str, *, key: bool = False) -> Fault:
        """Return a fault of an argument."""
        text = with_prefix(f"{'.'.join(map(str, location))}: ", message)
        return Fault(self.path, 0, 0, text)


def study_of(
    subject: Subject,
    logs: FilePath | Sequence[FilePath],
    validation: FilePath | Sequence[FilePath] = (),
    **settings: Any,
) -> Study:
    """Return a study of any subject with checked logs.

    Args:
        settings: Keys of a study file, such as noise={"position": 1e-3} or candidates=["coulomb_friction"].

    Raises:
        InputError: Every fault of the study and its logs.
    """
    places = _Arguments(Path(subject.title))
    lists = {
        name: [str(Path(f).absolute()) for f in ([files] if isinstance(files, (str, os.PathLike)) else files)]
        for name, files in (("estimation", logs), ("validation", validation))
    }
    try:
        content = StudyFile.model_validate({"model": subject.source, "logs": lists, **settings})
    except ValidationError as error:
        raise InputError(
            [places.fault(e["loc"], f"{e['msg']}; give a value as in a study file") for e in error.errors()]
        ) from None
    _refuse_without_states(places, subject)
    subject = content.judged(copy(subject))
    usable, warnings, log_faults = _read_logs(places, content, subject)
    refuse([*_key_faults(places, content, subject), *log_faults])
    return Study(None, content, subject, tuple(usable["estimation"]), tuple(warnings))


def _refuse_without_states(places: Places, subject: Subject) -> None:
    """Raise InputError for a model without states, whose rows over time say nothing more than any table."""
    if not subject.states:
        cure = "estimate its parameters with `cosim fit LOG --fmu FMU`, or give it the state that it lacks"
        raise InputError([places.fault(("model",), f"{subject.title} has no states, so it cannot be refined; {cure}")])


def _read_logs(
    places: Places, content: StudyFile, subject: Subject
) -> tuple[dict[str, list[Log]], list[str], list[Fault]]:
    """Return the usable stretches of the logs, warnings and faults."""
    logs: dict[str, list[Log]] = {"estimation": [], "validation": []}
    digests: dict[str, str] = {}
    warnings: list[str] = []
    faults: list[Fault] = []
    for part, name in _entries(content.logs):
        try:
            _check_exists(places, content, part, name)
            log = _read(places.path.parent / name, content, subject)
        except InputError as error:
            faults += error.faults
            continue
        content_of = hashlib.sha256(log.time.tobytes())
        for signal, values in sorted({**log.inputs, **log.outputs}.items()):
            content_of.update(signal.encode() + b"\0" + np.where(np.isnan(values), np.nan, values).tobytes())
        digests[name] = content_of.hexdigest()
        spikes = find_spikes(log, subject.prediction(log))
        findings = gate(log, subject.rate, traits=subject.traits, spikes=spikes)
        faults += gate_faults(log, findings)
        log = drop_outliers(log, spikes)
        warnings += [
            (
                f"{name}: {counted(rows.size, 'reading')} of {output} left out as outlying, far from the "
                "neighbouring readings and from the model"
            )
            for output, rows in spikes.items()
        ]
        usable, least = _usable_stretches(log, subject.horizon)
        parts = stretches(log)
        if not usable:
            longest = plain(max(float(s.time[-1] - s.time[0]) for s in parts))
            duration = f"{longest} s" if len(parts) == 1 else f"at most {longest} s without a pause"
            message = (
                f"lasts {duration}, too short to be judged: it takes {plain(least, None)} s; log longer or leave it out"
            )
            faults.append(Fault(log.path, 0, 0, message))
        warnings += [
            with_prefix(f"{name}: ", f.whole) for f in findings if f.severity == "warning" and f.kind != "outliers"
        ]
        if count := len(parts) - len(usable):
            warnings.append(f"{name}: {counted(count, 'piece')} between pauses too short to be used")
        logs[part] += usable
    faults += _repeated_logs(places, content.logs, digests)
    return logs, warnings, faults


def _entries(logs: LogLists) -> list[tuple[str, str]]:
    """Return each log with the name of its list."""
    return [*(("estimation", name) for name in logs.estimation), *(("validation", name) for name in logs.validation)]


def _check_exists(places: Places, content: StudyFile, part: str, name: str) -> None:
    """Raise InputError for a log that is missing."""
    if not os.path.exists(places.path.parent / name):
        place = ("logs", part, getattr(content.logs, part).index(name))
        message = f"{name}: no such file beside the study; its logs are named from there"
        raise InputError([places.fault(place, message)])


def _read(path: Path, content: StudyFile, subject: Subject) -> Log:
    """Read a log with the columns of the study."""
    if isinstance(subject, FmuSubject):
        log = log_of_fmu(path, subject.structure.fmu, content.columns, alone=False)
        return rename_signals(log, subject.names)
    return read_log(path, subject.inputs, subject.outputs, columns=content.columns)


def _repeated_logs(places: Places, logs: LogLists, digests: Mapping[str, str]) -> Iterator[Fault]:
    """Yield faults of files listed twice, by name or by content."""
    first: dict[str, tuple[str, str]] = {}
    for n, (part, name) in enumerate(_entries(logs)):
        path = os.path.realpath(places.path.parent / name)
        keys = [path, *([digests[name]] if name in digests else [])]
        if earlier := next((first[key] for key in keys if key in first), None):
            other, purpose = earlier
            if path in first:
                message = f"{name} is listed for {purpose} {'twice' if purpose == part else 'too'}"
            else:
                message = f"{name} holds the same as {other}, which is listed for {purpose}"
            message += "; keep one" if purpose == part else "; a validation log is never fitted on"
            yield places.fault(("logs", part, n if part == "estimation" else n - len(logs.estimation)), message)
        for key in keys:
            first.setdefault(key, (name, part))


def _usable_stretches(log: Log, horizon: float) -> tuple[list[Log], float]:
    """Return the measured stretches of sufficient duration, and that duration [s]; a slow log needs more."""
    least = (SKIPPED + SCORED) * log.slowness + (horizon if math.isfinite(horizon) else 0.0)
    parts = [s for s in stretches(log) if s.outputs and s.time[-1] - s.time[0] >= least - 0.5 * log.step]
    return [fill_holes(s) for s in parts], least


def _key_faults(places: Places, content: StudyFile, subject: Subject) -> Iterator[Fault]:
    """Yield all faults of the study's keys."""
    inputs, outputs = ([q.name for q in signals] for signals in (subject.inputs, subject.outputs))
    parameters = [p.name for p in subject.parameters if not isinstance(p.default, bool)]
    for key, names, kind in (
        ("noise", outputs, "output"),
        ("start_noise", [q.name for q in subject.states], "state"),
        ("tolerance", parameters, "base parameter"),
        ("inputs", inputs, "input"),
    ):
        setting = getattr(content, key)
        for name in setting if isinstance(setting, dict) else ():
            if name not in names:
                yield places.fault((key, name), f'no {kind} "{name}"{did_you_mean(name, names)}', key=True)
    candidates = [c.name for c in subject.candidates(inputs)]
    if content.candidates == []:
        yield places.fault(("candidates",), "names none; name some, or leave the key out to try all")
    for k, name in enumerate(content.candidates or ()):
        if name not in candidates:
            yield places.fault(("candidates", k), f'no candidate "{name}"{did_you_mean(name, candidates)}')
    logs = content.logs.model_dump()
    yield from per_log_faults(places, subject, content.per_log, content.groups, logs, content.candidates or ())
    if not content.logs.estimation:
        message = "no log is listed; list one"
        if content.logs.validation:
            message = "every log is sealed, and none is left to learn from; move one to estimation"
        yield places.fault(("logs", "estimation"), message)
