"""Refine, in order: study → gate → recalibrate → try every candidate → verdict → refined model → FMU → replay again.

Functions explore, the FMU proves: the error before and after is measured on replays through the FMUs, and the
validation logs are opened when everything is decided.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cosim.base.errors import Fault, InputError
from cosim.estimation.candidates import Candidate, candidates
from cosim.estimation.fit import Fit
from cosim.estimation.per_log import not_per_log
from cosim.estimation.posing import build_problem, coarsened, varied_inputs
from cosim.estimation.problem import Problem
from cosim.estimation.sensor_noise import at_rest, noise_warnings, sensor_noise
from cosim.fmi.fmu_build import build
from cosim.isolation.process import Worker
from cosim.loading.file import LoadedModel, write_model
from cosim.loading.refined import ANSWER, NEAREST, REFINED
from cosim.model.model import Model
from cosim.refinement.decision.evidence import best_of, beyond_chance, predicts, steadiness
from cosim.refinement.decision.judgement import BETTER, decided
from cosim.refinement.decision.sentences import calmer, holds, rises
from cosim.refinement.decision.trust import attributed
from cosim.refinement.decision.verdict import Verdict, judge
from cosim.refinement.proof.measure import FLOOR_SEED, followed, noise_floor, rmse
from cosim.refinement.proof.native_replay import LogSets, Replayer, replayed, warnings_of
from cosim.refinement.proof.nearest import nearest
from cosim.refinement.proof.refined_models import Variant, of_noise, refined_model, variant_of, variants_of
from cosim.refinement.proof.replay_check import held_against_replays
from cosim.refinement.proof.sealed import risen
from cosim.refinement.proof.table_errors import errors_left_out, on_rows_left_out, with_leftover
from cosim.refinement.record import Floors, Record, Replayed, known, record
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import Found
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.refinement.search.input_hold import between_rows
from cosim.refinement.search.missing import unknown_inputs
from cosim.refinement.search.unnamed import Leftover, left_beside
from cosim.refinement.study import Study, read_study
from cosim.residuals.remote_drive import MODULES
from cosim.storage.files import (
    FilePath,
    atomic_write,
    check_writable,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    scratch_folder,
    uninterrupted,
)
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_left, keep_earlier

RESULTS = (*REFINED, *NEAREST, ANSWER)  # in the order in which they are moved to their place
Progress = Callable[[str, float], None]


@one_stop()
@folder_locks()
def refine(
    path: FilePath,
    folder: FilePath,
    progress: Progress | None = None,
    *,
    report: bool = False,
    force: bool = True,
    keep: bool = False,
    in_process: bool = False,
) -> Refinement:
    """Run a study; leaves refine.json, model.yaml and plant.fmu in `folder`, all or none of them.

    With `report`, report.html too. force: also over what another study or command left there.
    keep: the files of an earlier refine move to `runs` in the folder.
    in_process: FMUs are loaded into this process, for a debugger.
    Raises InputError, FmuError; SimulationError where an FMU fails.
    """
    began = time.perf_counter()
    progress = progress or (lambda stage, share: None)
    progress("reading the logs", 0.0)
    folder = named_path(folder)
    study = read_study(Path(path))
    check_left(folder, "cosim refine", str(path), force=force, keep=keep)
    check_writable(folder, (*RESULTS, "report.html"), study.files)
    problem = _posed(study)
    _refuse_runaway(study, problem)
    found = attributed(study.loaded.model, problem, _on_trial(study, problem), progress)
    progress("weighing what was found", 0.0)
    attribution = decided(found)
    verdict = _judged(study, attribution, found, progress)
    noted = noise_warnings(problem, attribution.best.fit.noise, study.loaded.model)
    between = between_rows(found.search.problem, attribution.base)
    study = replace(study, warnings=(*study.warnings, *noted, *between.warnings))
    near = _nearest(found, attribution, verdict)
    left_out = errors_left_out(found.search, attribution, verdict, near) if problem.table else None
    verdict = _in_full(study, verdict, near, left_out)
    with scratch_folder(folder, ".refine-") as scratch:
        progress("building the refined FMU", 0.0)
        variants, given = _models(study, attribution, verdict, near, folder, scratch)
        progress("replaying through the FMUs", 0.0)
        sets = _unsealed(study)
        with nullcontext() if in_process else Worker(*MODULES) as worker:
            replayer = Replayer(problem, sets, worker, study.content.limits)
            played, way = replayed(replayer, study.loaded, variants, partial(_built, study.loaded, given), scratch)
        progress("measuring the noise floor", 0.0)
        floors = _floors(of_noise(variants["after"], attribution, verdict.claimed, found.heard), problem, sets)
        study = replace(
            study, warnings=(*study.warnings, *warnings_of(way), *_too_calm(floors, played, study.loaded.model))
        )
        verdict = _opened(verdict, played, study)
        ends = followed(variants["after"], problem, sets.get("validation", ()))
        hold_stops()  # there is an answer to be kept
        took = time.perf_counter() - began
        written = record(study, attribution, verdict, near, problem, between, played, floors, left_out, took, ends, way)
        _write(scratch / "refine.json", written)
        with uninterrupted():
            if keep:
                keep_earlier(folder, "cosim refine")
            variants = _publish(scratch, folder, variants)
        release_stops()
    own = study.loaded.model.horizon
    evidence = {name: {part: found[own] for part, found in parts.items()} for name, parts in played.items()}
    content = written.model_dump(mode="json")
    outcome = Refinement(study, attribution, verdict, content, folder, problem, variants, evidence)
    if report:
        from cosim.refinement.report.refine_page import write_refine_report

        progress("drawing the report", 0.0)
        write_refine_report(folder / "report.html", outcome)
    return outcome


def _posed(study: Study) -> Problem:
    """The fitting problem."""
    loaded, given = study.loaded, study.content.noise
    problem = build_problem(loaded.model, study.logs, False, given, loaded.values, study.settings)
    guessed = {n: level for n, level in sensor_noise(problem).items() if n not in loaded.model.sensor_variance}
    return problem.with_noise({n: level for n, level in guessed.items() if n not in given and level > 0.0})


def _refuse_runaway(study: Study, problem: Problem) -> None:
    """InputError if the filter of the model diverges on a log before anything is fitted: no estimate can follow."""
    faults = []
    for index, (log, data) in enumerate(zip(study.logs, problem.logs, strict=False)):
        by_log = problem.scored(problem.values, problem.plain, [index]).by_log
        if np.isfinite(by_log).all():
            continue
        errors, variances = problem.innovations(problem.values, problem.plain, index)
        with np.errstate(over="ignore", invalid="ignore"):
            lost = ~np.isfinite(errors * errors / variances) & problem.readings[index].scored
        t = data.start + data.step * int(np.argmax(lost.any(axis=1)))
        cure = "check its parameters, start values and the units of the log, or state a shorter substep in its class"
        text = f"{study.loaded.model.title} runs away on this log: its prediction is not finite at t = {t:.6g} s"
        faults.append(Fault(log.path, 0, 0, f"{text}; {cure}"))
    if faults:
        raise InputError(faults)


def _on_trial(study: Study, problem: Problem) -> list[Candidate]:
    """The candidates that the study names; all of them where it names none."""
    model, named = study.loaded.model, study.content.candidates
    every = candidates(model, problem.values, varied_inputs(model, study.logs))
    every = list(not_per_log(every, study.settings.per_log))
    return every if named is None else [c for c in every if c.name in named]


def _judged(study: Study, a: Attribution, found: Found, progress: Progress) -> Verdict:
    """The verdict: by what is left beside the best hypothesis, then by replays."""
    model, loaded, search = study.loaded.model, study.loaded, found.search
    progress("looking for what has no name", 0.0)
    bare = build_problem(model, study.logs, True, study.content.noise, loaded.values, study.settings)
    trusted = search.problem.trusted
    coarse, scatter = coarsened(bare, a.best.fit.values), search.problem.scatter
    nameless = replace(coarse, sensing=a.best.fit.noise, trusted=trusted, scatter=scatter)
    units = {"time": "s", **{q.name: q.unit for q in model.states}}
    units |= {f"command {q.name}": q.unit for q in model.inputs}
    left = left_beside(nameless, a.best.fit, search.price, units)
    if left.fit is not None and not _follows(nameless, left, left.fit, a.best.fit, model.horizon):
        left = replace(left, terms=(), fit=None, gain=0.0)
    problem = search.problem
    moves = unknown_inputs(problem, a.best.fit, a.noisy, units)
    verdict = judge(a, left, model, problem.layout.forced, moves, still=at_rest(problem))
    progress("replaying with the claim and without", 0.0)
    verdict = held_against_replays(study, a, verdict, found, problem)
    return with_leftover(verdict, a, problem, model) if model.static else verdict


def _follows(problem: Problem, left: Leftover, beside: Fit, alone: Fit, horizon: float) -> bool:
    """What is left follows a signal from block to block of time, or from log to log, more than chance would have it."""
    if problem.trusted:
        return predicts(problem, horizon, beside, alone) >= best_of(BETTER, left.among)
    return steadiness(problem, beside, alone) >= beyond_chance(problem, beside, left.among)


def _nearest(found: Found, a: Attribution, verdict: Verdict) -> Hypothesis | None:
    """What the nearest model has; the claim where all is claimed."""
    if verdict.grade == "claimed":
        return verdict.claimed
    close = {h.names: h for h in (a.best, found.best) if h.candidates}
    return nearest(found.search, a, list(close.values()))


def _in_full(
    study: Study, verdict: Verdict, near: Hypothesis | None, left_out: Mapping[str, dict[str, float]] | None
) -> Verdict:
    """The verdict, its sentence followed by what the nearest model holds, what was tried, errors on rows left out."""
    said = [verdict.sentence]
    if verdict.grade != "claimed":
        said.append(holds(near.names if near else (), fitted=near is not None))
    if study.content.candidates is not None:
        said.append("(Tried: only what the study names as candidates.)")
    if left_out:
        said.append(on_rows_left_out(left_out, verdict, study.loaded.model))
    return replace(verdict, sentence=" ".join(said))


def _models(
    study: Study, a: Attribution, verdict: Verdict, near: Hypothesis | None, folder: Path, scratch: Path
) -> tuple[dict[str, Variant], Path]:
    """The refined model and its FMU, the nearest too where not all is claimed: what is replayed.

    And the place of the FMU of the model that was given, which is built when it is needed.
    """
    refined, nearer = refined_model(study, verdict.claimed), refined_model(study, near)
    write_model(scratch / "model.yaml", refined, folder)
    after, variant = build(refined.recipe(), scratch / "plant.fmu"), None
    fmus = (after if refined is study.loaded else scratch / "given.fmu"), after
    if verdict.grade != "claimed":
        write_model(scratch / "nearest.yaml", nearer, folder)
        variant = _nearest_variant(study, a, verdict, near, nearer, fmus, scratch)
    variants = variants_of(study, a, verdict.claimed, refined, fmus, variant)
    if variant is not None and variant.fmu == fmus[1]:
        variants["nearest"] = variants["after"]
    return variants, fmus[0]


def _nearest_variant(
    study: Study,
    a: Attribution,
    verdict: Verdict,
    near: Hypothesis | None,
    nearer: LoadedModel,
    fmus: tuple[Path, Path],
    scratch: Path,
) -> Variant:
    """The nearest model and its FMU: a copy of another's where it is the same."""
    same = {id(verdict.claimed): fmus[1], id(None): fmus[0]}.get(id(near))
    target = scratch / "nearest.fmu"
    if same is not None and same.is_file():
        shutil.copyfile(same, target)
    else:
        build(nearer.recipe(), target)
    return variant_of(study, nearer, near.fit if near else a.given, same or target)


def _built(loaded: LoadedModel, given: Path) -> None:
    """Have the FMU in Python of the model that was given, which none but replays in Python need."""
    if not given.is_file():
        build(loaded.recipe(), given)


def _unsealed(study: Study) -> LogSets:
    """The logs of the study; those of validation, where there are any, are opened here."""
    sealed = study.unseal()
    return {"estimation": study.logs, "validation": sealed} if sealed else {"estimation": study.logs}


def _floors(quiet: Variant, problem: Problem, sets: LogSets) -> Floors:
    """What noise alone leaves of each set's errors; from one seed, so that a study gives the same again."""
    rng = np.random.default_rng(FLOOR_SEED)
    return {part: noise_floor(quiet, problem, logs, rng) for part, logs in sets.items()}


def _opened(verdict: Verdict, replayed: Replayed, study: Study) -> Verdict:
    """The verdict, whose sentence begins with an error that rises on the sealed logs. They change nothing else."""
    model = study.loaded.model
    variant, file = ("after", REFINED[0]) if verdict.claimed is not None else ("nearest", NEAREST[0])
    if "validation" not in replayed["before"] or variant not in replayed:
        return verdict
    before, after = (replayed[name]["validation"][model.horizon] for name in ("before", variant))
    said = rises(risen(before, after), {q.name: q.unit for q in model.outputs}, file)
    return replace(verdict, sentence=f"{said} {verdict.sentence}") if said else verdict


def _too_calm(floors: Floors, replayed: Replayed, model: Model) -> Iterator[str]:
    """Where a floor is above the error."""
    units = {q.name: q.unit for q in model.outputs}
    for part, floor in floors.items():
        if found := floor.above(known(rmse(replayed["after"][part][model.horizon]))):
            yield calmer(part, found, units)


def _write(path: Path, written: Record) -> None:
    """refine.json."""
    with atomic_write(path) as stream:
        json.dump(written.model_dump(mode="json"), stream, indent=2, ensure_ascii=False, allow_nan=False)
        stream.write("\n")


def _publish(scratch: Path, folder: Path, variants: Mapping[str, Variant]) -> dict[str, Variant]:
    """Move the results to where they stay, refine.json last; an earlier report goes: it is of other results."""
    (folder / "report.html").unlink(missing_ok=True)
    for name in RESULTS:
        if (scratch / name).is_file():
            (scratch / name).replace(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)  # an earlier study's
    kept = {scratch / name: folder / name for name in ("plant.fmu", "nearest.fmu")}
    return {n: replace(v, fmu=kept.get(v.fmu, v.fmu)) for n, v in variants.items()}
