"""The record of credibility of a fitted FMU, from held-out replays of the logs of the estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.calibration.fit_record import Record
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Flags
from cosim.core.errors import SimulationError
from cosim.credibility.bands import LEAST_ROWS, Coverage, Track, band_horizons, bands_of, coverage_of, track_of
from cosim.credibility.record import Correlations, Credibility, ParameterRecord
from cosim.estimation.fit import inverse
from cosim.residuals.drive import Drive
from cosim.residuals.log_region import log_records, region_of_logs, rows_inside
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.windows import SKIPPED, Replay, free_run, horizons, self_started

Values = Mapping[str, float]


def credibility_of(
    record: Record, likelihood: Likelihood, drives: Sequence[Drive], sealed: Sequence[Drive], values: Sequence[Values]
) -> tuple[Credibility, Coverage | None]:
    """Return the record of a fitted FMU, and the coverage of its bands on sealed logs.

    Args:
        drives: Drives of the logs of the estimate.
        values: Estimates for each of these logs.
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
    """Return the estimates for log k without that log, by one Gauss-Newton step from the estimate with it.

    With the slopes S and errors e of a log, weighted by the noise, and the precision P of the priors, the step is
    (Σ S'·S + P)⁻¹·S_k'·e_k, where the sum is over the other logs.
    """
    sigma, information = likelihood.best.sigma, np.diag(likelihood.precision)
    gradient = np.zeros(likelihood.best.x.size)
    for place, (slope, table) in enumerate(zip(likelihood.slopes, likelihood.best.tables, strict=True)):
        good = np.isfinite(table)
        rows = (slope / sigma[:, None])[good]
        if place == k:
            gradient = rows.T @ (table / sigma)[good]
        else:
            information = information + rows.T @ rows
    moved = np.clip(likelihood.best.x + inverse(information) @ gradient, likelihood.low, likelihood.high)
    names = {u.name for u in likelihood.unknowns if u.log is None}
    changed = {n: v for n, v in likelihood.values(moved, k).items() if n in names}
    return {**values, **changed} if len(likelihood.slopes) > 1 else dict(values)


def _replay(drive: Drive, horizon: float) -> Replay:
    """Return windows of a horizon, or the free run where there are none."""
    free = free_run(drive)
    return (None if horizon == FREE_RUN else self_started(drive, free, horizon)) or free


def _tracks(
    drives: Sequence[Drive], spans: Mapping[float, float], inside: Sequence[Flags] = ()
) -> dict[float, list[Track]]:
    """Return end of interval → track of each log; a log on which the FMU fails or allows no windows has none."""
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
