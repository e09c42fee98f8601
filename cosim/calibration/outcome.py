"""Outcome of a fit: errors before and after, content of fit.json, sentences, and the record of credibility."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.calibration.estimate import Estimate
from cosim.calibration.fit_record import (
    ChannelErrors,
    LogEntry,
    NoiseEntry,
    ParameterEntry,
    PartErrors,
    Record,
    StartEntry,
    Verdict,
)
from cosim.calibration.fit_study import Parameter, Request
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Flags, NamedArrays, NamedValues
from cosim.core.errors import SimulationError
from cosim.core.text import amount, counted, join_names, plain, size
from cosim.credibility.bands import LEAST_ROWS, Coverage, Track, band_horizons, bands_of, coverage_of, track_of
from cosim.credibility.record import Correlations, Credibility, ParameterRecord
from cosim.estimation.fit import inverse
from cosim.logs.log import Log
from cosim.refinement.proof.measure import find_rises
from cosim.residuals.compare import floors, horizon_name
from cosim.residuals.drive import Drive
from cosim.residuals.log_region import log_records, region_of_logs, rows_inside
from cosim.residuals.residual_statistics import FREE_RUN, finite, pool_errors, remaining_excess
from cosim.residuals.windows import SKIPPED, Replay, free_run, horizons, replays_over, self_started

CLEAR = 0.95  # ratio of errors below which the model counts as improved
MAX_HEADLINE_OUTPUTS = 2  # outputs in a headline


@dataclass(frozen=True, eq=False)
class Part:
    """A set of logs before and after the fit.

    Attributes:
        sealed: True for logs that were opened after the fit.
        rises: Outputs whose error has increased significantly on sealed logs.
        log: The last log of the set.
        before, after: Model outputs for `log` over the horizon that decides the verdict.
    """

    sealed: bool
    errors: PartErrors
    rises: Sequence[str]
    log: Log
    before: NamedArrays
    after: NamedArrays


def prove(parameters: Sequence[Parameter], estimate: Estimate, drives: Sequence[Drive], *, sealed: bool) -> Part:
    """Return the errors on a set of logs before and after the fit, measured by replays as in `cosim replay`.

    For sealed logs, parameters with a value per log have the mean value.
    """
    assert estimate.likelihood is not None
    likelihood, horizon = estimate.likelihood, estimate.logs.horizon or FREE_RUN
    varied, before = {p.name for p in parameters}, {p.name: p.start for p in parameters if not p.is_start}
    every = [likelihood.values(likelihood.best.x, k) for k in range(len(estimate.logs.drives))]
    after = [{n: v for n, v in each.items() if n in varied} for each in every]
    if sealed:
        after = [{n: float(np.mean([each[n] for each in after])) for n in after[0]}] * len(drives)
    logs, squares = [d.log for d in drives], dict[str, list[float]]()
    sides: tuple[list[Mapping[float, Replay]], list[Mapping[float, Replay]]] = [], []
    for drive, fitted in zip(drives, after, strict=True):
        for side, values in zip(sides, (before, fitted), strict=True):
            moved = drive.with_values(values)
            free = free_run(moved)
            replays = replays_over(moved, free, horizons(moved.log)[-1:])
            side.append(replays)
            for name, floor in floors(moved, free, replays.get(horizon, free)).items() if values is fitted else ():
                squares.setdefault(name, []).extend([floor.rmse**2] if math.isfinite(floor.rmse) else [])
    common = set.intersection(*(set(replays) for side in sides for replays in side))
    horizon = horizon if horizon in common else FREE_RUN
    errors = {}  # horizon → channel → RMSE before and after, over all logs together
    for span in sorted(common, key=lambda span: (span != horizon, span)):
        old, new = (pool_errors(r[span].errors(log) for log, r in zip(logs, side, strict=True)) for side in sides)
        errors[span] = {name: (finite(old[name]), finite(new[name])) for name in old}
    channels, units = {}, {n: u for log in logs for n, u in log.units.items()}
    for name, (first, last) in errors[horizon].items():
        floor_square = float(np.mean(each)) if (each := squares.get(name)) else math.nan
        excess = math.nan
        if first is not None and last is not None:
            excess = remaining_excess(first, last, math.sqrt(np.nan_to_num(floor_square)))
        channels[name] = ChannelErrors(
            unit=units[name],
            before=first,
            after=last,
            noise_floor=finite(math.sqrt(floor_square)),
            excess_left=finite(excess),
        )
    spans = {"free run" if h == FREE_RUN else f"{h:g} s": of for h, of in errors.items()}
    shown = [[(log, r[horizon]) for log, r in zip(logs, side, strict=True)] for side in sides]
    rises = [*find_rises(*shown)] if sealed else []
    part = PartErrors(horizon=finite(horizon), channels=channels, horizons=spans)
    return Part(sealed, part, rises, logs[-1], *(side[-1][1].outputs for side in shown))


def write_record(
    request: Request, estimate: Estimate, parts: Sequence[Part], given: Mapping[str, Any], seconds: float
) -> Record:
    """Return the content of fit.json.

    Args:
        parts: Errors on the estimation logs, then on sealed logs; empty for a stopped fit.
        given: Values of `--start` that are not estimated.
    """
    assert estimate.likelihood is not None
    logs, spread, likelihood = estimate.logs, estimate.covariance, estimate.likelihood
    point, unknowns = likelihood.best, likelihood.unknowns
    combined = {n for c in estimate.combinations for n in c.names}
    parameters, starts, per_log = dict[str, ParameterEntry](), list[StartEntry](), list[LogEntry]()

    halves = np.full(len(unknowns), np.nan) if spread is None else spread.halves
    held = [(p, p.start, math.nan) for p in estimate.held.values()]
    for k, (p, value, half) in enumerate([*zip(unknowns, point.x.tolist(), halves.tolist(), strict=True), *held]):
        is_held, ci95 = k >= len(unknowns), (value - half, value + half) if math.isfinite(half) else None
        common: dict[str, Any] = {"value": value, "unit": p.unit}
        if p.log is None or is_held:
            parameters[p.name] = ParameterEntry(
                **common,
                start=p.start,
                low=finite(p.low),
                high=finite(p.high),
                tolerance=p.tolerance,
                ci95=None if p.name in combined else ci95,
                status="held" if is_held else "at_bound" if value in (p.low, p.high) else "estimated",
                profile=estimate.profiles.get(p.name),
            )
            continue
        common |= {"log": str(logs.drives[p.log].log.path), "name": p.name, "ci95": ci95}
        if p.is_start:
            starts.append(StartEntry(**common, named=not p.spread))
        else:
            per_log.append(LogEntry(**common))
    correlation, colour = None, np.full(len(logs.channels), np.nan)
    if spread is not None:
        shared, colour = [u.log is None for u in unknowns], spread.colour
        matrix = spread.matrix[np.ix_(shared, shared)]
        roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        correlation = np.clip(matrix / np.outer(roots, roots), -1.0, 1.0).tolist()
    verdict: Verdict = "stopped"
    if parts:  # verdict from the geometric mean over channels of the ratio of errors after/before
        channels = parts[-1].errors.channels.values()
        logarithms = [math.log(c.after / c.before) for c in channels if c.before and c.after]
        ratio = math.exp(float(np.mean(logarithms))) if logarithms else math.nan
        verdict = "improved" if ratio < CLEAR else "unchanged"
        verdict = "worse" if ratio > 1.0 / CLEAR or parts[-1].rises else verdict
    noise = zip(logs.channels, point.sigma.tolist(), colour.tolist(), strict=True)
    record = Record(
        fmu=str(request.fmu),
        logs=[str(p) for p in request.estimation],
        sealed=[str(p) for p in request.sealed],
        verdict=verdict,
        sentence="",
        windows=logs.horizon,
        windows_reason=estimate.reason,
        parameters=parameters,
        starts=starts,
        per_log=per_log,
        given=dict(given),
        correlation=correlation,
        singular_values=estimate.singular.tolist(),
        combinations=estimate.combinations,
        screening=list(estimate.screened),
        noise={n: NoiseEntry(sigma=s, colour=finite(c)) for n, s, c in noise},
        errors={"sealed" if part.sealed else "estimation": part.errors for part in parts},
        simulations=logs.count,
        failed_simulations=logs.failed,
        seconds=seconds,
        warnings=[],
        notes=[],
    )
    record.sentence = _sentence(record, parts)
    record.warnings = [*_warnings(record, estimate, parts)]
    if logs.horizon is not None:
        record.notes = [
            f"the estimate simulates windows of {logs.horizon:g} s instead of whole logs: {estimate.reason}"
        ]
    return record


def _sentence(record: Record, parts: Sequence[Part]) -> str:
    """Return a headline with the verdict and the outputs that change most, and a sentence on the estimate."""
    count = sum(entry.status != "held" for entry in record.parameters.values()) + len({e.name for e in record.per_log})
    runs = counted(record.simulations, "simulation")
    effort = f"{counted(count, 'parameter')} from {counted(len(record.logs), 'log')} by {runs}."
    if not parts:
        return f"The fit was stopped before its final check. The best values so far: {effort}"
    part = parts[-1]  # sealed logs; without them, the logs of the estimate
    where = counted(len(record.sealed), "sealed log") if part.sealed else "the logs of the estimate"
    error = f"error over {horizon_name(part.errors.horizon)}".replace("over free run", "of the free run")
    ratios = {n: c.after / c.before for n, c in part.errors.channels.items() if c.before and c.after}
    worst_or_best = sorted(ratios, key=lambda n: ratios[n], reverse=record.verdict == "worse")[:MAX_HEADLINE_OUTPUTS]
    chosen = {n: part.errors.channels[n] for n in worst_or_best}
    texts = [f"{n} from {size(c.before or 0.0, c.unit)} to {size(c.after or 0.0, c.unit)}" for n, c in chosen.items()]
    change = {"improved": "falls", "worse": "does not decrease"}.get(record.verdict, "hardly changes")
    unproven = " No sealed log confirms it." if record.verdict == "improved" and not part.sealed else ""
    return f"On {where} the {error} {change}: {join_names(texts) or 'it is zero for all outputs'}.{unproven} {effort}"


def _warnings(record: Record, estimate: Estimate, parts: Sequence[Part]) -> Iterator[str]:
    """Yield the warnings of a fit."""
    for c in estimate.combinations:
        held = record.parameters[c.held]
        fixed = f"{c.held} is fixed at {amount(held.value, held.unit, 4)}"
        yield f"{c.sentence}; {fixed}, and none of them has an interval"
    if estimate.idle:
        yield f"no effect on any measured output of these logs, so the value is unchanged: {join_names(estimate.idle)}"
    for name, entry in record.parameters.items():
        if entry.status == "at_bound":
            end = f"its bound {amount(entry.value, entry.unit, 4)}"
            yield f"{name} ends at {end}: its interval ignores the bound, and the bound may be wrong"
    if estimate.covariance is not None and not estimate.settled:
        yield "the estimate did not converge: the likelihood is not smooth, and the intervals are unreliable"
    if estimate.logs.first_failure is not None:
        values, error = estimate.logs.first_failure
        shown = ", ".join(f"{n} = {plain(v, 4)}" for n, v in values.items() if n in record.parameters)
        count = f"{record.failed_simulations} of {record.simulations}"
        yield f"{count} simulations failed and were rejected, first at {shown}: {error}"
    if estimate.dropped:
        yield f"each window has its own start values, so {join_names(estimate.dropped)} is not estimated"
    if parts and (risen := parts[-1].rises):
        yield f"on sealed logs the error of {join_names(risen)} increases by more than it varies between parts of a log"
    if estimate.covariance is not None and (names := estimate.above_noise()):
        above = f"the error of {join_names(names)} is above the noise and not white"
        cure = "`cosim refine` searches for effects that the FMU lacks"
        yield f"{above}: no value of these parameters explains it. {cure}"


# -- record of credibility, from replays of held-out estimation logs -----------------------


Values = NamedValues


def credibility_of(
    record: Record, likelihood: Likelihood, drives: Sequence[Drive], sealed: Sequence[Drive], values: Sequence[Values]
) -> tuple[Credibility, Coverage | None]:
    """Return the record of credibility of a fitted FMU, and the coverage of its error bands on sealed logs.

    Args:
        drives: Drives of the estimation logs.
        values: Estimated values for each of these logs.
    """
    logs = [drive.log for drive in drives]
    shared = {n: float(np.mean([v[n] for v in values])) for n in values[0]}
    fitted = [drive.with_values(v) for drive, v in zip(drives, values, strict=True)]
    closed = [drive.with_values(shared) for drive in sealed]
    free = likelihood.logs.horizon is None
    span = horizons(logs[0])
    longest = float(max(log.time[-1] - log.time[0] for log in logs))
    first = max(span[0], LEAST_ROWS * max(log.step for log in logs))
    ends = band_horizons([float(log.time[-1] - log.time[0]) - SKIPPED * log.slowness for log in logs], first)
    spans = {end: end for end in ends} | ({longest: FREE_RUN} if free or not ends else {})
    held_out = [drive.with_values(_without(likelihood, k, values[k])) for k, drive in enumerate(drives)]
    tracks = _tracks(held_out, spans)
    bands = bands_of(tracks, drives[0].units, held_out=len(drives) > 1, free=FREE_RUN in spans.values())
    nearby = FREE_RUN if free else span[-1]
    region = region_of_logs(fitted[0], [(d.log, _replay(d, nearby)) for d in fitted])
    coverage = None
    if sealed and not bands.reason:
        inside = rows_inside(region, fitted[0], [(d.log, _replay(d, nearby)) for d in closed])
        coverage = coverage_of(bands, _tracks(closed, spans, inside))
    parameters = {
        n: ParameterRecord(value=p.value, unit=p.unit, ci95=p.ci95)
        for n, p in record.parameters.items()
        if p.status != "held"
    }
    known = Credibility(
        command="cosim fit",
        model=drives[0].description.modelName,
        verdict=record.verdict,
        sentence=record.sentence,
        logs=log_records(logs),
        sealed=log_records([drive.log for drive in sealed]),
        parameters=parameters,
        correlations=Correlations(names=[*parameters], matrix=record.correlation or []),
        region=region,
        bands=bands,
    )
    return known, coverage


def _without(likelihood: Likelihood, k: int, values: Values) -> dict[str, float]:
    """Return the estimates without log k, by a Gauss-Newton step from the estimates with all logs.

    With the slopes S and errors e of a log, weighted by the noise, and the precision P of the priors, the step is
    (Σ S'·S + P)⁻¹·S_k'·e_k, where the sum is over the other logs.
    """
    weights = [likelihood.weight_of(place) for place in range(len(likelihood.slopes))]
    information = np.diag(likelihood.precision) + sum(weight for weight, _ in weights) - weights[k][0]
    moved = np.clip(likelihood.best.x + inverse(information) @ weights[k][1], likelihood.low, likelihood.high)
    names = {u.name for u in likelihood.unknowns if u.log is None}
    changed = {n: v for n, v in likelihood.values(moved, k).items() if n in names}
    return {**values, **changed} if len(likelihood.slopes) > 1 else dict(values)


def _replay(drive: Drive, horizon: float) -> Replay:
    """Return windows of a horizon, or the free run if windows are impossible."""
    free = free_run(drive)
    return (None if horizon == FREE_RUN else self_started(drive, free, horizon)) or free


def _tracks(
    drives: Sequence[Drive], spans: Mapping[float, float], inside: Sequence[Flags] = ()
) -> dict[float, list[Track]]:
    """Return end of interval → track (replay errors) of each log with these replays, on which the FMU does not fail."""
    tracks: dict[float, list[Track]] = {end: [] for end in spans}
    for k, drive in enumerate(drives):
        log = drive.log
        try:
            free = free_run(drive)
            for end, span in spans.items():
                replay = free if span == FREE_RUN else self_started(drive, free, span)
                if replay is not None:
                    rows, errors = sorted(replay.starts), replay.errors(log)
                    covered = inside[k] if inside else None
                    tracks[end].append(track_of(log.time, rows, errors, inside=covered, free=span == FREE_RUN))
        except SimulationError:
            continue
    return tracks
