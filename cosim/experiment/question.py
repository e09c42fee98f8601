"""Specification of an experiment: model, rival hypotheses, measured outputs and limits; separation of the rivals.

The criterion is T-optimality (Atkinson and Fedorov 1975): the value of an input is the difference between two models
that remains after the parameters of one model have been fitted to the other. Innovations of the filter are compared, as
in `refine`, so that disturbances hide the same differences. With e the innovations, s their variances and θ the fitted
parameters:

    D² = min over δ of Σ (e_a − e_b − ∂e_b/∂θ·δ)²/s + Σ (δ/σ)²,  σ the prior of a base parameter

D is in standard deviations; the expected log-likelihood gain is ½·D².
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, combinations
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.linear_algebra import least_squares
from cosim.core.text import did_you_mean
from cosim.estimation.data import data_of, readings_of, start_state
from cosim.estimation.fit import DIFFERENCE
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate, Free, base_parameters
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.experiment.rigs import OpenLoop, Ranges, inputs_to_limit, limits_and_ranges
from cosim.files.artefact import ANSWER, CODE, FMU, MODEL
from cosim.files.folders import newest_run
from cosim.files.kinds import check_form, check_given, kind_by_form
from cosim.files.yaml_file import YamlFile
from cosim.fmi.building.file import LoadedModel, load_model
from cosim.fmi.building.refined import names_refine
from cosim.fmi.building.substep import with_substep
from cosim.fmi.description import read_description
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log, read_log
from cosim.model.model import Model
from cosim.probing.places import probe_places
from cosim.probing.prober import quantities, sine_course
from cosim.refinement.search.fits import TOGETHER
from cosim.refinement.study import StudyFile, read_study
from cosim.residuals.drive import REPLAY_MODULES, DriveApart, as_columns, model_signals
from cosim.terms.code import fmu_model
from cosim.terms.language import with_place

PARAMETER_ERROR = 0.2  # relative error of a wrong base parameter; suspect parameters use the size of their fits
MIN_SEPARATION = 3.0  # distance between rivals, in standard deviations, that a log needs for a decision
Pair = tuple[str, str]


@dataclass(frozen=True)
class Rival:
    """A hypothesis: its true parameter values and its free parameters."""

    name: str
    values: Mapping[str, float]
    free: tuple[Free, ...]


def typical_rival(subject: Subject, candidate: Candidate) -> Rival:
    """Return a rival in which a candidate has a clearly detectable size.

    An effect differs from its neutral value by its `typical` size. A base parameter has an error of 20 %.
    """
    if candidate.kind == "parameter":
        (free,) = candidate.free
        value = subject.values[free.name]
        wrong = PARAMETER_ERROR * abs(value) if free.name in subject.calibrated else free.size
        return Rival(candidate.name, {free.name: value + wrong}, candidate.free)
    declared = [(name, subject.declared[name]) for name in candidate.parameters]
    values = {
        name: float(p.default) if p.neutral is None or p.typical is None else p.neutral + p.typical
        for name, p in declared
    }
    return Rival(candidate.name, values, candidate.free)


def separation(
    subject: Subject, problem: Problem, substeps: int, rivals: Sequence[Rival], pairs: Sequence[Pair], log: Log
) -> dict[Pair, float]:
    """Return the distance of each pair of rivals on a noise-free log [standard deviations].

    Args:
        problem: Fitting problem with the kernel.
        substeps: Number of integration substeps per row.
        rivals: Hypotheses at a detectable size.
    """
    layout, noise, named = problem.layout, problem.plain, {r.name: r for r in rivals}
    free_base = base_parameters(subject, problem.values, problem.settings.tolerance)
    data = replace(data_of(subject, log, layout), substeps=substeps)
    start = start_state(subject, data, layout.outputs, layout.states)
    problem = replace(problem, logs=[data], readings=[readings_of(data)], x0=[start])
    scored = problem.score(problem.values, noise)
    sigma, count = np.sqrt(scored.variances), len(scored.errors)

    def change(values: Mapping[str, float]) -> Array:
        """Return the change of the filter's innovations at parameter values, 0 for a diverged filter."""
        errors = problem.score({**problem.values, **values}, noise).errors
        return np.asarray(np.nan_to_num((errors - scored.errors) / sigma, nan=0.0, posinf=0.0, neginf=0.0))

    def slopes(free: Sequence[Free], values: Mapping[str, float], shift: Array) -> Array:
        """Return the derivatives by scaled parameters at `values`, shape (parameters, measurements)."""
        rows = np.empty((len(free), count))
        for row, f in zip(rows, free, strict=True):
            value = values.get(f.name, problem.values[f.name])
            h = DIFFERENCE * f.size if value + DIFFERENCE * f.size <= f.high else -DIFFERENCE * f.size
            row[:] = (change({**values, f.name: value + h}) - shift) * (f.size / h)
        return rows

    shift = {r.name: change(r.values) for r in rivals}
    own = {r.name: slopes(r.free, r.values, shift[r.name]) for r in rivals}
    base = slopes(free_base, {}, np.zeros(count))

    def distance(truth: str, adapted: str) -> float:
        """Return the remaining distance after fitting the free parameters of one hypothesis and of the base."""
        names = {f.name for f in named[adapted].free}
        others = [k for k, f in enumerate(free_base) if f.name not in names]
        design = np.vstack([own[adapted], base[others]]).T
        # one row per prior, δ in units of the parameter's size
        priors = np.zeros((len(others), design.shape[1]))
        for row, k in enumerate(others):
            if prior := free_base[k].prior:
                priors[row, len(own[adapted]) + row] = free_base[k].size / prior[1]
        A = np.vstack([design, priors])
        b = np.concatenate([shift[truth] - shift[adapted], np.zeros(len(others))])
        return float(np.linalg.norm(b - A @ least_squares(A, b)))

    # Only the hypothesis with fewer free parameters is fitted: one with more could reproduce the other.
    return {
        (a, b): min(distance(*way) for way in ((a, b), (b, a)) if len(own[way[0]]) >= len(own[way[1]]))
        for a, b in pairs
    }


# Specification of an experiment: what it must decide.


BASE_RIVAL = "nothing"
NOISE_SHARE = 0.01  # assumed noise of an output, relative to its spread, without logs


@dataclass(frozen=True)
class Question:
    """Specification of an experiment: rival hypotheses, pairs to separate, measured outputs and limits.

    Attributes:
        loaded: Model under test.
        subject: Subject from which the rivals differ: `loaded`, or `loaded` without its effects.
        measured: Logged outputs. noise: Output → standard deviation of its noise, if it differs from the model's.
        limits: Largest excursion of an input or output from its start.
        ranges: Input → smallest and largest value, as declared, as requested, or as in logs.
        first: Output of an FMU → reading at the start.
    """

    loaded: LoadedModel
    subject: ModelSubject
    rivals: tuple[Rival, ...]
    pairs: tuple[Pair, ...]
    measured: tuple[str, ...]
    noise: Mapping[str, float]
    limits: Mapping[str, float]
    ranges: Ranges = field(default_factory=dict)
    first: Mapping[str, float] = field(default_factory=dict)


class Ranked(BaseModel):
    """A ranked hypothesis, as read from refine.json."""

    names: list[str]
    parameters: dict[str, float]
    fitted: bool
    log_likelihood_gain: float | None


class RefineResultPart(BaseModel):
    """Required part of a refine.json."""

    study: str
    rivals: list[str]
    candidates: list[Ranked]
    hidden: list[str]
    measured: list[str]
    sensor_noise: dict[str, float] = {}  # missing in older files; the model's noise is used


def ask(
    text: str,
    against: Sequence[str] = (),
    limits: Sequence[str] = (),
    measured: Sequence[str] = (),
    ranges: Sequence[str] = (),
    duration: float | None = None,
) -> Question:
    """Return the specification of an experiment: model, rival hypotheses, and limits of signals.

    Args:
        text: `base`, a model file, an FMU, or a refine.json or its folder.
        against: Names of rivals; by default rivals of the refinement, or candidates of the model that are hard to
            separate.
        limits: Texts NAME=VALUE: largest distance of an input or output from its start value, with unit.
        measured: Outputs that will be logged; by default those of the refinement or of the model.
        ranges: Texts NAME=MIN..MAX: range of an input, with unit.
        duration: Duration of the experiment [s], for the probe of an FMU.

    Raises:
        InputError: An argument has faults, or the model has no states.
    """
    path = Path(text)
    folder = refinement_folder(text)
    if path.is_file() and kind_by_form(path) == FMU:
        question = _question_of_fmu(path, against, limits, ranges, duration)
    else:
        if path.exists() and not names_refine(path) and ".py:" not in text:
            (check_given if path.suffix == ".json" else check_form)(path, ANSWER, MODEL, CODE, FMU)
        if folder and path.exists():
            path = folder / "refine.json" if path.is_dir() else path
            question = _question_of_refinement(path, against)
        else:
            question = _question_of_model(path, with_substep(load_model(text, Path()))[0], against)
    model, faults = question.subject.model, list[str]()
    if not model.base_states:
        raise InputError.at(
            path,
            f"{model.title} has no states: its outputs depend only on the present inputs, so no input signal can be "
            "designed; log more values of the inputs",
        )
    reaches, spans = limits_and_ranges(model, limits, ranges, question.ranges, faults)
    outputs = [q.name for q in model.outputs]
    unknown = [name for name in measured if name not in outputs]
    faults += [f'--measured: no output "{name}"{did_you_mean(name, outputs)}' for name in unknown]
    logged = tuple(n for n in outputs if n in (measured or question.measured))
    if not logged and not faults:
        faults.append(
            f"the model does not declare its measured outputs; add --measured NAME, one of {', '.join(outputs)}"
        )
    refuse(Fault(path, 0, 0, fault) for fault in faults)
    return replace(question, limits=reaches, ranges=spans, measured=logged)


def refinement_folder(text: str) -> Path | None:
    """Return the folder of a refinement, given the folder or its refine.json; None for other texts."""
    path = Path(text)
    return newest_run(path) if path.is_dir() else path.parent if path.suffix == ".json" else None


def _question_of_refinement(path: Path, against: Sequence[str]) -> Question:
    """Return the specification of an experiment that separates the rivals of a refinement.

    A rival with a significant fit has the fitted values. Any other rival has its typical size.
    """
    yaml = YamlFile(path)
    if isinstance(yaml.root, dict) and yaml.root.get("finished") is False:
        message = "the refinement was stopped before a verdict, so it has no rivals; refine again with more time"
        raise InputError([yaml.fault(("finished",), message, key=True)])
    content = yaml.validate(RefineResultPart)
    file = Path(content.study)
    if not file.is_file():
        message = f"no such study: {file}; a relative path starts from the current folder, so run the command there"
        raise InputError([yaml.fault(("study",), message)])
    yaml = YamlFile(file)
    study = yaml.validate(StudyFile)
    first, logs = dict[str, float](), list[Log]()
    if study.model.lower().endswith(".fmu"):
        of_study = read_study(file)
        assert isinstance(of_study.subject, ModelSubject)
        subject, study, logs = of_study.subject, of_study.content, [*of_study.logs]
        first = _first_outputs(logs[0])
    else:
        subject = ModelSubject(with_substep(load_model(study.model, file.parent, yaml))[0])
        inputs, outputs = subject.model.inputs, subject.model.outputs
        for name in study.logs.estimation:
            with suppress(InputError):  # missing logs are skipped
                logs.append(read_log(file.parent / name, inputs, outputs, columns=study.columns))
    candidates, model = _candidates(subject.loaded), subject.model
    names = list(against) or [n for n in content.rivals if n != "no_effect"]
    if any(TOGETHER in name for name in names):
        parts = {name: tuple(name.split(TOGETHER)) for name in names}
        _check_names(path, list(dict.fromkeys(chain.from_iterable(parts.values()))), candidates)
        values_of = {frozenset(h.names): h.parameters for h in reversed(content.candidates)}
        rivals = tuple(
            Rival(
                name,
                values_of.get(frozenset(parts[name]), {}),
                tuple(f for n in parts[name] for f in candidates[n].free),
            )
            for name in names
        )
        pairs: Sequence[Pair] = [*combinations(names, 2)]
    else:
        _check_names(path, names, candidates)
        typical, pairs = _rivals(subject, candidates, names, _groups(model, candidates))
        rivals = tuple(_fitted_rival(r, names, content, candidates, subject.values) for r in typical)
    ranges = {}  # (least, largest) command over all logs
    for name in logs[0].inputs if logs and inputs_to_limit(model) else ():
        commands = np.concatenate([log.inputs[name] for log in logs])
        ranges[name] = float(commands.min()), float(commands.max())
    noise = {**content.sensor_noise, **study.noise}
    measured = tuple(content.measured)
    return Question(subject.loaded, subject, rivals, tuple(pairs), measured, noise, {}, ranges, first)


def _fitted_rival(
    r: Rival,
    names: Sequence[str],
    content: RefineResultPart,
    candidates: Mapping[str, Candidate],
    values: Mapping[str, float],
) -> Rival:
    """Return a rival with the parameters of its best significant fit without other rivals, if there is one.

    A fit without significance is often close to the neutral value, at which no input separates the rival.
    """
    if r.name not in candidates or r.name in content.hidden:  # not fitted, or not significant
        return r
    for h in content.candidates:
        gain, kept, rest = h.log_likelihood_gain, h.parameters, {*h.names} - {r.name}
        if not h.fitted or gain is None or r.name not in h.names or not rest.isdisjoint(names):
            continue
        if any(kept[f.name] in (f.low, f.high) and kept[f.name] != values[f.name] for f in candidates[r.name].free):
            continue
        simpler = [o.log_likelihood_gain or 0.0 for o in content.candidates if rest.issuperset(o.names)]
        if gain - max(simpler, default=0.0) > 0.5 * MIN_SEPARATION**2:
            return Rival(r.name, kept, tuple(f for n in h.names for f in candidates[n].free))
    return r


def _question_of_fmu(
    path: Path, against: Sequence[str], limits: Sequence[str], ranges: Sequence[str], duration: float | None
) -> Question:
    """Return the specification of an experiment for an FMU, whose structure is found with a pulse of each input.

    Args:
        against: Names of the rivals.
        duration: Duration of the pulses [s]; None for the duration and step that the FMU declares.

    Raises:
        InputError: An input has no limit, or an argument has faults.
        FmuError: The FMU cannot be loaded.
        SimulationError: The FMU fails.
    """
    check_given(path, FMU)
    description = read_description(path)
    course = sine_course(description)
    step = float(course.time[1] - course.time[0])
    time = step * np.arange(round((duration or float(course.time[-1])) / step) + 1, dtype=np.float64)
    signals = model_signals(path)
    inputs, outputs = (quantities(description, [q.name for q in group]) for group in signals)
    into, out = (tuple(replace(q, name=with_place(q.name)) for q in group) for group in (inputs, outputs))
    bare = fmu_model(path.stem, (out, into, out), (), (), rate=step)  # without terms
    faults = list[str]()
    reaches, spans = limits_and_ranges(bare, limits, ranges, {}, faults)
    refuse(Fault(path, 0, 0, fault) for fault in faults)
    rig = OpenLoop(bare, reaches, spans, float(time[-1]))
    commands = rig.commands(bare, rig.usual_signals(time))
    played = {q.name: commands[with_place(q.name)] for q in inputs}
    units = {q.name: q.unit for group in signals for q in group}
    log = Log(path.with_suffix(".csv"), time, played, {}, units, step, units, {})
    with Worker(*REPLAY_MODULES) as worker, DriveApart(worker, log, path) as drive:
        log = replace(log, outputs=as_columns(drive.run(0, time.size - 1, {}), drive.outputs))
    subject = FmuSubject.of_fmu(probe_places(path, [log]).structure, [log], limits=Limits())
    candidates = _candidates(subject.loaded)
    _check_names(path, against, candidates)
    if not against:
        raise InputError.at(path, f"needs rivals: name them with --against ({', '.join(candidates)})")
    rivals, pairs = _rivals(subject, candidates, list(against), ())
    measured = tuple(q.name for q in subject.outputs)
    variables = {name: variable for variable, name in subject.names.items()}
    noise = {n: NOISE_SHARE * (subject.structure.scales.get(variables[n]) or 1.0) for n in measured}
    first = _first_outputs(log)
    return Question(subject.loaded, subject, rivals, pairs, measured, noise, {}, {}, first)


def _first_outputs(log: Log) -> dict[str, float]:
    """Return output → its first reading in a log, in names of the model."""
    readings = {with_place(n): values[np.isfinite(values)] for n, values in log.outputs.items()}
    return {name: float(values[0]) for name, values in readings.items() if values.size}


def _question_of_model(path: Path, loaded: LoadedModel, against: Sequence[str]) -> Question:
    """Return the specification of an experiment for a model.

    Args:
        against: Names of the rivals; by default all candidates that are hard to separate from the model's effects.
    """
    model = loaded.model
    base = ModelSubject(replace(loaded, model=replace(model, effects=())))
    candidates = _candidates(base.loaded)
    _check_names(path, against, candidates)
    own, groups = [e.name for e in model.awake], _groups(model, candidates)
    names = list(against) or sorted(set().union(*(g for g in groups if not g.isdisjoint(own))).difference(own))
    rivals, pairs = _rivals(base, candidates, names, groups)
    if own and names:  # compared with the active effects, at their values in the model
        free, values = tuple(f for n in own for f in candidates[n].free), ModelSubject(loaded).values
        present = Rival(" and ".join(own), {f.name: values[f.name] for f in free}, free)
        rivals = (present, *(r for r in rivals if r.name != BASE_RIVAL))
        pairs = tuple((present.name, name) for name in names)
    measured = model.measured or tuple(model.sensor_variance)
    return Question(loaded, base, rivals, pairs, measured or tuple(q.name for q in model.outputs), {}, {})


def _candidates(loaded: LoadedModel) -> dict[str, Candidate]:
    """Return all candidates of the model, assuming logs in which every input varies."""
    subject = ModelSubject(loaded)
    return {c.name: c for c in subject.candidates([q.name for q in subject.inputs])}


def _check_names(path: Path, names: Sequence[str], candidates: Mapping[str, Candidate]) -> None:
    unknown = [name for name in names if name not in candidates]
    faults = [f'no candidate "{name}"{did_you_mean(name, candidates)}' for name in unknown]
    faults += [f'"{name}" is named twice; name it once' for name in names if names.count(name) > 1]
    refuse(Fault(path, 0, 0, fault) for fault in faults)


def _groups(model: Model, candidates: Mapping[str, Candidate]) -> list[set[str]]:
    """Return the groups of candidates that the model declares hard to separate; by default one group of all."""
    groups = [{name for name in group if name in candidates} for group in model.told_apart_by]
    return [group for group in groups if len(group) > 1] or [set(candidates)]


def _rivals(
    subject: ModelSubject, candidates: Mapping[str, Candidate], names: Sequence[str], groups: Sequence[set[str]]
) -> tuple[tuple[Rival, ...], tuple[Pair, ...]]:
    """Return rivals of typical size, and the pairs of rivals to separate.

    A single named candidate is compared with the model without it. Without names, the groups supply the pairs.
    """
    if len(names) == 1:
        return (typical_rival(subject, candidates[names[0]]), Rival(BASE_RIVAL, {}, ())), ((names[0], BASE_RIVAL),)
    pairs = tuple(pair for group in ([names] if names else map(sorted, groups)) for pair in combinations(group, 2))
    rivals = dict.fromkeys(chain.from_iterable(pairs))
    return tuple(typical_rival(subject, candidates[name]) for name in rivals), pairs
