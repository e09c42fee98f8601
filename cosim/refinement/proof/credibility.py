"""The record of credibility of a refined FMU: held-out replays of the estimation logs, and the region of these logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.core.arrays import Array, Flags
from cosim.credibility.bands import LEAST_ROWS, Coverage, Track, band_horizons, bands_of, coverage_of, track_of
from cosim.credibility.record import Correlations, Credibility, ParameterRecord
from cosim.estimation.fit import Fit, inverse
from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Workplace
from cosim.logs.log import Log
from cosim.refinement.decision.bundle import fit_without
from cosim.refinement.proof.measure import (
    KernelReplays,
    LogSets,
    Part,
    ReplayedLogs,
    Variant,
    begin_replays,
    refined_variant,
)
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.residuals.drive import drive_in
from cosim.residuals.log_region import log_records, region_of_logs, rows_inside
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.windows import SKIPPED

FIRST = 0.25  # of the horizon of a model, the first interval of a band


def credibility_of(
    search: Search,
    h: Hypothesis | None,
    variant: Variant,
    replayed: Mapping[Part, ReplayedLogs],
    sets: LogSets,
    *,
    place: Workplace,
    fmu: Path,
) -> tuple[Credibility, Coverage | None]:
    """Return the record of a delivered FMU without its verdict, and the coverage of its bands on sealed logs.

    Args:
        h: Delivered hypothesis; None for the given model.
        variant: The delivered model.
        replayed: Replays of the delivered model over its horizon, by set of logs.
    """
    logs, sealed = sets["estimation"], sets.get("validation", ())
    problem = search.problem
    with drive_in(place.worker, logs[0], fmu, limits=place.limits) as driven:
        region = region_of_logs(driven, replayed["estimation"])
        inside = rows_inside(region, driven, replayed["validation"]) if sealed else []
    without = [variant] * len(logs)
    if h is not None and len(logs) > 1:
        fits = [fit_without(search, problem, h, k) for k in range(len(logs))]
        without = [refined_variant(search, replace(h, fit=f)) for f in fits]
    horizons = _horizons(variant, problem, logs)
    tracks = _tracks(without, problem, logs, horizons)
    units = {q.name: q.unit for q in search.subject.outputs}
    free = FREE_RUN in horizons.values()
    bands = bands_of(tracks, units, held_out=h is None or len(logs) > 1, free=free)
    coverage = None
    if sealed and not bands.reason:
        coverage = coverage_of(bands, _tracks([variant] * len(sealed), problem, sealed, horizons, inside))
    record = Credibility(
        command="cosim refine",
        model=search.subject.title,
        verdict="",
        sentence="",
        logs=log_records(logs),
        sealed=log_records(sealed),
        parameters={} if h is None else _parameters(search, h.fit),
        correlations=Correlations() if h is None else _correlations(h.fit),
        region=region,
        bands=bands,
    )
    return record, coverage


def _horizons(variant: Variant, problem: Problem, logs: Sequence[Log]) -> dict[float, float]:
    """Return the end of each interval of the bands → horizon of its replays [s]."""
    longest, first = float(max(log.time[-1] - log.time[0] for log in logs)), variant.subject.horizon
    free = {longest: FREE_RUN} if first == FREE_RUN else {}
    if problem.layout.is_free_run:  # replays begin with a log only
        return {longest: FREE_RUN}
    first = FIRST * (first if not free else longest / 10.0)
    first = max(first, LEAST_ROWS * max(log.step for log in logs))
    durations = [float(log.time[-1] - log.time[0]) - SKIPPED for log in logs]
    return {h: h for h in band_horizons(durations, first)} | free


def _tracks(
    variants: Sequence[Variant],
    problem: Problem,
    logs: Sequence[Log],
    horizons: Mapping[float, float],
    inside: Sequence[Flags] = (),
) -> dict[float, list[Track]]:
    """Return end of interval → track of each log, replayed by its own variant."""
    tracks: dict[float, list[Track]] = {end: [] for end in horizons}
    for k, (variant, log) in enumerate(zip(variants, logs, strict=True)):
        begun = begin_replays(variant, problem, logs)
        for end, horizon in horizons.items():
            subject = copy(variant.subject)
            subject.horizon = horizon
            replays = KernelReplays(replace(variant, subject=subject), begun, log, k)
            rows = np.arange(len(replays.data.u))
            time: Array = log.time[0] + replays.data.step * rows
            within = None
            if inside:
                within = inside[k][np.minimum(np.searchsorted(log.grid, rows), log.rows - 1)]
            tracks[end].append(track_of(time, replays.rows, replays.errors(), inside=within, free=horizon == FREE_RUN))
    return tracks


def _parameters(search: Search, f: Fit) -> dict[str, ParameterRecord]:
    declared = search.subject.declared
    return {
        p.name: ParameterRecord(value=float(f.values[p.name]), unit=declared[p.name].unit, ci95=f.interval(p.name))
        for p in f.free
        if not p.group
    }


def _correlations(f: Fit) -> Correlations:
    places = [k for k, p in enumerate(f.free) if not p.group]
    matrix = inverse(f.information)[np.ix_(places, places)]
    roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return Correlations(
        names=[f.free[k].name for k in places], matrix=np.clip(matrix / np.outer(roots, roots), -1.0, 1.0).tolist()
    )
