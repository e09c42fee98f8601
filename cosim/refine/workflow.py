"""Refine, in order: study → gate → recalibrate → try every candidate → verdict → refined model → FMU → replay again.

Functions explore, the FMU proves: the error before and after is measured on replays through the FMUs, and the
validation logs are opened when everything is decided.
"""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.files import atomic_write, check_writable
from cosim.refine.attribution import Attributor
from cosim.refine.candidates import candidates, neutral_values
from cosim.refine.fit import Problem
from cosim.refine.hypotheses import Attribution, Hypothesis
from cosim.refine.log import Log
from cosim.refine.measure import Evidence, Variant, noise_floor, predicted_errors, replays, rmse
from cosim.refine.model_file import HOVERCRAFT, LoadedModel, write_model
from cosim.refine.problem import build_problem, coarsened, varied_inputs
from cosim.refine.proof import proven, standing
from cosim.refine.record import OTHER_HORIZONS, Errors, Part, Record, effects, known, ranking, residual
from cosim.refine.sensor_noise import other_noise
from cosim.refine.study import Study, read_study
from cosim.refine.unnamed import unnamed_terms
from cosim.refine.verdict import Verdict, judge
from plant.quantities import parameters_of

if TYPE_CHECKING:
    from fmus.build import Recipe

FLOOR_SEED = 20121
RESULTS = ("model.yaml", "plant.fmu", "refine.json")  # in the order in which they are moved to their place
Progress = Callable[[str, float], None]
LogSets = dict[Part, Sequence[Log]]
Floors = dict[Part, dict[str, float]]
Replayed = dict[str, dict[Part, dict[float, Evidence]]]  # before, recalibrated, after → set of logs → horizon


@dataclass(frozen=True)
class Refinement:
    """What a study came to, with all that a report shows of it."""

    study: Study
    attribution: Attribution
    verdict: Verdict
    record: Mapping[str, Any]
    folder: Path
    problem: Problem
    variants: Mapping[str, Variant]
    evidence: Mapping[str, Mapping[Part, Evidence]]  # before, recalibrated, after → estimation, validation


def refine(path: Path, folder: Path, progress: Progress | None = None) -> Refinement:
    """Run a study; leaves refine.json, model.yaml and plant.fmu in `folder`, all or none of them. Raises InputError."""
    began = time.perf_counter()
    tell = progress or (lambda stage, share: None)
    tell("reading the logs", 0.0)
    study = read_study(path)
    check_writable(folder, (*RESULTS, "report.html"), study.files)
    model = study.loaded.model
    study, problem, noise = _posed(study)
    trial = candidates(model, problem.values, varied_inputs(model, study.logs))
    if study.content.candidates is not None:
        trial = [c for c in trial if c.name in study.content.candidates]
    attribution = Attributor(model, problem, trial, tell).run()
    tell("looking for what has no name", 0.0)
    nameless = build_problem(model, study.logs, unnamed=True, noise=noise, sensors=study.loaded.values)
    generated = problem.kernel.generated
    forced = [generated.states[generated.stochastic[k]] for k in generated.noisy]
    verdict = judge(
        attribution,
        unnamed_terms(coarsened(nameless, attribution.best.fit.values), attribution.best.fit),
        model,
        forced,
    )
    tell("replaying with the claim and without", 0.0)
    verdict = _proven(study, attribution, verdict, problem)
    if study.content.candidates is not None:
        verdict = replace(verdict, sentence=f"{verdict.sentence} (Tried: only what the study names as candidates.)")
    refined = refined_model(study.loaded, verdict.claimed)
    with tempfile.TemporaryDirectory(prefix=".refine-", dir=folder) as name:
        scratch = Path(name)
        write_model(scratch / "model.yaml", refined, folder)
        tell("building the refined FMU", 0.0)
        variants = _variants(study, attribution, verdict, refined, *_build_fmus(study.loaded, refined, scratch))
        tell("replaying through the FMUs", 0.0)
        validation: LogSets = {"validation": sealed} if (sealed := study.unseal()) else {}
        sets: LogSets = {"estimation": study.logs, **validation}
        replayed = _replayed(variants, problem, sets)
        tell("measuring the noise floor", 0.0)
        rng = np.random.default_rng(FLOOR_SEED)
        floors = {part: known(noise_floor(variants["after"], problem, logs, rng)) for part, logs in sets.items()}
        spent = time.perf_counter() - began
        record = _record(study, attribution, verdict, problem, replayed, floors, spent).model_dump(mode="json")
        with atomic_write(scratch / "refine.json") as stream:
            json.dump(record, stream, indent=2, ensure_ascii=False, allow_nan=False)
            stream.write("\n")
        variants = _publish(scratch, folder, variants)
    evidence = {name: {part: found[model.horizon] for part, found in parts.items()} for name, parts in replayed.items()}
    return Refinement(study, attribution, verdict, record, folder, problem, variants, evidence)


def _posed(study: Study) -> tuple[Study, Problem, dict[str, float]]:
    """The fitting problem, with the noise that is not the model's; what is to be known of that joins the warnings."""
    model, known, told = study.loaded.model, study.loaded.values, study.content.noise
    problem = build_problem(model, study.logs, noise=told, sensors=known)
    seen, warnings = other_noise(problem, model, told)
    noise = {**told, **seen}
    if seen:
        problem = build_problem(model, study.logs, noise=noise, sensors=known)
    return replace(study, warnings=(*study.warnings, *warnings)), problem, noise


def _proven(study: Study, a: Attribution, verdict: Verdict, problem: Problem) -> Verdict:
    """The verdict, its claim or that nothing is missing held against the error of replays of the estimation logs."""
    if verdict.claimed is None:
        if verdict.name != "no_effect":
            return verdict
        verdict = standing(verdict, a, study.loaded.model, *_replay_errors(study, a, verdict, problem))
        if verdict.claimed is None:
            return verdict
    return proven(verdict, *_replay_errors(study, a, verdict, problem))


def _replay_errors(
    study: Study, a: Attribution, verdict: Verdict, problem: Problem
) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Error of replays before, recalibrated and after, and the last's floor, by the kernel: nothing is built yet."""
    no_fmu = Path()
    variants = _variants(study, a, verdict, refined_model(study.loaded, verdict.claimed), no_fmu, no_fmu)
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    return error, noise_floor(variants["after"], problem, study.logs, np.random.default_rng(FLOOR_SEED))


def refined_model(loaded: LoadedModel, claimed: Hypothesis | None) -> LoadedModel:
    """The model with what was claimed put in, base parameters recalibrated with it; unchanged where nothing was.

    Errors of sensors alone leave its parameters as they are, and so its FMU.
    """
    if claimed is None:
        return loaded
    sensors = {f"{k.name}.{p.name}" for k in loaded.model.sensors for p in parameters_of(k)}
    moved = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free}
    parameters = dict(loaded.parameters)
    if not claimed.of_sensors:  # of which the plant knows nothing
        parameters |= {n: v for n, v in moved.items() if n not in sensors}
    known = {**loaded.sensors, **{n: v for n, v in moved.items() if n in sensors}}
    return LoadedModel(loaded.model.with_values(parameters), loaded.source, parameters, known)


def _publish(scratch: Path, folder: Path, variants: Mapping[str, Variant]) -> dict[str, Variant]:
    """Move the results to where they stay, refine.json last; an earlier report goes, which would tell of others."""
    (folder / "report.html").unlink(missing_ok=True)
    for name in RESULTS:
        (scratch / name).replace(folder / name)
    refined = scratch / "plant.fmu"
    return {n: replace(v, fmu=folder / refined.name) if v.fmu == refined else v for n, v in variants.items()}


def _build_fmus(loaded: LoadedModel, refined: LoadedModel, scratch: Path) -> tuple[Path, Path]:
    """FMUs of the model named in the study and of the refined one, which stays; where nothing changed it is both."""
    from fmus.build import build

    after = build(recipe_of(refined), scratch / "plant.fmu")
    return (after if refined is loaded else build(recipe_of(loaded), scratch / "given.fmu")), after


def recipe_of(loaded: LoadedModel) -> Recipe:
    """What makes the FMU of a model."""
    from fmus.build import model_recipe, plant_recipe

    if loaded.source == HOVERCRAFT:
        return plant_recipe(dict(loaded.parameters))
    return model_recipe(loaded.model, Path(loaded.source.rpartition(":")[0]), dict(loaded.parameters))


def _variants(
    study: Study, a: Attribution, verdict: Verdict, refined: LoadedModel, given_fmu: Path, refined_fmu: Path
) -> dict[str, Variant]:
    """The model before, recalibrated and after, each with the filter that starts its replays."""
    given, base = study.loaded, a.base.fit
    nominal = _values(given)
    recalibrated = {f.name: float(base.values[f.name]) for f in base.free}
    changed = given.model.with_values(recalibrated)
    before = after = Variant(given.model, nominal, base.log_q, given_fmu, {})
    if claimed := verdict.claimed:
        after = Variant(refined.model, _values(refined), claimed.fit.log_q, refined_fmu, {})
    return {
        "before": before,
        "recalibrated": Variant(changed, {**nominal, **recalibrated}, base.log_q, given_fmu, recalibrated),
        "after": after,
    }


def _values(loaded: LoadedModel) -> dict[str, float]:
    """Every number the kernel takes, sensors included."""
    return {**neutral_values(loaded.model), **loaded.values}


def _replayed(variants: Mapping[str, Variant], problem: Problem, sets: LogSets) -> Replayed:
    """Replays of every variant on every set of logs; a variant that stands for two is replayed once."""
    found: dict[int, dict[Part, dict[float, Evidence]]] = {}
    for variant in variants.values():
        if id(variant) not in found:
            horizons = list(OTHER_HORIZONS.values())
            found[id(variant)] = {part: replays(variant, problem, logs, horizons) for part, logs in sets.items()}
    return {name: found[id(variant)] for name, variant in variants.items()}


def _record(
    study: Study, a: Attribution, verdict: Verdict, problem: Problem, replayed: Replayed, floors: Floors, spent: float
) -> Record:
    """What refine.json holds."""
    own = study.loaded.model.horizon

    def errors(horizon: float) -> Errors:
        sizes = {
            name: {part: known(rmse(found[horizon])) for part, found in parts.items()}
            for name, parts in replayed.items()
        }
        return Errors(**sizes)

    return Record(
        study=str(study.path),
        verdict=verdict.name,
        sentence=verdict.sentence,
        effects=effects(study.loaded.model, verdict.claimed, a.tried) if verdict.claimed else [],
        rivals=list(verdict.rivals) if verdict.name == "ambiguous" else [],
        experiment=verdict.experiment,
        nearest=list(verdict.rivals) if verdict.name == "unexplained" else [],
        candidates=ranking(a, verdict),
        hidden=list(a.hidden),
        measured=[q.name for q in study.loaded.model.outputs if any(q.name in log.outputs for log in study.logs)],
        sensor_noise=dict(zip(problem.kernel.generated.outputs, np.sqrt(problem.r).tolist(), strict=True)),
        warnings=list(study.warnings),
        residual=residual(verdict),
        horizon=own if math.isfinite(own) else "free run",
        error=errors(own),
        horizons={name: errors(horizon) for name, horizon in OTHER_HORIZONS.items()},
        noise_floor=floors["validation" if "validation" in floors else "estimation"],
        noise_floors=floors,
        held_out_gain=a.held_out,
        seconds=spent,
    )
