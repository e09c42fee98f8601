"""Purpose of an experiment: model, rivals, measured outputs and limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from cosim.base.errors import Fault, InputError, refuse
from cosim.experiment.ranges import allowed, inputs_to_limit, seen_in
from cosim.experiment.rigs import Ranges
from cosim.experiment.separation import Pair, Rival, all_pairs, at_typical
from cosim.loading.file import LoadedModel, load_model
from cosim.loading.refined import names_refine
from cosim.loading.substep import with_substep
from cosim.logs.log import read_log
from cosim.model.model import Model
from cosim.refinement.decision.judgement import SIGNIFICANT
from cosim.refinement.search.hypotheses import TOGETHER
from cosim.refinement.study import StudyFile
from cosim.storage.kinds import ANSWER, CODE, MODEL, check_form, check_given
from cosim.storage.yaml_file import YamlFile, did_you_mean
from cosim.subject.candidates import Candidate
from cosim.subject.model_subject import ModelSubject

NOTHING = "nothing"


@dataclass(frozen=True)
class Question:
    """Rivals and the pairs to separate.

    Attributes:
        loaded: Model under test.
        base: Model from which the rivals differ, used for the filter.
        measured: Logged outputs; `noise` holds standard deviations that differ from the model's.
        limits: Largest excursion of an input or output from its start.
        ranges: Input → least and largest command, declared, requested, or observed in logs.
    """

    loaded: LoadedModel
    base: LoadedModel
    rivals: tuple[Rival, ...]
    pairs: tuple[Pair, ...]
    measured: tuple[str, ...]
    noise: Mapping[str, float]
    limits: Mapping[str, float]
    ranges: Ranges = field(default_factory=dict)

    def model_if(self, rival: Rival) -> Model:
        """Return the model under a rival hypothesis; sensor errors do not change the model."""
        sensors = {k.name for k in self.base.model.sensors}
        return self.base.model.with_values({n: v for n, v in rival.values.items() if n.split(".")[0] not in sensors})


class Ranked(BaseModel):
    """A hypothesis in refine.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    names: list[str]
    parameters: dict[str, float]
    fitted: bool
    log_likelihood_gain: float | None


class Refined(BaseModel):
    """Required part of a refine.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

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
) -> Question:
    """Return the question for `base`, a model file, or a refine.json (or its folder).

    Raises:
        InputError: An argument has faults, or the model has no states.
    """
    path, question = _posed(text, against)
    model, faults = question.base.model, list[str]()
    if model.static:
        told = "told_apart_by says what rows would separate rivals"
        raise InputError([Fault(path, 0, 0, f"{model.title} has no states, so no input over time tells more; {told}")])
    far, spans = allowed(model, limits, ranges, question.ranges, faults)
    outputs = [q.name for q in model.outputs]
    faults += [f'--measured: no output "{n}"{did_you_mean(n, outputs)}' for n in measured if n not in outputs]
    seen = tuple(n for n in outputs if n in (measured or question.measured))
    if not seen and not faults:
        faults.append(f"it does not say what is measured; say --measured NAME, of {', '.join(outputs)}")
    refuse(Fault(path, 0, 0, fault) for fault in faults)
    return replace(question, limits=far, ranges=spans, measured=seen)


def _posed(text: str, against: Sequence[str]) -> tuple[Path, Question]:
    """Return the file and its question."""
    path = Path(text)
    if path.exists() and not names_refine(path) and ".py:" not in text:
        (check_given if path.suffix == ".json" else check_form)(path, ANSWER, MODEL, CODE)
    if (folder := refinement_folder(text)) and path.exists():
        path = folder / "refine.json" if path.is_dir() else path
        return path, _of_refinement(path, against)
    return path, _of_model(path, with_substep(load_model(text, Path()))[0], against)


def refinement_folder(text: str) -> Path | None:
    """Return the folder of a refinement, or None."""
    path = Path(text)
    return path if path.is_dir() else path.parent if path.suffix == ".json" else None


def _of_refinement(path: Path, against: Sequence[str]) -> Question:
    """Return the question of a refinement, with fitted rivals, or typical ones if invisible."""
    yaml = YamlFile(path)
    content = yaml.validate(Refined)
    study = Path(content.study)
    if not study.is_file():
        raise InputError([yaml.fault(("study",), f"no such study: {study}; it is looked for from where you are")])
    yaml = YamlFile(study)
    given = yaml.validate(StudyFile)
    loaded, _ = with_substep(load_model(given.model, study.parent, yaml))
    known = _candidates(loaded)
    names = list(against) or [n for n in content.rivals if n != "no_effect"]
    together = {name: tuple(name.split(TOGETHER)) for name in names if TOGETHER in name}
    if together:
        _check_names(path, list(dict.fromkeys(n for name in names for n in together.get(name, (name,)))), known)
        fitted = tuple(_together(name, together.get(name, (name,)), content, known) for name in names)
        pairs: Sequence[Pair] = all_pairs(names)
    else:
        _check_names(path, names, known)
        rivals, pairs = _rivals(loaded, known, names)
        values = ModelSubject(loaded).values
        fitted = tuple(_as_fitted(r, names, content, known, values) for r in rivals)
    noise, seen = {**content.sensor_noise, **given.noise}, _read_logged_ranges(loaded.model, study.parent, given)
    return Question(loaded, loaded, fitted, tuple(pairs), tuple(content.measured), noise, {}, seen)


def _together(text: str, names: Sequence[str], found: Refined, known: Mapping[str, Candidate]) -> Rival:
    """Return a rival of several candidates."""
    h = next((h for h in found.candidates if set(h.names) == set(names)), None)
    return Rival(text, h.parameters if h else {}, tuple(f for n in names for f in known[n].free))


def _read_logged_ranges(model: Model, folder: Path, study: StudyFile) -> Ranges:
    """Return undeclared input ranges from a study's logs.

    Missing logs are skipped.
    """
    if not inputs_to_limit(model):
        return {}
    logs = []
    for name in study.logs.estimation:
        try:
            logs.append(read_log(folder / name, model.inputs, model.outputs, columns=study.columns))
        except InputError:
            continue
    return seen_in(logs)


def _as_fitted(
    r: Rival, names: Sequence[str], found: Refined, known: Mapping[str, Candidate], values: Mapping[str, float]
) -> Rival:
    """Return a rival as fitted without the other rivals, or unchanged if invisible.

    An invisible rival was fitted to noise, usually to neutral, where no input could separate it.
    """
    others = set(names) - {r.name}
    for h in found.candidates:
        if r.name in h.names and not others.intersection(h.names) and _shown(known[r.name], h, found, values):
            return Rival(r.name, h.parameters, tuple(f for n in h.names for f in known[n].free))
    return r


def _shown(c: Candidate, h: Ranked, found: Refined, values: Mapping[str, float]) -> bool:
    """Return True if a candidate is fitted, within its limits, and significant."""
    if c.name in found.hidden or not h.fitted or h.log_likelihood_gain is None:
        return False
    if any(h.parameters[f.name] in (f.low, f.high) and h.parameters[f.name] != values[f.name] for f in c.free):
        return False
    rest = set(h.names) - {c.name}
    without = max((o.log_likelihood_gain or 0.0 for o in found.candidates if rest.issuperset(o.names)), default=0.0)
    return h.log_likelihood_gain - without > 0.5 * SIGNIFICANT**2


def _of_model(path: Path, loaded: LoadedModel, against: Sequence[str]) -> Question:
    """Return the question of a model: named rivals, or the model's effects."""
    model = loaded.model
    base = replace(loaded, model=replace(model, effects=()))
    known = _candidates(base)
    _check_names(path, against, known)
    own = [e.name for e in model.awake]
    names = list(against) or sorted(_beside({*own}, _groups(loaded.model, known)))
    rivals, pairs = _rivals(base, known, names)
    if own and names:
        free = tuple(f for n in own for f in known[n].free)
        values = ModelSubject(loaded).values
        held = Rival(" and ".join(own), {f.name: values[f.name] for f in free}, free)
        rivals, pairs = (held, *(r for r in rivals if r.name != NOTHING)), tuple((held.name, name) for name in names)
    measured = model.measured or tuple(model.sensor_variance)
    return Question(loaded, base, rivals, pairs, measured or tuple(q.name for q in model.outputs), {}, {})


def _beside(own: set[str], groups: Sequence[set[str]]) -> set[str]:
    """Return names hard to separate from the effects of a model."""
    return {name for group in groups if group & own for name in group - own}


def _candidates(loaded: LoadedModel) -> dict[str, Candidate]:
    """Return all candidates, with all inputs regarded as varied."""
    subject = ModelSubject(loaded)
    return {c.name: c for c in subject.candidates([q.name for q in subject.inputs])}


def _check_names(path: Path, names: Sequence[str], known: Mapping[str, Candidate]) -> None:
    faults = [f'no candidate "{name}"{did_you_mean(name, known)}' for name in names if name not in known]
    faults += [f'"{name}" is named twice' for name in dict.fromkeys(names) if list(names).count(name) > 1]
    refuse(Fault(path, 0, 0, fault) for fault in faults)


def _groups(model: Model, known: Mapping[str, Candidate]) -> list[set[str]]:
    """Return groups hard to separate, as declared by the model, else one group."""
    return [g for group in model.told_apart_by if len(g := set(group) & known.keys()) > 1] or [set(known)]


def _rivals(
    loaded: LoadedModel, known: Mapping[str, Candidate], names: Sequence[str]
) -> tuple[tuple[Rival, ...], tuple[Pair, ...]]:
    """Return typical rivals and their pairs.

    A single name is compared with nothing; without names, the usual pairs count.
    """
    subject = ModelSubject(loaded)
    if len(names) == 1:
        return (at_typical(subject, known[names[0]]), Rival(NOTHING, {}, ())), ((names[0], NOTHING),)
    pairs = (
        all_pairs(names) if names else [p for group in _groups(loaded.model, known) for p in all_pairs(sorted(group))]
    )
    taken = dict.fromkeys(name for pair in pairs for name in pair)
    return tuple(at_typical(subject, known[name]) for name in taken), tuple(pairs)
