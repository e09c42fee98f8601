"""Workflow of a refinement: study, gate, recalibration, candidates, verdict, refined model, FMU, replays.

Functions explore, the FMU proves: errors before and after are measured by FMU replays, and the validation logs are
opened after all decisions.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.base.errors import Fault, InputError
from cosim.estimation.fit import Fit
from cosim.estimation.per_log import drop_own_parameters
from cosim.estimation.posing import build_problem, coarsened, varied_inputs
from cosim.estimation.problem import Problem
from cosim.estimation.sensor_noise import at_rest, noise_warnings, sensor_noise
from cosim.loading.refined import ANSWER, NEAREST, REFINED
from cosim.refinement.decision.claims import Claims, Nearest, judge
from cosim.refinement.decision.evidence import best_of, beyond_chance, predicts, steadiness
from cosim.refinement.decision.judgement import BETTER, decided
from cosim.refinement.decision.sentences import calmer
from cosim.refinement.decision.trust import attributed
from cosim.refinement.proof.measure import FLOOR_SEED, followed, noise_floor, rmse
from cosim.refinement.proof.nearest import nearest
from cosim.refinement.proof.proof_replays import LogSets, Proof, warnings_of
from cosim.refinement.proof.refined_models import Variant, of_noise, refined_subject, variant_of, variants_of
from cosim.refinement.proof.replay_check import held_against_replays
from cosim.refinement.proof.sealed import Rise, risen
from cosim.refinement.proof.table_errors import errors_left_out, with_leftover
from cosim.refinement.record import Floors, Measured, Record, Replayed, keep_finite, record
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import Found
from cosim.refinement.search.hypotheses import Attribution
from cosim.refinement.search.input_hold import between_rows
from cosim.refinement.search.missing import unknown_inputs
from cosim.refinement.search.unnamed import Leftover, left_beside
from cosim.refinement.study import Study, read_study
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
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject, Workplace

RESULTS = (*REFINED, *NEAREST, ANSWER)  # in the order of their publication
Progress = Callable[[str, float], None]


@one_stop()
@folder_locks()
def refine(
    study: FilePath | Study,
    folder: FilePath,
    progress: Progress | None = None,
    *,
    report: bool = False,
    force: bool = True,
    keep: bool = False,
    in_process: bool = False,
) -> Refinement:
    """Refine the model of a study; write refine.json and the refined files to `folder`, all or none.

    A model gives model.yaml and plant.fmu.

    Args:
        study: Study file, or a study of any subject (`cosim.refinement.study.study_of`).
        report: Write report.html too.
        force: Overwrite results of another study or command.
        keep: Move the files of an earlier refinement to `runs` in the folder.
        in_process: Load FMUs into this process, for a debugger.

    Raises:
        InputError: The study or a log has faults.
        FmuError: An FMU cannot be loaded.
        SimulationError: An FMU fails in a replay.
    """
    began = time.perf_counter()
    progress = progress or (lambda stage, share: None)
    progress("reading the logs", 0.0)
    folder = named_path(folder)
    study = study if isinstance(study, Study) else read_study(Path(study))
    subject = study.subject
    check_left(folder, "cosim refine", *filter(None, [str(study.path or "")]), force=force, keep=keep)
    check_writable(folder, (*RESULTS, "report.html"), study.files)
    problem = _posed(study)
    _refuse_runaway(study, problem)
    found = attributed(subject, problem, _on_trial(study), progress)
    progress("weighing what was found", 0.0)
    attribution = decided(found)
    claims = _judged(study, attribution, found, progress)
    claims = _with_nearest(study, claims, found, attribution)
    between = between_rows(found.search.problem, attribution.base)
    warnings = [*noise_warnings(problem, attribution.best.fit.noise, subject), *between.warnings]
    limits = study.content.limits
    with scratch_folder(folder, ".refine-") as scratch, Workplace(scratch, limits, in_process=in_process) as place:
        progress("building the refined FMU", 0.0)
        variants = _variants(study, attribution, claims)
        files = [*variants["after"].subject.write(scratch, folder, "refined")]
        if "nearest" in variants:
            files += variants["nearest"].subject.write(scratch, folder, "nearest")
        progress("replaying through the FMUs", 0.0)
        sets = _unsealed(study)
        played, way = Proof(problem, sets, place).replayed(variants)
        progress("measuring the noise floor", 0.0)
        floors = _floors(of_noise(variants["after"], attribution, claims.claimed, found.heard), problem, sets)
        claims = replace(claims, risen=_rises(claims, played, subject), written=bool(files))
        ends = followed(variants["after"], problem, sets.get("validation", ()))
        hold_stops()  # From here, a result exists that must not be lost.
        warnings += [*warnings_of(way), *_too_calm(floors, played, subject)]
        study = replace(study, warnings=(*study.warnings, *warnings))
        measured = Measured(played, floors, way, ends, time.perf_counter() - began)
        written = record(study, attribution, claims, problem, between, measured)
        _write(scratch / ANSWER, written)
        with uninterrupted():
            if keep:
                keep_earlier(folder, "cosim refine")
            _publish(files, scratch / ANSWER, folder)
        release_stops()
    evidence = {name: {part: by[subject.horizon] for part, by in parts.items()} for name, parts in played.items()}
    content = written.model_dump(mode="json")
    outcome = Refinement(study, attribution, claims, content, folder, problem, variants, evidence)
    if report:
        from cosim.refinement.report.refine_page import write_refine_report

        progress("drawing the report", 0.0)
        write_refine_report(folder / "report.html", outcome)
    return outcome


def _posed(study: Study) -> Problem:
    """Return the fitting problem."""
    subject, given = study.subject, study.content.noise
    problem = build_problem(subject, study.logs, noise=given, settings=study.settings)
    guessed = {n: level for n, level in sensor_noise(problem).items() if n not in subject.sensor_variance}
    return problem.with_noise({n: level for n, level in guessed.items() if n not in given and level > 0.0})


def _refuse_runaway(study: Study, problem: Problem) -> None:
    """Raise InputError if the filter of the unfitted model diverges, since no estimate could follow."""
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
        text = f"{study.subject.title} runs away on this log: its prediction is not finite at t = {t:.6g} s"
        faults.append(Fault(log.path, 0, 0, f"{text}; {cure}"))
    if faults:
        raise InputError(faults)


def _on_trial(study: Study) -> list[Candidate]:
    """Return the candidates named by the study, or all."""
    subject, named = study.subject, study.content.candidates
    every = list(drop_own_parameters(subject.candidates(varied_inputs(subject, study.logs)), study.settings.per_log))
    return every if named is None else [c for c in every if c.name in named]


def _judged(study: Study, a: Attribution, found: Found, progress: Progress) -> Claims:
    """Return the answer from the residual beside the best hypothesis and from replays."""
    subject, search = study.subject, found.search
    progress("looking for what has no name", 0.0)
    bare = build_problem(subject, study.logs, True, study.content.noise, study.settings)
    trusted = search.problem.trusted
    coarse, scatter = coarsened(bare, a.best.fit.values), search.problem.scatter
    nameless = replace(coarse, sensing=a.best.fit.noise, trusted=trusted, scatter=scatter)
    units = {"time": "s", **{q.name: q.unit for q in subject.states}}
    units |= {f"command {q.name}": q.unit for q in subject.inputs}
    left = left_beside(nameless, a.best.fit, search.price, units)
    if left.fit is not None and not _follows(nameless, left, left.fit, a.best.fit, subject.horizon):
        left = replace(left, terms=(), fit=None, gain=0.0)
    problem = search.problem
    moves = unknown_inputs(problem, a.best.fit, a.noisy, units)
    claims = judge(a, left, subject, problem.layout.forced, moves, still=at_rest(problem))
    progress("replaying with the claim and without", 0.0)
    claims = held_against_replays(study, a, claims, found, problem)
    return with_leftover(claims, a, problem, subject) if subject.static else claims


def _follows(problem: Problem, left: Leftover, beside: Fit, alone: Fit, horizon: float) -> bool:
    """Return True if unnamed terms improve the fit over blocks or logs beyond chance."""
    if problem.trusted:
        return predicts(problem, horizon, beside, alone) >= best_of(BETTER, left.among)
    return steadiness(problem, beside, alone) >= beyond_chance(problem, beside, left.among)


def _with_nearest(study: Study, claims: Claims, found: Found, a: Attribution) -> Claims:
    """Return the claims with the nearest model, if incomplete, and held-out errors of a table."""
    if claims.grade != "claimed":
        close = {h.names: h for h in (a.best, found.best) if h.candidates}
        claims = replace(claims, nearest=Nearest(nearest(found.search, a, list(close.values()))))
    left_out = errors_left_out(found.search, a, claims) if found.search.problem.table else None
    return replace(claims, restricted=study.content.candidates is not None, left_out=left_out)


def _variants(study: Study, a: Attribution, claims: Claims) -> dict[str, Variant]:
    """Return the variants to replay: before, recalibrated, after, and the nearest if incomplete."""
    subject, settings, claimed, near = study.subject, study.settings, claims.claimed, claims.near
    refined = refined_subject(subject, settings, claimed)
    variants = variants_of(subject, settings, a, claimed, refined)
    if claims.nearest is not None:
        other = refined_subject(subject, settings, near)
        of_other = variant_of(other, settings, near.fit if near else a.given)
        variants["nearest"] = variants["after"] if near is claimed else of_other
    return variants


def _unsealed(study: Study) -> LogSets:
    """Return the study's logs; validation logs are opened here."""
    sealed = study.unseal()
    return {"estimation": study.logs, "validation": sealed} if sealed else {"estimation": study.logs}


def _floors(quiet: Variant, problem: Problem, sets: LogSets) -> Floors:
    """Return the noise floor of each set of logs, from a fixed seed for reproducible results."""
    rng = np.random.default_rng(FLOOR_SEED)
    return {part: noise_floor(quiet, problem, logs, rng) for part, logs in sets.items()}


def _rises(claims: Claims, replayed: Replayed, subject: Subject) -> Mapping[str, Rise]:
    """Return the errors that rise on sealed logs with the claim, or with the nearest model."""
    variant = "after" if claims.claimed is not None else "nearest"
    if "validation" not in replayed["before"] or variant not in replayed:
        return {}
    before, after = (replayed[name]["validation"][subject.horizon] for name in ("before", variant))
    return risen(before, after)


def _too_calm(floors: Floors, replayed: Replayed, subject: Subject) -> Iterator[str]:
    """Warn of a noise floor above the error."""
    units = {q.name: q.unit for q in subject.outputs}
    for part, floor in floors.items():
        if found := floor.above(keep_finite(rmse(replayed["after"][part][subject.horizon]))):
            yield calmer(part, found, units)


def _write(path: Path, written: Record) -> None:
    """Write refine.json."""
    with atomic_write(path) as stream:
        json.dump(written.model_dump(mode="json"), stream, indent=2, ensure_ascii=False, allow_nan=False)
        stream.write("\n")


def _publish(files: Sequence[Path], answer: Path, folder: Path) -> None:
    """Move the results to the folder, refine.json last; delete an outdated report."""
    for name in {"report.html", *RESULTS} - {path.name for path in (*files, answer)}:
        (folder / name).unlink(missing_ok=True)  # from an earlier study
    for path in (*files, answer):
        path.replace(folder / path.name)
