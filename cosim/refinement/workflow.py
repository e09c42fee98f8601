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
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cosim.files import atomic_write, check_writable
from cosim.logs.log import Log
from cosim.models.file import LoadedModel, write_model
from cosim.refinement.attribution import Attributor
from cosim.refinement.candidates import candidates
from cosim.refinement.hypotheses import Attribution
from cosim.refinement.measure import FLOOR_SEED, Evidence, noise_floor, predicted_errors, replays, rmse
from cosim.refinement.outcome import Refinement
from cosim.refinement.problem import Problem, build_problem, coarsened, varied_inputs
from cosim.refinement.proof import proven, standing
from cosim.refinement.record import OTHER_HORIZONS, Errors, Part, Record, effects, known, ranking, residual
from cosim.refinement.sensor_noise import other_noise
from cosim.refinement.study import Study, read_study
from cosim.refinement.unnamed import unnamed_terms
from cosim.refinement.variants import Variant, _variants, refined_model
from cosim.refinement.verdict import Verdict, judge

if TYPE_CHECKING:
    pass

RESULTS = ("model.yaml", "plant.fmu", "refine.json")  # in the order in which they are moved to their place
Progress = Callable[[str, float], None]
LogSets = dict[Part, Sequence[Log]]
Floors = dict[Part, dict[str, float]]
Replayed = dict[str, dict[Part, dict[float, Evidence]]]  # before, recalibrated, after → set of logs → horizon


def refine(path: Path, folder: Path, progress: Progress | None = None, *, report: bool = False) -> Refinement:
    """Run a study; leaves refine.json, model.yaml and plant.fmu in `folder`, all or none of them. Raises InputError.

    With `report`, report.html too.
    """
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
    layout = problem.layout
    forced = layout.forced
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
    found = Refinement(study, attribution, verdict, record, folder, problem, variants, evidence)
    if report:
        from cosim.refinement.report.page import write_refine_report

        write_refine_report(folder / "report.html", found)
    return found


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

    after = build(refined.recipe(), scratch / "plant.fmu")
    return (after if refined is loaded else build(loaded.recipe(), scratch / "given.fmu")), after


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
        sensor_noise=dict(zip(problem.layout.outputs, np.sqrt(problem.r).tolist(), strict=True)),
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
