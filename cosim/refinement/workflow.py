"""Workflow of a refinement: study, checks of logs, recalibration, search, verdict, refined model, FMU, replays.

Fits use compiled filters, but errors before and after are measured by replays through the FMU. Validation logs are
opened after all decisions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import CosimError, Fault, TimedOut, refuse
from cosim.core.messages import Note
from cosim.core.text import counted, join_names, showing
from cosim.credibility.record import attach
from cosim.estimation.fit import Fit, initial_fit
from cosim.estimation.posing import (
    build_problem,
    noise_levels,
    noise_warnings,
    with_likely_starts,
)
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate, drop_own_parameters
from cosim.estimation.subject.interface import Workplace
from cosim.files.files import (
    FilePath,
    check_writable,
    delay_stops,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    scratch_folder,
    write_json,
)
from cosim.files.folders import remove_earlier
from cosim.fmi.building.refined import NEAREST, REFINE_RECORD, REFINED
from cosim.isolation.limits import Limits
from cosim.refinement.decision.bundle import between_rows, fit_given_model
from cosim.refinement.decision.claims import Claims, claims_of, sentence
from cosim.refinement.proof.measure import (
    FLOOR_SEED,
    Floors,
    LogSets,
    Replays,
    Variant,
    credibility_of,
    find_rises,
    log_noise,
    noise_floor,
    refined_variant,
    remaining_on_sealed_logs,
    replay_variants,
    variant_of,
)
from cosim.refinement.record import record, unfinished
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.attribution import attribute
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.refinement.stages import Watcher, report_ranking
from cosim.refinement.study import Study, read_study, untested_effects

Progress = Callable[[str, float], None]
FILES_OF = {"after": REFINED[1], "nearest": NEAREST[1]}  # file of the FMU of a variant


@one_stop()
def refine(
    study: FilePath | Study,
    folder: FilePath,
    progress: Progress | None = None,
    *,
    report: bool = False,
    in_process: bool = False,
    limits: str = "",
    tell: Callable[[str], None] = lambda text: None,
) -> Refinement:
    """Refine the model of a study; write refine.json and the refined files to `folder`, all of them or none.

    For a model, the files are model.yaml and plant.fmu. They replace files of an earlier refinement. If a time limit
    stops the search, only refine.json is written, with the hypotheses so far and without a verdict.

    Args:
        study: Study file, or a study of any subject (`cosim.refinement.study.study_of`).
        report: Write report.html too.
        in_process: Load FMUs into this process, for a debugger.
        limits: Limits that replace those of the study file, such as `step: 10 s, total: 10 min`.
        tell: Function that shows a note before the search.

    Raises:
        InputError: The study or a log has faults.
        FmuError: An FMU cannot be loaded.
        SimulationError: An FMU fails in a replay, or the search exceeds `limits: total` of the study.
    """
    start = time.perf_counter()
    progress = progress or (lambda stage, share: None)
    progress("reading the logs", 0.0)
    folder = named_path(folder)
    study = study if isinstance(study, Study) else read_study(Path(study), limits)
    untested = untested_effects(study)
    if untested:
        tell(Note(f"not tested: {'; '.join(untested)}"))
    limited = _Limited(progress, study.content.limits, start)
    check_writable(folder, (*REFINED, *NEAREST, REFINE_RECORD, "report.html"), study.files)
    problem = _build_problem(study)
    refuse(_divergences(study, problem))
    subject = study.subject
    with showing({"display": subject.display}):
        try:
            search = attribute(subject, problem, _candidates(study), limited)
            limited("computing posterior probabilities", 0.0)
            claims = claims_of(study, search, limited)
        except TimedOut:
            remove_earlier(folder, read=study.files)
            write_json(folder / REFINE_RECORD, unfinished(study, limited.tried), allow_nan=False)
            raise
        gain_otherwise, otherwise = between_rows(search.problem, claims.base)
        unfitted = fit_given_model(search.problem, claims.base.fit)
        noise = log_noise(claims.best.fit.noise, search.free_noise)
        warnings = [*noise_warnings(problem, noise, subject), *([otherwise] if otherwise else [])]
        allowed = study.content.limits
        with scratch_folder(folder, ".refine-") as scratch, Workplace(scratch, allowed, in_process=in_process) as place:
            progress("building the refined FMU", 0.0)
            variants = _variants(search, claims, unfitted)
            files = [*variants["after"].subject.write(scratch, folder, "refined")]
            if "nearest" in variants:
                files += variants["nearest"].subject.write(scratch, folder, "nearest")
            progress("replaying through the FMUs", 0.0)
            sealed = study.unseal()  # after all decisions
            sets: LogSets = {"estimation": study.logs, "validation": sealed} if sealed else {"estimation": study.logs}
            played, way = replay_variants(variants, problem, sets, place)
            progress("measuring the noise floor", 0.0)
            delivered = "after" if claims.claimed is not None else "nearest"
            best = variants.get(delivered, variants["after"])
            quiet = replace(best, noise=log_noise(claims.delivered.fit.noise, search.free_noise))
            rng = np.random.default_rng(FLOOR_SEED)  # fixed for reproducible results
            floors: Floors = {part: noise_floor(quiet, problem, logs, rng) for part, logs in sets.items()}
            progress("measuring error bands", 0.0)
            records = {}
            for name, h in {"after": claims.claimed, "nearest": claims.nearest}.items():
                file = scratch / FILES_OF[name]
                if name in variants and file in files:
                    over = {part: by[subject.horizon] for part, by in played[name].items()}
                    try:
                        records[file] = credibility_of(search, h, variants[name], over, sets, place=place, fmu=file)
                    except CosimError as error:
                        warnings.append(f"{file.name} has no record of credibility: {error}")
            hold_stops()  # a result that exists from here must not be lost
            warnings += [*failure_warnings(problem), *_proof_warnings(variants, way)]
            study = replace(study, warnings=(*study.warnings, *warnings))
            risen: dict[str, tuple[float, float]] = {}
            remaining: dict[str, float] = {}
            if sealed and delivered in played:
                before, after = (played[name]["validation"][subject.horizon] for name in ("before", delivered))
                risen = find_rises(before, after)
                remaining = remaining_on_sealed_logs(before, after, floors["validation"])
            text = sentence(claims, subject, risen, remaining)
            written = record(
                study,
                claims,
                text,
                problem.layout.outputs,
                unfitted=unfitted,
                noise=noise,
                gain_otherwise=gain_otherwise,
                played=played,
                floors=floors,
                way=way,
                untested=untested,
                seconds=time.perf_counter() - start,
            )
            for file, (known, covered) in records.items():
                attach(file, known.model_copy(update={"verdict": written.verdict, "sentence": text}))
                if file == scratch / FILES_OF[delivered]:
                    written.coverage = covered
            content = written.model_dump(mode="json")
            write_json(scratch / REFINE_RECORD, content, allow_nan=False)
            with delay_stops():
                remove_earlier(folder, read=study.files)
                results = [*files, scratch / REFINE_RECORD]
                for name in {*REFINED, *NEAREST, "report.html"} - {path.name for path in results}:
                    (folder / name).unlink(missing_ok=True)  # of an earlier study
                for path in results:
                    path.replace(folder / path.name)
            release_stops()
        searched, horizon = search.problem, subject.horizon
        evidence = {name: {part: by[horizon] for part, by in parts.items()} for name, parts in played.items()}
        problem = replace(problem, trusted=searched.trusted, scatter=searched.scatter)
        outcome = Refinement(study, claims, content, folder, problem, variants, evidence, risen)
        if report:
            from cosim.refinement.report.refine_page import write_refine_report

            progress("drawing the report", 0.0)
            write_refine_report(folder / "report.html", outcome)
        return outcome


class _Limited(Watcher):
    """Progress function that ends a search at its time limit, and stores the hypotheses so far.

    Final replays are not interrupted, because sealed logs are opened only once.

    Args:
        start: Clock time at the start of the study [s].
    """

    def __init__(self, progress: Progress, limits: Limits | None, start: float) -> None:
        self.progress, self.start, self.tried = progress, start, list[Any]()
        self.total = limits.total if limits else None

    def __call__(self, stage: str, share: float) -> None:
        if self.total is not None and time.perf_counter() - self.start > self.total:
            reason = (
                f"the limit of {self.total:g} s (limits: total) is reached at {stage!r}; {REFINE_RECORD} has the "
                "hypotheses so far and no verdict: allow more time, or name fewer candidates"
            )
            raise TimedOut("the search", 0.0, reason)
        self.progress(stage, share)

    def ranking(self, hypotheses: Sequence[Any]) -> None:
        """Store the hypotheses, and pass them to the caller's progress function."""
        self.tried = [*hypotheses]
        report_ranking(self.progress, hypotheses)


def _build_problem(study: Study) -> Problem:
    """Return the fitting problem; noise levels not stated by study or model are estimated from the logs."""
    noise = study.content.noise
    problem = build_problem(study.subject, study.logs, noise=noise, settings=study.settings)
    stated = {*study.subject.sensor_variance, *noise}
    shown, guesses = noise_levels(problem)  # a stated noise level may be too small
    names = problem.layout.outputs
    visible, guess = (np.array([of.get(n, 0.0) ** 2 for n in names]) for of in (shown, guesses))
    r = np.where((guess > 0.0) & ~np.isin(names, [*stated]), guess, problem.r)
    return with_likely_starts(replace(problem, r=r, shown=visible, ranges=[]))


def _divergences(study: Study, problem: Problem) -> Iterator[Fault]:
    """Yield a fault for each log on which the filter of the unfitted model diverges."""
    noise = initial_fit(problem).noise
    for index, (log, data) in enumerate(zip(study.logs, problem.logs, strict=False)):
        errors, variances = problem.innovations(problem.values, noise, index)
        with np.errstate(over="ignore", invalid="ignore"):
            diverged = ~np.isfinite(errors * errors / variances) & problem.readings[index].scored
        if not diverged.any():
            continue
        t = data.start + data.step * int(np.argmax(diverged.any(axis=1)))
        message = (
            f"{study.subject.title} diverges on this log: its prediction is not finite at t = {t:g} s; check its "
            "parameters, start values and the units of the log, or set a shorter substep in its class"
        )
        yield Fault(log.path, 0, 0, message)


def _candidates(study: Study) -> list[Candidate]:
    """Return the candidates of the study (default: all); for an FMU, without sensors of outputs that no log has."""
    subject, named = study.subject, study.content.candidates
    candidates = list(drop_own_parameters(subject.candidates(study.varied), study.settings.per_log))
    if named is not None:
        return [c for c in candidates if c.name in named]
    logged = set().union(*(log.outputs for log in study.logs))
    unread = {kind.name for kind in subject.sensors if subject.probed and logged.isdisjoint(kind.affected())}
    return [c for c in candidates if c.name not in unread]


def _variants(search: Search, claims: Claims, unfitted: Fit) -> dict[str, Variant]:
    """Return the variants to replay: before, recalibrated, after, and the nearest model if the claim is incomplete.

    Args:
        unfitted: Given model with fitted unknown inputs.
    """
    named: dict[str, Hypothesis | None] = {"recalibrated": claims.base, "after": claims.claimed}
    named |= {"nearest": claims.nearest} if claims.grade != "claimed" else {}
    made = {id(None): variant_of(search, search.subject, unfitted)}  # a variant that occurs twice is replayed once
    for h in filter(None, named.values()):
        made[id(h)] = refined_variant(search, h)
    return {"before": made[id(None)], **{name: made[id(h)] for name, h in named.items()}}


def failure_warnings(problem: Problem) -> Iterator[str]:
    """Yield a warning if the FMU crashed, hung or refused values during the search."""
    failures: Sequence[Exception] = getattr(problem.kernel, "failures", ())
    if failures:
        evaluations = counted(len(failures), "evaluation")
        yield f"the FMU failed in {evaluations}, which count as diverged; the first failure: {failures[0]}"


def _proof_warnings(variants: Mapping[str, Variant], way: Replays) -> Iterator[str]:
    """Yield a warning for a missing FMU or platform, and for slow replays."""
    subjects = [variant.subject for variant in variants.values()]
    yield from dict.fromkeys(s.undelivered for s in subjects if s.undelivered)
    for names in dict.fromkeys(s.missing_platforms for s in subjects if s.missing_platforms):
        yield (
            f"the delivered FMU lacks the platforms {join_names(names)} of the original: the library around it "
            "cannot be compiled for them here; pip install 'fmu-cosim[native]' installs a compiler for most"
        )
    if way.through == "python" and way.log:
        yield f"the native FMU of the model is not used: {way.why}; all errors are measured with FMUs in Python"
