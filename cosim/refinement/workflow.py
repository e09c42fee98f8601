"""Workflow of a refinement: study, gate, recalibration, candidates, verdict, refined model, FMU, replays.

Functions explore, the FMU proves: errors before and after are measured by FMU replays, and the validation logs are
opened after all decisions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.core.errors import Fault, TimedOut, refuse
from cosim.core.text import counted, join_names, plain
from cosim.core.units import unit_of_rate
from cosim.estimation.fit import Fit, initial_fit
from cosim.estimation.free_runs import with_likely_starts
from cosim.estimation.kernel.nameless import RATE
from cosim.estimation.noise_model import Noise
from cosim.estimation.per_log import drop_own_parameters
from cosim.estimation.posing import build_problem, coarsen, varied_inputs
from cosim.estimation.predictability import predictable_horizon
from cosim.estimation.problem import Problem
from cosim.estimation.sensor_noise import at_rest, cell_warnings, first_noise, noise_warnings, sensor_noise
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject, Workplace
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
from cosim.fmi.building.refined import ANSWER, NEAREST, REFINED
from cosim.isolation.limits import Limits
from cosim.logs.log import Log
from cosim.refinement.decision.claims import Claims, Nearest, judge
from cosim.refinement.decision.constancy import check_constancy
from cosim.refinement.decision.evidence import (
    chance_limit,
    open_loop_gain,
    required_scatters,
    steadiness,
    with_intervals,
)
from cosim.refinement.decision.judgement import BETTER, decide, halving_subset
from cosim.refinement.decision.sentences import floor_warning
from cosim.refinement.decision.special_cases import not_excluded
from cosim.refinement.decision.trust import attribute
from cosim.refinement.proof.agreement import compare_with_predictions
from cosim.refinement.proof.measure import (
    FLOOR_SEED,
    Evidence,
    final_log_parameters,
    noise_floor,
    predicted_floor,
    rmse,
)
from cosim.refinement.proof.nearest import held_out_improvement, ladder, nearest
from cosim.refinement.proof.proof_replays import LogSets, Proof, warnings_of
from cosim.refinement.proof.refined_models import Variant, log_noise, refined_subject, variant_of, variants_of
from cosim.refinement.proof.replay_check import (
    check_on_sealed_logs,
    check_with_replays,
    moved_beyond_tolerance,
    with_miss_of_rivals,
)
from cosim.refinement.proof.sealed import find_rises, repeated_motion, sealed_improvement
from cosim.refinement.record import Floors, Measurements, Part, Replayed, keep_finite, record
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import SearchResult
from cosim.refinement.search.hypotheses import Attribution
from cosim.refinement.search.input_hold import Between, between_rows, late_input
from cosim.refinement.search.missing import unknown_inputs
from cosim.refinement.search.unnamed import Leftover, find_unnamed_terms
from cosim.refinement.study import Study, read_study

DELIVERED = {"refined": "after", "nearest": "nearest"}  # name of written files → variant
RESULTS = (*REFINED, *NEAREST, ANSWER)  # in the order of their publication
Progress = Callable[[str, float], None]


@one_stop()
def refine(
    study: FilePath | Study,
    folder: FilePath,
    progress: Progress | None = None,
    *,
    report: bool = False,
    in_process: bool = False,
    limits: str = "",
) -> Refinement:
    """Refine the model of a study; write refine.json and the refined files to `folder`, all or none.

    A model gives model.yaml and plant.fmu. The files of an earlier refinement are replaced.

    Args:
        study: Study file, or a study of any subject (`cosim.refinement.study.study_of`).
        report: Write report.html too.
        in_process: Load FMUs into this process, for a debugger.
        limits: Limits in place of those of a study file, such as `step: 10 s, total: 10 min`.

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
    limited = _within_limit(progress, study.content.limits, start)
    check_writable(folder, (*RESULTS, "report.html"), study.files)
    problem = _build_problem(study)
    refuse(_divergences(study, problem))
    study = _with_predictable_horizon(study, problem)
    subject = study.subject
    result = attribute(subject, problem, _candidates(study), limited)
    limited("weighing what was found", 0.0)
    attribution, claims = _judge(study, decide(result), result, limited)
    claims = _add_nearest(study, claims, result, attribution)
    between = between_rows(result.search.problem, attribution.base)
    claims = replace(claims, inputs=between.other_line if between.is_otherwise else "")
    noise = log_noise(attribution.best.fit.noise, result.free_noise)
    warnings = [*noise_warnings(problem, noise, subject), *_input_warnings(result, attribution, between)]
    if subject.probed:
        warnings += cell_warnings(problem, subject)
    allowed = study.content.limits
    with scratch_folder(folder, ".refine-") as scratch, Workplace(scratch, allowed, in_process=in_process) as place:
        progress("building the refined FMU", 0.0)
        variants = _variants(study, attribution, claims, result.free_noise)
        files = _write_models(variants, scratch, folder)
        progress("replaying through the FMUs", 0.0)
        sealed = study.unseal()  # after all decisions
        sets: LogSets = {"estimation": study.logs, "validation": sealed} if sealed else {"estimation": study.logs}
        played, way = Proof(problem, sets, place).replay(variants)
        progress("measuring the noise floor", 0.0)
        quiet = _with_log_noise(variants, attribution, claims, result.free_noise)
        rng = np.random.default_rng(FLOOR_SEED)  # fixed for reproducible results
        floors: Floors = {part: noise_floor(quiet, problem, logs, rng) for part, logs in sets.items()}
        claims = replace(claims, risen=_rises(claims, played, subject), written=bool(files))
        claims = _with_sealed_improvement(claims, played, floors, subject)
        claims = _with_miss_of_rivals(study, claims, problem, sealed, played, floors)
        before = claims
        claims = _check_on_sealed_logs(claims, played, floors, (quiet, problem, sealed), rng)
        if claims.grade != before.grade:
            variants["nearest"] = variants["after"]
            played = {**played, "nearest": played["after"]}
            files += variants["nearest"].subject.write(scratch, folder, "nearest")
        ends = final_log_parameters(variants["after"], problem, sealed)
        hold_stops()  # From here, a result exists that must not be lost.
        warnings += [*failure_warnings(problem), *_delivery_warnings(variants)]
        warnings += [
            *warnings_of(way),
            *_floor_warnings(floors, played, claims, subject),
            *repeated_motion(sealed, study.logs),
        ]
        study = replace(study, warnings=(*study.warnings, *warnings))
        measured = Measurements(played, floors, noise, way, ends, time.perf_counter() - start)
        written = record(study, attribution, claims, problem, between, measured)
        content = written.model_dump(mode="json")
        write_json(scratch / ANSWER, content, allow_nan=False)
        with delay_stops():
            remove_earlier(folder, read=study.files)
            _publish(files, scratch / ANSWER, folder)
        release_stops()
    searched, evidence = result.search.problem, _at_horizon(played, subject.horizon)
    problem = replace(problem, trusted=searched.trusted, scatter=searched.scatter)
    outcome = Refinement(study, attribution, claims, content, folder, problem, variants, evidence)
    if report:
        from cosim.refinement.report.refine_page import write_refine_report

        progress("drawing the report", 0.0)
        write_refine_report(folder / "report.html", outcome)
    return outcome


def _input_warnings(result: SearchResult, a: Attribution, between: Between) -> Sequence[str]:
    """Return a warning of an input that is recorded late, or else of the way between rows."""
    problem = result.search.problem
    late = late_input(problem, a.best) if a.best.fit.free else None
    return between.warnings if late is None or late.gain < between.gain else [late.warning(problem.logs[0].step)]


def _within_limit(progress: Progress, limits: Limits | None, start: float) -> Progress:
    """Return a progress function that ends an overlong search.

    The proof is not interrupted, because its sealed logs are opened once.

    Args:
        start: Clock time at the start of the study [s].
    """
    if limits is None or limits.total is None:
        return progress
    total = limits.total

    def report(stage: str, share: float) -> None:
        if time.perf_counter() - start > total:
            raise TimedOut(
                "the search",
                0.0,
                (
                    f"the limit of {total:g} s (limits: total) is reached at {stage!r}; nothing is written: allow "
                    "more time, or name fewer candidates"
                ),
            )
        progress(stage, share)

    return report


def _build_problem(study: Study) -> Problem:
    """Return the fitting problem; noise levels not stated by study or model are estimated from the logs."""
    noise = study.content.noise
    problem = build_problem(study.subject, study.logs, noise=noise, settings=study.settings)
    stated = {*study.subject.sensor_variance, *noise}
    problem = problem.with_noise({n: s for n, s in first_noise(problem).items() if n not in stated and s > 0.0})
    shown = sensor_noise(problem)  # a stated level may be too small
    problem = replace(problem, shown=np.array([shown.get(name, 0.0) ** 2 for name in problem.layout.outputs]))
    return with_likely_starts(problem)


def _with_predictable_horizon(study: Study, problem: Problem) -> Study:
    """Return the study with the horizon over which the given model can predict, and a warning if it is shorter."""
    horizon = study.subject.horizon
    shorter = predictable_horizon(problem, horizon)
    if shorter >= horizon:
        return study
    subject = copy(study.subject)
    subject.horizon = shorter
    name = f"{plain(horizon)} s" if math.isfinite(horizon) else "free run"
    warning = (
        "errors of the start state grow exponentially in these logs. Predictions therefore last "
        f"{plain(shorter, 2)} s, in which these errors grow tenfold, and not the model's {name}"
    )
    return replace(study, subject=subject, warnings=(*study.warnings, warning))


def _divergences(study: Study, problem: Problem) -> Iterator[Fault]:
    """Yield a fault for each log on which the filter of the unfitted model diverges."""
    noise = initial_fit(problem).noise
    for index, (log, data) in enumerate(zip(study.logs, problem.logs, strict=False)):
        by_log = problem.score(problem.values, noise, [index]).by_log
        if np.isfinite(by_log).all():
            continue
        errors, variances = problem.innovations(problem.values, noise, index)
        with np.errstate(over="ignore", invalid="ignore"):
            diverged = ~np.isfinite(errors * errors / variances) & problem.readings[index].scored
        t = data.start + data.step * int(np.argmax(diverged.any(axis=1)))
        yield Fault(
            log.path,
            0,
            0,
            (
                f"{study.subject.title} runs away on this log: its prediction is not finite at t = {t:.6g} s; check "
                "its parameters, start values and the units of the log, or state a shorter substep in its class"
            ),
        )


def _candidates(study: Study) -> list[Candidate]:
    """Return the candidates named by the study, or all; of an FMU, without the sensors of outputs that no log has."""
    subject, named = study.subject, study.content.candidates
    candidates = list(
        drop_own_parameters(subject.candidates(varied_inputs(subject, study.logs)), study.settings.per_log)
    )
    if named is not None:
        return [c for c in candidates if c.name in named]
    logged = set().union(*(log.outputs for log in study.logs))
    unread = {kind.name for kind in subject.sensors if subject.probed and logged.isdisjoint(kind.affected())}
    return [c for c in candidates if c.name not in unread]


def _judge(study: Study, a: Attribution, result: SearchResult, progress: Progress) -> tuple[Attribution, Claims]:
    """Return the claims; if they are withdrawn, those of a subset that halves the held-out error, as a part."""
    claims = _judge_best(study, a, result, progress)
    subset = halving_subset(result.search, a) if claims.claimed is None else None
    if subset is None:
        return a, claims
    partial = _judge_best(study, subset, result, progress)
    if partial.claimed is None:
        return a, claims
    beside = tuple(sorted(set(a.best.names) - set(subset.best.names)))
    return subset, replace(partial, grade="part", beside=beside)


def _judge_best(study: Study, a: Attribution, result: SearchResult, progress: Progress) -> Claims:
    """Return the claims of the best hypothesis, judged beside unnamed terms and checked by replays."""
    subject, search = study.subject, result.search
    progress("looking for what has no name", 0.0)
    bare = build_problem(subject, study.logs, True, study.content.noise, study.settings)
    if bare.layout.is_free_run:
        bare = replace(search.problem, kernel=bare.kernel, values={**bare.values, **search.problem.values})
    trusted = search.problem.trusted
    coarse, scatter = coarsen(bare, a.best.fit.values), search.problem.scatter
    nameless = replace(coarse, sensing=a.best.fit.noise, trusted=trusted, scatter=scatter)
    units = {"time": "s", **{q.name: q.unit for q in subject.states}}
    units |= {f"{RATE}{q.name}": unit_of_rate(q.unit) for q in subject.states}
    units |= {f"command {q.name}": q.unit for q in subject.inputs}
    leftover = find_unnamed_terms(nameless, a.best.fit, search.price, units)
    if leftover.fit is not None and not _is_steady(nameless, leftover, leftover.fit, a.best.fit, subject.horizon):
        leftover = replace(leftover, terms=(), fit=None, gain=0.0)
    problem = search.problem
    moves = unknown_inputs(problem, a.best.fit, a.has_unknown_input, units)
    claims = judge(a, leftover, subject, problem.layout.forced, moves, still=at_rest(problem))
    if claims.claimed is not None and claims.claimed.fit.scattered is None:
        claims = replace(claims, claimed=with_intervals(search, claims.claimed))
    if claims.claimed is not None:
        progress("fitting predictions over the horizon", 0.0)
        claims = compare_with_predictions(search, a, claims)
    progress("replaying with the claim and without", 0.0)
    claims = check_constancy(search, a, check_with_replays(study, a, claims, result, problem))
    return replace(claims, not_excluded=not_excluded(search, claims, _candidates(study)))


def _is_steady(problem: Problem, leftover: Leftover, with_terms: Fit, alone: Fit, horizon: float) -> bool:
    """Return True if unnamed terms improve the fit over blocks or logs beyond chance."""
    if problem.trusted:
        return open_loop_gain(problem, horizon, with_terms, alone) >= required_scatters(BETTER, leftover.among)
    return steadiness(problem, with_terms, alone) >= chance_limit(problem, with_terms, leftover.among)


def _add_nearest(study: Study, claims: Claims, result: SearchResult, a: Attribution) -> Claims:
    """Return the claims with held-out errors by number of candidates, and the nearest model if incomplete."""
    close = {h.names: h for h in (a.best, result.best) if h.candidates}
    claims = replace(claims, ladder=ladder(result.search, a, list(close.values())))
    if claims.grade != "claimed":
        h = nearest(claims.ladder)
        why = a.reasons.get(h.names, "") if h else ""
        claims = replace(claims, nearest=Nearest(h, moved_beyond_tolerance(h.fit) if h else (), why))
    if claims.name in ("ambiguous", "unexplained") and not claims.claimed_candidates:
        claims = replace(claims, improvement=held_out_improvement(claims.ladder, claims.nearest_hypothesis))
    return replace(claims, restricted=study.content.candidates is not None)


def _variants(study: Study, a: Attribution, claims: Claims, free_noise: Noise | None) -> dict[str, Variant]:
    """Return the variants to replay: before, recalibrated, after, and the nearest model if the claim is incomplete."""
    subject, settings, claimed, nearest_fit = study.subject, study.settings, claims.claimed, claims.nearest_hypothesis
    refined = refined_subject(subject, settings, claimed)
    variants = variants_of(subject, settings, a, claimed, refined)
    if claims.nearest is not None:
        other = refined_subject(subject, settings, nearest_fit)
        of_other = variant_of(other, settings, nearest_fit.fit if nearest_fit else a.unfitted)
        variants["nearest"] = variants["after"] if nearest_fit is claimed else of_other
    each = {id(v): replace(v, free_noise=free_noise) for v in variants.values()}  # one that stands twice stays one
    return {name: each[id(variant)] for name, variant in variants.items()}


def _with_log_noise(
    variants: Mapping[str, Variant], a: Attribution, claims: Claims, free_noise: Noise | None
) -> Variant:
    """Return the refined variant, or the nearest one without a claim, with noise estimated from the logs."""
    best = variants["after"] if claims.claimed else variants.get("nearest", variants["after"])
    return replace(best, noise=log_noise(claims.floor_hypothesis(a).fit.noise, free_noise))


def _write_models(variants: Mapping[str, Variant], scratch: Path, folder: Path) -> list[Path]:
    """Write the refined model, and the nearest one if there is any; return the files."""
    files: list[Path] = []
    for name, key in DELIVERED.items():
        if key in variants:
            files += variants[key].subject.write(scratch, folder, name)
    return files


def _delivery_warnings(variants: Mapping[str, Variant]) -> Iterator[str]:
    """Yield the reason for a missing FMU, and the platforms that a delivered FMU lacks."""
    subjects = [variant.subject for variant in variants.values()]
    yield from dict.fromkeys(s.undelivered for s in subjects if s.undelivered)
    for names in dict.fromkeys(s.missing_platforms for s in subjects if s.missing_platforms):
        yield (
            f"the delivered FMU lacks the platforms {join_names(names)} of the original: the library around it "
            "cannot be compiled for them here; pip install 'fmu-cosim[native]' has a compiler for most"
        )


def _at_horizon(played: Replayed, horizon: float) -> dict[str, dict[Part, Evidence]]:
    """Return the replays over one horizon by variant and set of logs."""
    return {name: {part: by[horizon] for part, by in parts.items()} for name, parts in played.items()}


def failure_warnings(problem: Problem) -> Iterator[str]:
    """Yield a warning if the FMU crashed, hung or refused values during the search."""
    failures: Sequence[Exception] = getattr(problem.kernel, "failures", ())
    if failures:
        evaluations = counted(len(failures), "evaluation")
        yield f"the FMU failed in {evaluations}, which count as diverged; the first time: {failures[0]}"


def _rises(claims: Claims, played: Replayed, subject: Subject) -> Mapping[str, tuple[float, float]]:
    """Return channel → errors before and after, for errors that rise on sealed logs with the delivered model."""
    variant = "after" if claims.claimed is not None else "nearest"
    if "validation" not in played["before"] or variant not in played:
        return {}
    before, after = (played[name]["validation"][subject.horizon] for name in ("before", variant))
    return find_rises(before, after)


def _with_sealed_improvement(claims: Claims, played: Replayed, floors: Floors, subject: Subject) -> Claims:
    """Return the claims with the improvement on sealed logs, if there are any and something is to be compared."""
    if "validation" not in played["before"]:
        return claims
    sealed = {name: parts["validation"][subject.horizon] for name, parts in played.items()}
    improvement = sealed_improvement(claims, sealed, floors["validation"].level)
    return replace(claims, improvement=improvement) if improvement else claims


def _check_on_sealed_logs(
    claims: Claims,
    played: Replayed,
    floors: Floors,
    posed: tuple[Variant, Problem, Sequence[Log]],
    rng: np.random.Generator,
) -> Claims:
    """Return the claims, graded by sealed logs and their own uncertainty.

    Args:
        posed: Claimed variant with the noise of its fit, fitting problem and sealed logs.
    """
    variant, problem, sealed = posed
    if not sealed or claims.claimed is None:
        return claims
    checked = check_on_sealed_logs(claims, floors["validation"].level)
    if checked is claims:
        return claims
    level = predicted_floor(floors["validation"], variant, problem, sealed, claims.claimed.fit, rng)
    errors = {name: parts["validation"][variant.subject.horizon] for name, parts in played.items()}
    improvement = sealed_improvement(claims, errors, level)
    is_missed = check_on_sealed_logs(replace(claims, improvement=improvement), level).grade == "part"
    if is_missed or checked.part is None:
        return checked
    return replace(claims, divided=checked.part.channel)


def _with_miss_of_rivals(
    study: Study, claims: Claims, problem: Problem, sealed: Sequence[Log], played: Replayed, floors: Floors
) -> Claims:
    """Return ambiguous claims with the least miss on sealed logs, if there are any and every rival misses them."""
    if not sealed:
        return claims
    error = keep_finite(rmse(played["after"]["validation"][study.subject.horizon]))
    return with_miss_of_rivals(study, claims, problem, sealed, error, floors["validation"].level)


def _floor_warnings(floors: Floors, played: Replayed, claims: Claims, subject: Subject) -> Iterator[str]:
    """Yield a warning for each set of logs with a noise floor above the error of the delivered or the nearest model."""
    units = {q.name: q.unit for q in subject.outputs}
    names = ("after",) if claims.claimed is not None or "nearest" not in played else ("after", "nearest")
    for part, floor in floors.items():
        errors = [keep_finite(rmse(played[name][part][subject.horizon])) for name in names]
        least = {channel: min(e.get(channel, math.inf) for e in errors) for channel in floor.level}
        if channels := floor.channels_above(keep_finite(least)):
            yield floor_warning(part, channels, units)


def _publish(files: Sequence[Path], answer: Path, folder: Path) -> None:
    """Move the results to the folder, refine.json last; delete an outdated report."""
    for name in {"report.html", *RESULTS} - {path.name for path in (*files, answer)}:
        (folder / name).unlink(missing_ok=True)  # from an earlier study
    for path in (*files, answer):
        path.replace(folder / path.name)
