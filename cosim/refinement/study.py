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
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Tag, ValidationError

from cosim.core.errors import Fault, InputError, NotExecuted, refuse
from cosim.core.messages import with_prefix
from cosim.core.registry import BASE
from cosim.core.text import counted, plain
from cosim.core.units import has_unit, read_quantity
from cosim.estimation.problem import Settings
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.files.artefact import STUDY, kind_by_keys
from cosim.files.files import FilePath
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import UNIT_OF_KEY, Positive, PositiveSeconds, YamlFile, did_you_mean
from cosim.fmi.building.file import LoadedModel, load_model, own_terms
from cosim.fmi.building.substep import with_substep
from cosim.fmi.native.compiler import compiler, cure
from cosim.isolation.limits import Limits, read_limits
from cosim.logs.gate import gate, gate_faults
from cosim.logs.holes import fill_holes
from cosim.logs.log import Log, read_log, rename_signals, stretches
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.probing.places import probe_places
from cosim.refinement.search.groups import Places, full_name, group_of, per_log_faults
from cosim.residuals.drive import log_of_fmu
from cosim.residuals.windows import SKIPPED

MISSING_LOG = "{log}: no such file beside the study; its logs are named from there"

FMU_SUFFIX = ".fmu"
SCORED = 1.0  # [s] least scored time, beside the skipped start and one horizon
FINEST, COARSEST = 1e-12, 1e3  # share of the largest reading outside which a standard deviation is implausible
Interpolation = Literal["held", "interpolated"]
AnySubject = TypeVar("AnySubject", bound=Subject)
NARROWEST, WIDEST = 1e-6, 2.0  # share of a parameter: stricter than any data sheet; without information


def _check_share(value: Any) -> Any:
    """Return a valid tolerance; raise ValueError with the cure."""
    if isinstance(value, str) and has_unit(value):
        with suppress(ValueError):
            value = read_quantity(value, "1")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not NARROWEST <= value <= WIDEST:
        text = f"a tolerance is a share of the parameter, at least {NARROWEST:g} and at most {WIDEST:g}: 0.1 for 10 %"
        raise ValueError(text)
    return value


def _check_file_name(name: str) -> str:
    """Return a file name; raise ValueError for NUL characters."""
    if "\0" in name:
        raise ValueError("no name of a file holds a NUL character")
    return name


def _setting_tag(value: Any) -> str:
    """Return the tag of a setting that is a single value or a mapping by name."""
    return "«by name»" if isinstance(value, dict) else "«all»"


Share = Annotated[float, BeforeValidator(_check_share)]
FileName = Annotated[str, AfterValidator(_check_file_name)]


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
        Annotated[Share, Tag("«all»")] | Annotated[dict[str, Share], Tag("«by name»")], Discriminator(_setting_tag)
    ] = {}
    inputs: Annotated[
        Annotated[Interpolation, Tag("«all»")] | Annotated[dict[str, Interpolation], Tag("«by name»")],
        Discriminator(_setting_tag),
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
        logs = (_read(self.folder / name, self.content, self.subject) for name in self.content.logs.validation)
        return tuple(
            stretch
            for log in logs
            for stretch in _usable_stretches(
                drop_outliers(log, find_spikes(log, self.subject.prediction(log))), self.subject.horizon
            )
        )


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
        faults.append(
            yaml.fault(
                ("terms",),
                f"terms are for an FMU, and {content.model} is none; a model lists its effects in its catalogue",
                key=True,
            )
        )
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
    faults += unit_faults
    faults += _key_faults(yaml, content, subject, unlisted=yaml.root["logs"].get("estimation", []) == [])
    try:
        stepping = content.judged(ModelSubject(with_substep(loaded)[0]))
    except InputError as error:
        faults, stepping = [*faults, *error.faults], subject
    logs, warnings, log_faults = _read_logs(yaml, content, stepping)
    latency_faults = _latency_faults(path.parent / content.model, loaded, [*logs["estimation"], *logs["validation"]])
    refuse([*faults, *log_faults, *latency_faults])
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
        refuse(
            [
                *faults,
                yaml.fault(("model",), f"{content.model}: no such file; model names the FMU, relative to the study"),
            ]
        )
    logs, terms = list[Log](), list[type[Any]]()
    for part, name in _entries(content.logs):
        if not os.path.exists(folder / name):
            place = ("logs", part, getattr(content.logs, part).index(name))
            faults.append(yaml.fault(place, MISSING_LOG.format(log=name)))
            continue
        try:
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
        own = {"own": probed.own_step.length, "step": probed.structure.step}
        message = (
            "{name} has no usable model exchange ({reason}), and its co-simulation takes steps of its own of "
            "about {own:.3g} s, above the {step:.3g} s of the logs, so its results are wrong there; export it "
            "for model exchange or with a shorter step, or record rows every {own:.3g} s"
        ).format(name=content.model, reason=probed.reason, **own)
        raise InputError([yaml.fault(("model",), message)])
    subject = FmuSubject.of_fmu(probed.structure, logs, terms, content.limits or Limits())
    subject.source += f", because {probed.reason}"
    names = subject.names  # in place of the FMU's variables
    update: dict[str, Any] = {}
    for key in ("noise", "start_noise", "tolerance", "inputs"):
        setting = getattr(content, key)
        if isinstance(setting, dict):
            update[key] = {names.get(n, n): value for n, value in setting.items()}
    if content.candidates is not None:
        update["candidates"] = [names.get(n, n) for n in content.candidates]
    content, unit_faults = _in_units(yaml, content.model_copy(update=update), subject)
    subject = content.judged(subject)
    faults += [*unit_faults, *_key_faults(yaml, content, subject, unlisted=False)]
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
    refuse([*_key_faults(places, content, subject, unlisted=not logs), *log_faults])
    return Study(None, content, subject, tuple(usable["estimation"]), tuple(warnings))


def _refuse_without_states(places: Places, subject: Subject) -> None:
    """Raise InputError for a model without states, whose rows over time say nothing more than any table."""
    if not subject.states:
        cure = "estimate its parameters with `cosim fit LOG --fmu FMU`, or give it the state that it lacks"
        raise InputError([places.fault(("model",), f"{subject.title} has no states, so it cannot be refined; {cure}")])


def _key_faults(places: Places, content: StudyFile, subject: Subject, *, unlisted: bool) -> Iterator[Fault]:
    """Yield all faults of the study's keys.

    Args:
        unlisted: True if no estimation log is listed.
    """
    yield from _unknown_names(places, content, subject)
    logs = content.logs.model_dump()
    yield from per_log_faults(places, subject, content.per_log, content.groups, logs, content.candidates or ())
    if unlisted:
        message = "no log is listed; list one"
        if content.logs.validation:
            message = "every log is sealed, and none is left to learn from; move one to estimation"
        yield places.fault(("logs", "estimation"), message)


def _read_logs(
    places: Places, content: StudyFile, subject: Subject
) -> tuple[dict[str, list[Log]], list[str], list[Fault]]:
    """Return the usable stretches of the logs, warnings and faults."""
    logs: dict[str, list[Log]] = {"estimation": [], "validation": []}
    digests: dict[str, str] = {}
    warnings: list[str] = []
    faults: list[Fault] = []
    for part, name in _entries(content.logs):
        path = places.path.parent / name
        if not os.path.exists(path):
            place = ("logs", part, getattr(content.logs, part).index(name))
            faults.append(places.fault(place, MISSING_LOG.format(log=name)))
            continue
        try:
            log = _read(path, content, subject)
        except InputError as error:
            faults += error.faults
            continue
        digests[name] = _digest(log)
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
        usable = _usable_stretches(log, subject.horizon)
        if not usable:
            longest = plain(max(float(s.time[-1] - s.time[0]) for s in stretches(log)))
            least, better = plain(_min_duration(log, subject.horizon), None), plain(20 * log.slowness)
            duration = f"{longest} s" if len(stretches(log)) == 1 else f"at most {longest} s without a pause"
            message = (
                f"lasts {duration}, too short to be judged: it takes {least} s, and {better} s and more tell more; log "
                "longer or leave it out"
            )
            faults.append(Fault(log.path, 0, 0, message))
        warnings += [
            with_prefix(f"{name}: ", f.whole) for f in findings if f.severity == "warning" and f.kind != "outliers"
        ]
        if count := len(stretches(log)) - len(usable):
            warnings.append(f"{name}: {counted(count, 'piece')} between pauses too short to be used")
        logs[part] += usable
    faults += _implausible_noise(places, content.noise, logs["estimation"])
    faults += _repeated_logs(places, content.logs, digests)
    return logs, warnings, faults


def _entries(logs: LogLists) -> list[tuple[str, str]]:
    """Return each log with the name of its list."""
    return [*(("estimation", name) for name in logs.estimation), *(("validation", name) for name in logs.validation)]


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


def _digest(log: Log) -> str:
    """Return a digest of the numbers, equal for copies."""
    content = hashlib.sha256(log.time.tobytes())
    for name, values in sorted({**log.inputs, **log.outputs}.items()):
        content.update(name.encode() + b"\0" + np.where(np.isnan(values), np.nan, values).tobytes())
    return content.hexdigest()


def _min_duration(log: Log, horizon: float) -> float:
    """Return the least useful duration of a log [s].

    A slow log needs proportionally more.
    """
    return (SKIPPED + SCORED) * log.slowness + (horizon if math.isfinite(horizon) else 0.0)


def _usable_stretches(log: Log, horizon: float) -> list[Log]:
    """Return the measured stretches of sufficient duration."""
    least = _min_duration(log, horizon) - 0.5 * log.step
    return [fill_holes(s) for s in stretches(log) if s.outputs and s.time[-1] - s.time[0] >= least]


def _latency_faults(model_file: Path, loaded: LoadedModel, logs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of latencies too long for the logs."""
    for name in (f"{kind.name}.value" for kind in loaded.model.sensors if kind.late):
        latency = loaded.sensors.get(name, 0.0)
        durations: dict[Path, float] = {}
        for log in logs:
            rest = float(log.time[-1] - log.time[0]) - latency
            if rest < _min_duration(log, loaded.model.horizon) - 0.5 * log.step:
                durations[log.path] = rest + latency
        if latency > 0.0 and durations:
            texts = ", ".join(f"{path.name} lasts {plain(duration)} s" for path, duration in durations.items())
            message = (
                f"{name} is {plain(latency)} s, and {texts}: the rest is too short to judge a model; correct "
                "this value, or record longer logs"
            )
            yield YamlFile(model_file).fault(("sensors", name), message)


def _implausible_noise(places: Places, noise: Mapping[str, float], logs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of implausible sensor noise."""
    for name, level in noise.items():
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        largest = float(np.max(np.abs(readings[np.isfinite(readings)]), initial=0.0))
        if largest > 0.0 and not FINEST * largest < level < COARSEST * largest:
            message = (
                f"noise.{name}: {plain(level)} is no noise of readings of up to {plain(largest)}; state it in "
                "their unit"
            )
            yield places.fault(("noise", name), message)


def _unknown_names(places: Places, content: StudyFile, subject: Subject) -> Iterator[Fault]:
    """Yield faults of unknown outputs, states, base parameters, inputs and candidates."""
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
