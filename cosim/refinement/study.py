"""Studies: the model, the logs for estimation and the sealed logs for validation."""

from __future__ import annotations

import math
import os.path
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, ValidationError

from cosim.core.errors import Fault, InputError, NotExecuted, refuse
from cosim.core.messages import Note, with_prefix
from cosim.core.registry import BASE
from cosim.core.text import counted, did_you_mean, join_names, plain
from cosim.core.units import has_unit, read_quantity
from cosim.estimation.problem import Settings
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.files.artefact import STUDY, Checking, kind_by_keys, skipped_files
from cosim.files.files import FilePath
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import UNIT_OF_KEY, Positive, PositiveSeconds, YamlFile
from cosim.fmi.building.declared import MAX_TOLERANCE
from cosim.fmi.building.file import load_model, own_terms
from cosim.fmi.building.substep import with_substep
from cosim.fmi.native.compiler import compiler, cure
from cosim.isolation.limits import Limits, read_limits
from cosim.logs.gate import gate, gate_faults
from cosim.logs.log import Log, fill_holes, read_log, rename_signals, stretches
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.probing.places import probe_places
from cosim.residuals.drive import log_of_fmu
from cosim.residuals.windows import SKIPPED
from cosim.terms.language import with_place

FMU_SUFFIX = ".fmu"
SCORED = 1.0  # [s] least time of a log that counts, in addition to the skipped start and one horizon
Interpolation = Literal["held", "interpolated"]
AnySubject = TypeVar("AnySubject", bound=Subject)
Setting = TypeVar("Setting")
MIN_TOLERANCE = float(np.finfo(np.float64).eps)


def _check_share(value: Any) -> Any:
    """Return a tolerance if it is valid; raise ValueError with the cure if not."""
    if isinstance(value, str) and has_unit(value):
        with suppress(ValueError):
            value = read_quantity(value, "1")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not MIN_TOLERANCE < value <= MAX_TOLERANCE:
        raise ValueError(
            f"a tolerance is a share of the parameter, above 0 and at most {MAX_TOLERANCE:g}: 0.1 for 10 %"
        )
    return value


OneOrByName = Annotated[
    Annotated[Setting, Tag("«all»")] | Annotated[dict[str, Setting], Tag("«by name»")],
    Discriminator(lambda value: "«by name»" if isinstance(value, dict) else "«all»"),
]
Share = Annotated[float, BeforeValidator(_check_share)]
FileName = Annotated[str, Field(pattern=r"^[^\x00]*$")]


@dataclass(frozen=True)
class Arguments:
    """Names of arguments as places of faults, for a study written in Python; `path` names the subject."""

    path: Path

    def fault(self, location: Sequence[str | int], message: str, *, key: bool = False) -> Fault:
        """Return a fault of an argument."""
        return Fault(self.path, 0, 0, with_prefix(f"{'.'.join(map(str, location))}: ", message))


Places = YamlFile | Arguments  # gives faults in a study's keys their places


class LogLists(BaseModel):
    """Log files, relative to the study.

    estimation: Logs for estimation.
    validation: Sealed logs, which are opened after all decisions.
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
    tolerance: OneOrByName[Share] = {}
    inputs: OneOrByName[Interpolation] = "held"
    candidates: list[str] | None = None
    columns: dict[str, str] = {}
    per_log: list[str] | None = None
    groups: dict[str, list[FileName]] = {}
    limits: Limits | None = None
    terms: FileName = ""
    horizon: PositiveSeconds | Literal["free run"] | None = None

    def judged(self, subject: AnySubject) -> AnySubject:
        """Return a subject with the horizon and the start noise of the study."""
        subject.start_variance = {**subject.start_variance, **{n: s * s for n, s in self.start_noise.items()}}
        if self.horizon is not None:
            subject.horizon = math.inf if self.horizon == "free run" else self.horizon
        return subject


@dataclass(frozen=True)
class Study:
    """A study with its subject, its estimation logs cut at pauses, and warnings about all logs.

    Validation logs stay sealed until `unseal`; before that, only their usability is checked.

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
        logs = tuple(self.folder / name for *_, name in _entries(self.content.logs))
        if self.path is None:
            return logs
        model = self.content.model.rpartition(":")[0] or self.content.model
        return self.path, self.folder / model, *logs

    @property
    def folder(self) -> Path:
        """Return the folder to which relative file names refer."""
        return Path() if self.path is None else self.path.parent

    @property
    def name(self) -> str:
        """Return the name of the study."""
        return self.subject.title if self.path is None else self.path.resolve().parent.name

    @property
    def varied(self) -> list[str]:
        """Return the inputs that change in at least one estimation log."""
        return [q.name for q in self.subject.inputs if any(np.ptp(log.inputs[q.name]) > 0.0 for log in self.logs)]

    @property
    def settings(self) -> Settings:
        """Return the study's settings for fits."""
        subject, content = self.subject, self.content
        per_log = tuple(dict.fromkeys(full_name(subject, n) for n in content.per_log or ()))
        files = [name for *_, name in _entries(content.logs)]
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
        """Read and return the sealed logs; called once, after all decisions."""
        usable = []
        for name in self.content.logs.validation:
            log = _read(self.folder / name, self.content, self.subject)
            log = drop_outliers(log, find_spikes(log, self.subject.prediction(log)))
            usable += _usable_stretches(log, self.subject.horizon)[0]
        return tuple(usable)


def read_study(path: Path, limits: str = "") -> Study:
    """Read a study and its logs.

    Args:
        limits: Limits that replace those of the study, such as `total: 10 min`.

    Raises:
        InputError: The study, its model or its logs have faults; the error names all of them.
    """
    yaml, content, faults = keys_of(path)
    if limits:
        content = content.model_copy(update={"limits": read_limits(limits)})
    if content.model.lower().endswith(FMU_SUFFIX):
        return _of_fmu(yaml, content, faults)
    if content.terms:
        message = f"terms are for an FMU, but {content.model} is not an FMU; a model lists its effects in its catalogue"
        faults.append(yaml.fault(("terms",), message, key=True))
    try:
        loaded = load_model(content.model, path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *error.faults]) from None
    except NotExecuted:
        refuse(faults)
        raise
    subject = ModelSubject(loaded)
    try:
        subject = ModelSubject(with_substep(loaded)[0])
    except InputError as error:
        faults += error.faults
    study = _checked(yaml, content, subject, faults)
    loaded, notes = with_substep(loaded, study.logs)
    warnings = (*study.warnings, *(with_prefix(f"{content.model}: ", text) for text in notes))
    return replace(study, path=path, subject=study.content.judged(ModelSubject(loaded)), warnings=warnings)


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
        InputError: The study or its logs have faults; the error names all of them.
        FmuError: Only the FMU has faults.
    """
    folder = yaml.path.parent
    fmu = folder / content.model
    if not fmu.is_file():
        message = f"{content.model}: no such file; give the path of the FMU relative to the study"
        raise InputError([*faults, yaml.fault(("model",), message)])
    logs, terms = list[Log](), list[type[Any]]()
    for part, k, name in _entries(content.logs):
        try:
            _check_exists(yaml, part, k, name)
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
    """Return the study of an FMU, whose structure is found by simulation along the estimation logs.

    Raises:
        InputError: The study or its logs have faults; the error names all of them.
        FmuError: Only the FMU has faults.
    """
    fmu, logs, terms = read_parts_of_fmu(yaml, content, faults)
    if compiler() is None:
        raise InputError.at(fmu, f"a refinement of an FMU needs a C compiler; {cure('refine')}")
    probed = probe_places(fmu, logs)
    if probed.structure.way == "co-simulation" and probed.own_step:
        message = f"{content.model} has no usable model exchange ({probed.reason}), and {probed.own_step.finding}"
        raise InputError([yaml.fault(("model",), message)])
    subject = FmuSubject.of_fmu(probed.structure, logs, terms, content.limits or Limits())
    subject.source += f", because {probed.reason}"
    names = subject.names  # names in the model, instead of FMU variables
    update: dict[str, Any] = {}
    for key in ("noise", "start_noise", "tolerance", "inputs", "candidates"):
        setting = getattr(content, key)
        if isinstance(setting, dict):
            update[key] = {names.get(n, n): value for n, value in setting.items()}
        elif isinstance(setting, list):
            update[key] = [names.get(n, n) for n in setting]
    study = _checked(yaml, content.model_copy(update=update), subject, faults)
    found = [f"{content.model}: {probed.own_step.finding}"] if probed.own_step else []
    return replace(study, path=yaml.path, warnings=(*found, *study.warnings))


def study_of(
    subject: Subject,
    logs: FilePath | Sequence[FilePath],
    validation: FilePath | Sequence[FilePath] = (),
    **settings: Any,
) -> Study:
    """Return a study of any subject, with checked logs.

    Args:
        settings: Keys of a study file, such as noise={"position": 1e-3} or candidates=["coulomb_friction"].

    Raises:
        InputError: The study or its logs have faults; the error names all of them.
    """
    places = Arguments(Path(subject.title))
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
    return _checked(places, content, copy(subject), [])


def _checked(places: Places, content: StudyFile, subject: Subject, faults: list[Fault]) -> Study:
    """Return the study of a subject, with the usable parts of its logs.

    Args:
        faults: Faults that are already known.

    Raises:
        InputError: The study or its logs have faults; the error names all of them.
    """
    if not subject.states:  # rows over time would say nothing more than any table
        cure = "estimate its parameters with `cosim fit LOG --fmu FMU`, or add a state to the model"
        raise InputError([places.fault(("model",), f"{subject.title} has no states, so it cannot be refined; {cure}")])
    for key, signals in (("noise", subject.outputs), ("start_noise", subject.states)):
        if isinstance(places, YamlFile):
            units = {q.name: q.unit for q in signals}
            content, wrong = places.in_units(content, key, units, difference=True)
            faults += wrong
    subject = content.judged(subject)
    faults += _key_faults(places, content, subject)
    logs, warnings, first = list[Log](), list[str](), dict[Any, tuple[str, str]]()
    for part, k, name in _entries(content.logs):
        try:
            _check_exists(places, part, k, name)
            log = _read(places.path.parent / name, content, subject)
        except InputError as error:
            faults += error.faults
            continue
        columns = sorted({"": log.time, **log.inputs, **log.outputs}.items())
        readings = tuple((n, np.where(np.isnan(values), np.nan, values).tobytes()) for n, values in columns)
        if readings in first:
            other, purpose = first[readings]
            message = f"{name} has the same content as {other} under {purpose}; keep one"
            faults.append(places.fault(("logs", part, k), message))
        first.setdefault(readings, (name, part))
        spikes = find_spikes(log, subject.prediction(log))
        findings = gate(log, subject.rate, traits=subject.traits, spikes=spikes)
        faults += gate_faults(log, findings)
        log = drop_outliers(log, spikes)
        warnings += [
            (
                f"{name}: {counted(rows.size, 'reading')} of {output} ignored as outliers, far from "
                "neighbouring readings and from the model"
            )
            for output, rows in spikes.items()
        ]
        usable, least = _usable_stretches(log, subject.horizon)
        parts = stretches(log)
        if not usable:
            longest = plain(max(float(s.time[-1] - s.time[0]) for s in parts))
            message = (
                f"lasts {longest} s without a pause; a log needs at least {plain(least, None)} s: record a longer log, "
                "or remove this one"
            )
            faults.append(Fault(log.path, 0, 0, message))
        warnings += [
            with_prefix(f"{name}: ", f.whole) for f in findings if f.severity == "warning" and f.kind != "outliers"
        ]
        warnings += [Note(f"{name}: {text}") for text in log.assumed]
        if count := len(parts) - len(usable):
            warnings.append(f"{name}: {counted(count, 'piece')} between pauses not used, because too short")
        logs += usable if part == "estimation" else []
    refuse(faults)
    return Study(None, content, subject, tuple(logs), tuple(warnings))


def _entries(logs: LogLists) -> list[tuple[str, int, str]]:
    """Return list (estimation or validation), index and file name of each log."""
    lists = {"estimation": logs.estimation, "validation": logs.validation}
    return [(part, k, name) for part, names in lists.items() for k, name in enumerate(names)]


def _check_exists(places: Places, part: str, k: int, name: str) -> None:
    """Raise InputError for a log that is missing."""
    if not os.path.exists(places.path.parent / name):
        message = f"{name}: no such file; give paths of logs relative to the folder of the study"
        raise InputError([places.fault(("logs", part, k), message)])


def _read(path: Path, content: StudyFile, subject: Subject) -> Log:
    """Read a log with the columns of the study."""
    if isinstance(subject, FmuSubject):
        log = log_of_fmu(path, subject.structure.fmu, content.columns, alone=False)
        return rename_signals(log, subject.names)
    return read_log(path, subject.inputs, subject.outputs, columns=content.columns)


def _usable_stretches(log: Log, horizon: float) -> tuple[list[Log], float]:
    """Return the parts of a log between pauses that are long enough, and the required duration [s]."""
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
        yield places.fault(("candidates",), "the list is empty; name candidates, or remove the key to try all")
    for k, name in enumerate(content.candidates or ()):
        if name not in candidates:
            yield places.fault(("candidates", k), f'no candidate "{name}"{did_you_mean(name, candidates)}')
    yield from _per_log_faults(places, content, subject)
    if not content.logs.estimation:
        message = "no log is listed; list one"
        if content.logs.validation:
            message = "there are only validation logs; move at least one to estimation"
        yield places.fault(("logs", "estimation"), message)


def full_name(subject: Subject, name: str) -> str:
    """Return the full name of a parameter, such as `sensor.value` for a sensor error."""
    return f"{name}.value" if name in {kind.name for kind in subject.sensors} else name


def group_of(folder: Path, files: Sequence[str], groups: Mapping[str, Sequence[str]]) -> dict[Path, str]:
    """Return file → group of each log."""
    group = {os.path.realpath(folder / f): name for name, members in groups.items() for f in members}
    return {folder / f: group.get(os.path.realpath(folder / f), f) for f in files}


def _per_log_faults(places: Places, content: StudyFile, subject: Subject) -> Iterator[Fault]:
    """Yield faults of the keys `per_log` and `groups`."""
    names, logs, folder = content.per_log, content.logs, places.path.parent
    owner, files = dict[str, str](), [*logs.estimation, *logs.validation]
    paths = {os.path.realpath(folder / f) for f in files}
    for name, members in content.groups.items():
        if name in files:
            yield places.fault(("groups", name), f'group "{name}" has the name of a log; rename it', key=True)
        for k, file in enumerate(members):
            path, place = os.path.realpath(folder / file), ("groups", name, k)
            if path not in paths:
                yield places.fault(place, f"{file} is not listed under logs{did_you_mean(file, files)}")
            elif path in owner:
                yield places.fault(place, f"{file} is in {owner[path]} too; keep one, because a log has one group")
            owner.setdefault(path, name)
    if names is None:
        if content.groups:
            message = "groups need parameters per log; name under per_log the parameters that differ, or remove groups"
            yield places.fault(("groups",), message, key=True)
        return
    if not names:
        yield places.fault(("per_log",), "the list is empty; name parameters, or remove the key", key=True)
    group = group_of(folder, files, content.groups)
    estimated = {group[folder / f] for f in logs.estimation}
    alone = [f for f in logs.validation if group[folder / f] not in estimated]
    base = [p.name for p in subject.parameters if not isinstance(p.default, bool)]
    of_effects = [n for n in subject.candidate_parameters if n.partition(".")[0] in subject.present]
    allowed = [*base, *of_effects, *subject.sensor_parameters]
    for k, name in enumerate(names):
        at, full = ("per_log", k), full_name(subject, name)
        if full not in allowed:
            own = [n for n in allowed if n.startswith(f"{name}.")]
            hint = did_you_mean(name, [*allowed, *(kind.name for kind in subject.sensors)])
            hint = f"; name its parameters: {', '.join(own)}" if own else hint
            message = f'no parameter "{name}" of the model or of its sensors{hint}'
            if name in subject.declared and not isinstance(subject.declared[name].default, bool):
                message = (
                    f"the model does not have {name.partition('.')[0]}; a missing effect is a candidate, so remove "
                    f"{name}"
                )
            yield places.fault(at, message)
        elif alone and full in subject.inestimable:
            message = f"{name} needs a value for {alone[0]}, whose group has no estimation log, and the filter cannot "
            message += f"estimate it during a run; put {alone[0]} in a group with an estimation log"
            yield places.fault(at, message)
    full_names = {full_name(subject, name) for name in names}
    for k, name in enumerate(content.candidates or ()):
        if ({n for n in subject.declared if n.startswith(f"{name}.")} or {name}) <= full_names:
            message = f"{name} is also listed under per_log, and therefore estimated in every hypothesis; remove one"
            yield places.fault(("candidates", k), message)


# What `cosim refine` can find with the logs of a study, and what it cannot find.


def check_study(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a study, and notes on what a refinement can find in its FMU.

    Raises:
        InputError: The study has faults.
    """
    keys = keys_of(path)
    model = keys[1].model
    if model.lower().endswith(FMU_SUFFIX) and checking.worker is None and skipped_files.get() is not None:
        read_parts_of_fmu(*keys)
        return [
            f"warning: {model} is not loaded (--no-load), so the names of candidates, noise and tolerance are not "
            "checked"
        ]
    study = read_study(path)
    found = [f"warning: {text}" for text in study.warnings]
    found += [Note(f"not tested: {text}") for text in untested_effects(study)]
    if isinstance(subject := study.subject, FmuSubject):
        s, count = subject.structure, len(subject.candidates([q.name for q in subject.inputs]))
        way = subject.source.removeprefix(f"{s.fmu}, ")
        places = f"the places that `cosim info --places {s.fmu.name}` lists"
        found.append(Note(f"`cosim refine` will use {way}, and try {count} terms and parameters at {places}"))
    return found


def untested_effects(study: Study) -> list[str]:
    """Return the effects that a refinement of this subject with these logs cannot test, each with the reason."""
    subject, logs, named = study.subject, study.logs, study.content.candidates
    still = [q.name for q in subject.inputs if q.name not in study.varied]
    untested = [subject.untried] if subject.untried else []
    if isinstance(subject, FmuSubject):
        untested += _untested_of_fmu(subject, logs, still)
    elif still:
        possible = {c.name for c in subject.candidates([q.name for q in subject.inputs])}
        left_out = sorted(possible - {c.name for c in subject.candidates(study.varied)})
        untested += [f"{join_names(left_out)} (constant in all logs: {join_names(still)})"] if left_out else []
    if named is not None:
        untested.append(f"effects other than the {counted(len(named), 'candidate')} in the study")
    return untested


def _untested_of_fmu(subject: FmuSubject, logs: Sequence[Log], still: Sequence[str]) -> Iterator[str]:
    """Yield the terms and parameters of an FMU that cannot be tested.

    Args:
        still: Inputs that do not change in any estimation log.
    """
    s, names = subject.structure, subject.names
    logged = set[str]().union(*(log.outputs for log in logs))
    one_way = []  # velocities that keep their sign in all logs
    for pair in s.pairs:
        name = with_place(s.shown_as(pair.velocity))
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        if readings.size and (np.nanmin(readings) >= 0.0 or np.nanmax(readings) <= 0.0):
            one_way.append(pair.velocity)
    for text, places in (
        ("terms at inputs that are constant in all logs ({})", [q.name for q in s.inputs if names[q.name] in still]),
        ("sensor errors of outputs that no log has ({})", [q.name for q in s.outputs if names[q.name] not in logged]),
        ("parameters that change no output ({})", [p.name for p in s.parameters if not (p.acts or p.starts)]),
        (
            "forces at velocities that no input drives, in co-simulation ({})",
            [p.velocity for p in s.pairs if subject.is_stepped and not p.ports],
        ),
        ("dry friction as opposed to a constant force, where the velocity never reverses ({})", one_way),
    ):
        if places:
            yield text.format(join_names(places))
    if not s.pairs:
        yield "friction and other forces (no output is a position or velocity)"
