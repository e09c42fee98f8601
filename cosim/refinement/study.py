"""Studies: the model, the logs for estimation and the sealed logs for validation."""

from __future__ import annotations

import hashlib
import math
import os.path
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Tag, ValidationError

from cosim.base.arrays import Rows
from cosim.base.errors import Fault, InputError, NotExecuted
from cosim.base.registry import BASE
from cosim.base.text import counted, plain
from cosim.base.units import has_unit, read_quantity
from cosim.estimation.problem import Settings
from cosim.isolation.limits import Limits
from cosim.loading.file import LoadedModel, load_model
from cosim.loading.substep import with_substep
from cosim.logs.gate import gate, gate_faults
from cosim.logs.holes import fill_holes
from cosim.logs.log import Log, read_log, stretches
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.refinement.search.groups import Places, full_name, group_of, per_log_faults
from cosim.residuals.windows import SKIPPED
from cosim.storage.artefact import Checking, kind_by_keys
from cosim.storage.files import FilePath
from cosim.storage.kinds import STUDY, check_form, refuse_other
from cosim.storage.yaml_file import UNIT_OF_KEY, Positive, YamlFile, did_you_mean
from cosim.subject.base_parameters import tolerances
from cosim.subject.interface import Subject
from cosim.subject.model_subject import ModelSubject

SCORED = 1.0  # [s] least scored time, beside the skipped start and one horizon
SPARE = 3  # rows of tables beyond the estimated parameters, to estimate the noise
FINEST, COARSEST = 1e-12, 1e3  # share of the largest reading outside which a standard deviation is implausible
Between = Literal["held", "interpolated"]
NARROWEST, WIDEST = 1e-6, 2.0  # share of a parameter: stricter than any data sheet; without information


def _share(value: Any) -> Any:
    """Return a tolerance or raise ValueError with the cure."""
    if isinstance(value, str) and has_unit(value):
        with suppress(ValueError):
            value = read_quantity(value, "1")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not NARROWEST <= value <= WIDEST:
        text = f"a tolerance is a share of the parameter, at least {NARROWEST:g} and at most {WIDEST:g}: 0.1 for 10 %"
        raise ValueError(text)
    return value


def _by_name(value: Any) -> str:
    """Return the tag of a setting."""
    return "«by name»" if isinstance(value, dict) else "«all»"


Share = Annotated[float, BeforeValidator(_share)]


def _file_name(name: str) -> str:
    if "\0" in name:
        raise ValueError("no name of a file holds a NUL character")
    return name


FileName = Annotated[str, AfterValidator(_file_name)]


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

    model:      A registered name, a model.yaml, or `file.py:Class`.
    logs:       Files, relative to the study.
    noise:      Output → standard deviation of its sensor, if different from the model's, in its unit or `2 deg`.
    tolerance:  Relative tolerance of base parameters, for all or by name.
    inputs:     Held from row to row, or interpolated, for all or by name.
    candidates: Effects, sensor errors and parameters on trial; default: all.
    columns:    Name in the logs → name in the model, if different.
    per_log:    Parameters with a separate value for each log.
    groups:     Name → logs with common values of per_log.
    limits:     Limits of each FMU call in replays.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = BASE
    logs: LogLists
    noise: dict[str, Annotated[Positive, UNIT_OF_KEY]] = {}
    tolerance: Annotated[
        Annotated[Share, Tag("«all»")] | Annotated[dict[str, Share], Tag("«by name»")], Discriminator(_by_name)
    ] = {}
    inputs: Annotated[
        Annotated[Between, Tag("«all»")] | Annotated[dict[str, Between], Tag("«by name»")], Discriminator(_by_name)
    ] = "held"
    candidates: list[str] | None = None
    columns: dict[str, str] = {}
    per_log: list[str] | None = None
    groups: dict[str, list[FileName]] = {}
    limits: Limits | None = None

    def interpolated(self, subject: Subject) -> frozenset[str]:
        """Return the interpolated inputs."""
        ways = self.inputs if isinstance(self.inputs, dict) else {q.name: self.inputs for q in subject.inputs}
        return frozenset(name for name, way in ways.items() if way == "interpolated")

    def tolerance_of(self, subject: Subject) -> dict[str, float]:
        """Return base parameter → relative tolerance."""
        if isinstance(self.tolerance, dict):
            return dict(self.tolerance)
        base = [p.name for p in subject.parameters]
        return dict.fromkeys((*subject.calibrated, *(n for n in self.per_log or () if n in base)), self.tolerance)


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
        """Return the study, model and log files."""
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
        return Settings(content.interpolated(subject), content.tolerance_of(subject), per_log, groups)

    def unseal(self) -> tuple[Log, ...]:
        """Read the validation logs; called once, after all decisions."""
        subject = self.subject
        paths = (self.folder / name for name in self.content.logs.validation)
        logs = (
            read_log(path, subject.inputs, subject.outputs, table=subject.static, columns=self.content.columns)
            for path in paths
        )
        return tuple(s for log in logs for s in judged(drop_outliers(log, _spikes(log, subject)), subject.horizon))


def check_study(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a study.

    Raises:
        InputError: The study has faults.
    """
    return [f"warning: {text}" for text in read_study(path).warnings]


def read_study(path: Path) -> Study:
    """Read a study and its logs.

    Raises:
        InputError: Every fault of the study, its model and its logs.
    """
    check_form(path, STUDY)
    yaml = YamlFile(path)
    refuse_other(path, kind_by_keys(yaml.root), STUDY)
    content, faults = yaml.partly(StudyFile, "model")
    if content is None:
        raise InputError(faults)
    try:
        loaded = load_model(content.model, path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *_listed_twice(yaml, content.logs, {}), *error.faults]) from None
    except NotExecuted:
        if faults := [*faults, *_listed_twice(yaml, content.logs, {})]:
            raise InputError(faults) from None
        raise
    subject = ModelSubject(loaded)
    units = {q.name: q.unit for q in subject.outputs}
    noise, of_units = yaml.in_units(("noise",), content.noise, units, difference=True)
    content = content.model_copy(update={"noise": noise})
    faults += of_units
    faults += _faults_of_keys(yaml, content, subject, unlisted=yaml.root["logs"].get("estimation", []) == [])
    try:
        stepping = ModelSubject(with_substep(loaded)[0])
    except InputError as error:
        faults, stepping = [*faults, *error.faults], subject
    logs, digests, warnings, of_logs = _read_logs(yaml, content, stepping)
    faults += [*of_logs, *_faults_beside_logs(yaml, content, subject, logs["estimation"], digests)]
    faults += _too_late(path.parent / content.model, loaded, [*logs["estimation"], *logs["validation"]])
    if faults:
        raise InputError(faults)
    loaded, chosen = with_substep(loaded, logs["estimation"])
    warnings += [f"{content.model}: {text}" for text in chosen]
    return Study(path, content, ModelSubject(loaded), tuple(logs["estimation"]), tuple(warnings))


@dataclass(frozen=True)
class _Arguments:
    """Location of faults in a study written in Python; `path` names the subject."""

    path: Path

    def fault(self, location: Sequence[str | int], message: str, *, key: bool = False) -> Fault:
        """Return a fault of an argument."""
        return Fault(self.path, 0, 0, f"{'.'.join(map(str, location))}: {message}")


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
    lists = {name: [str(Path(f).absolute()) for f in files] for name, files in _lists(logs, validation)}
    try:
        content = StudyFile.model_validate({"model": subject.source, "logs": lists, **settings})
    except ValidationError as error:
        raise InputError([places.fault(e["loc"], e["msg"]) for e in error.errors()]) from None
    faults = _faults_of_keys(places, content, subject, unlisted=not logs)
    read, digests, warnings, of_logs = _read_logs(places, content, subject)
    faults += [*of_logs, *_faults_beside_logs(places, content, subject, read["estimation"], digests)]
    if faults:
        raise InputError(faults)
    return Study(None, content, subject, tuple(read["estimation"]), tuple(warnings))


def _lists(
    logs: FilePath | Sequence[FilePath], validation: FilePath | Sequence[FilePath]
) -> Iterator[tuple[str, Sequence[FilePath]]]:
    """Yield the lists of logs."""
    for name, files in (("estimation", logs), ("validation", validation)):
        yield name, [files] if isinstance(files, (str, os.PathLike)) else files


def _faults_of_keys(places: Places, content: StudyFile, subject: Subject, *, unlisted: bool) -> list[Fault]:
    """Return all faults of the study's keys.

    Args:
        unlisted: True if no estimation log is listed.
    """
    faults, logs = _unknown_names(places, content, subject), content.logs.model_dump()
    faults += per_log_faults(places, subject, content.per_log, content.groups, logs, content.candidates or ())
    if unlisted:
        cure = "none is left to learn from; move one to estimation"
        sealed = f"every log is sealed, and {cure}" if content.logs.validation else "no log is listed; list one"
        faults.append(places.fault(("logs", "estimation"), sealed))
    return faults


def _faults_beside_logs(
    places: Places, content: StudyFile, subject: Subject, logs: Sequence[Log], digests: Mapping[str, str]
) -> Iterator[Fault]:
    """Yield faults between study and logs."""
    yield from _noise_of_no_sensor(places, content.noise, logs)
    yield from _listed_twice(places, content.logs, digests)
    yield from _too_few(places, content, subject, logs)


def _read_logs(
    yaml: Places, content: StudyFile, subject: Subject
) -> tuple[dict[str, list[Log]], dict[str, str], list[str], list[Fault]]:
    """Return usable stretches, file digests, warnings and faults."""
    folder, traits = yaml.path.parent, subject.traits
    logs: dict[str, list[Log]] = {"estimation": [], "validation": []}
    digests: dict[str, str] = {}
    warnings: list[str] = []
    faults: list[Fault] = []
    for part, name in _entries(content.logs):
        if not os.path.exists(folder / name):
            place = ("logs", part, getattr(content.logs, part).index(name))
            faults.append(yaml.fault(place, f"{name}: no such file beside the study; its logs are named from there"))
            continue
        try:
            log = read_log(
                folder / name, subject.inputs, subject.outputs, table=subject.static, columns=content.columns
            )
        except InputError as error:
            faults += error.faults
            continue
        digests[name] = _digest(log)
        spikes = _spikes(log, subject)
        findings = gate(log, subject.rate, traits=traits, spikes=spikes)
        faults += gate_faults(log, findings)
        log = drop_outliers(log, spikes)
        warnings += [_left_out(name, channel, rows.size) for channel, rows in spikes.items()]
        whole = judged(log, subject.horizon)
        faults += [] if whole else [_too_short(log, subject.horizon)]
        told = [f for f in findings if f.severity == "warning" and f.kind != "outliers"]
        warnings += [f.whole.after(f"{name}: ") for f in told]
        if left := 0 if log.table else len(stretches(log)) - len(whole):
            warnings.append(f"{name}: {counted(left, 'piece')} between pauses too short to be used")
        logs[part] += whole
    return logs, digests, warnings, faults


def _entries(logs: LogLists) -> list[tuple[str, str]]:
    """Return each log with the name of its list."""
    return [*(("estimation", name) for name in logs.estimation), *(("validation", name) for name in logs.validation)]


def _listed_twice(yaml: Places, logs: LogLists, digests: Mapping[str, str]) -> Iterator[Fault]:
    """Yield faults of files listed twice, by name or by content."""
    listed: dict[str, tuple[str, str]] = {}
    for n, (part, name) in enumerate(_entries(logs)):
        path = os.path.realpath(yaml.path.parent / name)
        keys = [path, *([digests[name]] if name in digests else [])]
        before = next((listed[key] for key in keys if key in listed), None)
        if before is not None:
            other, where = before
            cure = "keep one" if where == part else "a validation log is never fitted on"
            again = f"is listed for {where} {'twice' if where == part else 'too'}"
            what = again if path in listed else f"holds the same as {other}, which is listed for {where}"
            place = ("logs", part, n if part == "estimation" else n - len(logs.estimation))
            yield yaml.fault(place, f"{name} {what}; {cure}")
        for key in keys:
            listed.setdefault(key, (name, part))


def _digest(log: Log) -> str:
    """Return a digest of the numbers, equal for copies."""
    content = hashlib.sha256(log.time.tobytes())
    for name, values in sorted({**log.inputs, **log.outputs}.items()):
        content.update(name.encode() + b"\0" + np.where(np.isnan(values), np.nan, values).tobytes())
    return content.hexdigest()


def _spikes(log: Log, subject: Subject) -> dict[str, Rows]:
    """Return outliers of a log; a table has none."""
    return {} if log.table else find_spikes(log, subject.prediction(log))


def least_duration(log: Log, horizon: float) -> float:
    """Return the least useful duration of a log [s].

    A slow log needs proportionally more.
    """
    return (SKIPPED + SCORED) * log.slowness + (horizon if math.isfinite(horizon) else 0.0)


def judged(log: Log, horizon: float) -> list[Log]:
    """Return the measured stretches of sufficient duration."""
    if log.table:
        return [log]
    least = least_duration(log, horizon) - 0.5 * log.step
    return [fill_holes(s) for s in stretches(log) if s.outputs and s.time[-1] - s.time[0] >= least]


def _left_out(log: str, channel: str, count: int) -> str:
    readings = f"{log}: {counted(count, 'reading')} of {channel}"
    return f"{readings} left out, which its neighbours and the model do not explain"


def _too_short(log: Log, horizon: float) -> Fault:
    lasts = plain(max(float(s.time[-1] - s.time[0]) for s in stretches(log)))
    least = plain(least_duration(log, horizon), None)
    what = f"lasts {lasts} s" if len(stretches(log)) == 1 else f"lasts at most {lasts} s without a pause"
    cure = f"it takes {least} s, and {plain(20 * log.slowness)} s and more tell more; log longer or leave it out"
    return Fault(log.path, 0, 0, f"{what}, too short to be judged: {cure}")


def _too_few(yaml: Places, content: StudyFile, subject: Subject, logs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of tables with too few rows."""
    if not logs or not subject.static:
        return
    numbers = len(tolerances(subject, content.tolerance_of(subject)))
    rows, least = sum(len(log.time) for log in logs), numbers + 1 + SPARE
    if rows < least:
        of = f"{counted(numbers, 'number')} that may be off, one that is missing, and {SPARE} more to see the noise"
        text = f"{counted(rows, 'row')} to learn from, and it takes {least}: {of}; measure more"
        yield yaml.fault(("logs", "estimation"), text)


def _too_late(model_file: Path, loaded: LoadedModel, logs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of latencies too long for the logs."""
    for name in (f"{kind.name}.value" for kind in loaded.model.sensors if kind.late):
        seconds = loaded.sensors.get(name, 0.0)
        lasts: dict[Path, float] = {}
        for log in logs:
            left = float(log.time[-1] - log.time[0]) - seconds
            if left < least_duration(log, loaded.model.horizon) - 0.5 * log.step:
                lasts[log.path] = left + seconds
        if seconds > 0.0 and lasts:
            which = ", ".join(f"{path.name} lasts {plain(whole)} s" for path, whole in lasts.items())
            text = f"{name} is {plain(seconds)} s, and {which}: too little is left to be judged"
            yield YamlFile(model_file).fault(("sensors", name), f"{text}; correct it, or log longer")


def _noise_of_no_sensor(yaml: Places, noise: Mapping[str, float], logs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of implausible sensor noise."""
    for name, level in noise.items():
        read = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        read = read[np.isfinite(read)]
        size = float(np.max(np.abs(read))) if read.size else 0.0
        if size > 0.0 and not FINEST * size < level < COARSEST * size:
            text = f"{plain(level)} is no noise of readings of up to {plain(size)}; state it in their unit"
            yield yaml.fault(("noise", name), f"noise.{name}: {text}")


def _unknown_names(yaml: Places, content: StudyFile, subject: Subject) -> list[Fault]:
    outputs = [q.name for q in subject.outputs]
    faults = [
        yaml.fault(("noise", name), f'no output "{name}"{did_you_mean(name, outputs)}', key=True)
        for name in content.noise
        if name not in outputs
    ]
    faults += _unknown_settings(yaml, content, subject)
    known = candidate_names(subject)
    if content.candidates is not None and not content.candidates:
        faults.append(yaml.fault(("candidates",), "names none; name some, or leave the key out to try all"))
    for k, name in enumerate(content.candidates or ()):
        if name not in known:
            faults.append(yaml.fault(("candidates", k), f'no candidate "{name}"{did_you_mean(name, known)}'))
    return faults


def _unknown_settings(yaml: Places, content: StudyFile, subject: Subject) -> Iterator[Fault]:
    """Yield faults of tolerances and interpolations of unknown names."""
    numbers = [p.name for p in subject.parameters if not isinstance(p.default, bool)]
    for name in content.tolerance if isinstance(content.tolerance, dict) else ():
        if name not in numbers:
            yield yaml.fault(("tolerance", name), f'no base parameter "{name}"{did_you_mean(name, numbers)}', key=True)
    inputs = [q.name for q in subject.inputs]
    for name in content.inputs if isinstance(content.inputs, dict) else ():
        if name not in inputs:
            yield yaml.fault(("inputs", name), f'no input "{name}"{did_you_mean(name, inputs)}', key=True)


def candidate_names(subject: Subject) -> Sequence[str]:
    """Return the names of all possible candidates."""
    return [c.name for c in subject.candidates([q.name for q in subject.inputs])]
