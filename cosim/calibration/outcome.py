"""Outcome of a fit: errors before and after, the content of fit.json, and sentences derived from the numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.calibration.estimate import Estimate
from cosim.calibration.fit_record import (
    ChannelErrors,
    NoiseEntry,
    ParameterEntry,
    PartErrors,
    Record,
    StartEntry,
    Verdict,
    finite,
)
from cosim.calibration.fit_study import Request
from cosim.core.text import amount, counted, join_names, plain, size
from cosim.logs.log import Log
from cosim.refinement.proof.measure import find_rises
from cosim.residuals.drive import Drive
from cosim.residuals.floor import floors
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN, pool_errors, remaining_excess
from cosim.residuals.starts import start_parameters
from cosim.residuals.windows import Replay, free_run, horizons, self_started

CLEAR = 0.95  # ratio of errors from which the model is better
MOST = 2  # outputs in a headline


@dataclass(frozen=True, eq=False)
class Part:
    """A set of logs before and after the fit.

    Attributes:
        sealed: True for logs that were opened after the fit.
        horizon: Decisive horizon [s], FREE_RUN for free runs.
        before, after: For each log, its replays by horizon.
        floor: Channel → noise floor over the decisive horizon, root mean square over the logs.
    """

    sealed: bool
    horizon: float
    logs: Sequence[Log]
    before: Sequence[Mapping[float, Replay]]
    after: Sequence[Mapping[float, Replay]]
    floor: Mapping[str, float]

    @property
    def units(self) -> dict[str, str]:
        """Return the units of all signals."""
        return {n: u for log in self.logs for n, u in log.units.items()}

    def errors(self, horizon: float) -> dict[str, tuple[float, float]]:
        """Return channel → root mean square error before and after, pooled over the logs."""
        old, new = (
            pool_errors(replays[horizon].errors(log) for log, replays in zip(self.logs, side, strict=True))
            for side in (self.before, self.after)
        )
        return {name: (old[name], new[name]) for name in old}

    def entry(self) -> PartErrors:
        """Return the errors for fit.json."""
        channels, units = {}, self.units
        for name, (before, after) in self.errors(self.horizon).items():
            channels[name] = ChannelErrors(
                unit=units[name],
                before=finite(before),
                after=finite(after),
                noise_floor=finite(self.floor.get(name, math.nan)),
                excess_left=finite(remaining_excess(before, after, self.floor.get(name, 0.0))),
            )
        common = set.intersection(*map(set, (*self.before, *self.after)))
        horizons = {
            "free run" if h == FREE_RUN else f"{h:g} s": {
                n: (finite(a), finite(b)) for n, (a, b) in self.errors(h).items()
            }
            for h in sorted(common, key=lambda h: (h != self.horizon, h))
        }
        return PartErrors(horizon=finite(self.horizon), channels=channels, horizons=horizons)

    def rises(self) -> list[str]:
        """Return the outputs whose error rises significantly on sealed logs."""
        if not self.sealed:
            return []
        before, after = (
            [(log, r[self.horizon]) for log, r in zip(self.logs, side, strict=True)]
            for side in (self.before, self.after)
        )
        return [*find_rises(before, after)]

    def verdict(self) -> Verdict:
        """Return the verdict, by the geometric mean over the channels of the error after relative to that before."""
        pairs = [(a, b) for a, b in self.errors(self.horizon).values() if a > 0.0 and b > 0.0 and math.isfinite(a * b)]
        ratio = math.exp(float(np.mean([math.log(b / a) for a, b in pairs]))) if pairs else math.nan
        if ratio > 1.0 / CLEAR or self.rises():
            return "worse"
        return "improved" if ratio < CLEAR else "unchanged"


def prove(
    drives: Sequence[Drive],
    before: Sequence[Mapping[str, float]],
    after: Sequence[Mapping[str, float]],
    horizon: float,
    *,
    sealed: bool,
) -> Part:
    """Return the errors of a set of logs by the replays of `cosim replay`, with the values before and after.

    Args:
        horizon: Horizon of the noise floor of the values after; FREE_RUN for free runs.
    """
    old, new, squares = list[Mapping[float, Replay]](), list[Mapping[float, Replay]](), dict[str, list[float]]()
    for side, every in ((old, before), (new, after)):
        for drive, values in zip(drives, every, strict=True):
            moved = drive.with_values(values)
            parameters, free = start_parameters(moved), free_run(moved)
            replays = {FREE_RUN: free}
            if (windowed := self_started(moved, parameters, free, horizons(moved.log)[-1])) is not None:
                replays[windowed.horizon] = windowed
            if side is new:
                for name, floor in floors(moved, parameters, free, replays.get(horizon, free)).items():
                    squares.setdefault(name, []).extend([floor.rmse**2] if math.isfinite(floor.rmse) else [])
            side.append(replays)
    if not all(horizon in replays for replays in (*old, *new)):
        horizon = FREE_RUN
    pooled = {name: math.sqrt(float(np.mean(each))) for name, each in squares.items() if each}
    return Part(sealed, horizon, [d.log for d in drives], old, new, pooled)


def write_record(
    request: Request, estimate: Estimate, parts: Sequence[Part], given: Mapping[str, Any], seconds: float
) -> Record:
    """Return the content of fit.json.

    Args:
        parts: Errors on the logs of the estimate, then on sealed logs; empty for a stopped fit.
        given: Values of `--start` that are not estimated.
    """
    assert estimate.likelihood is not None
    logs, spread, point, unknowns = (
        estimate.logs,
        estimate.covariance,
        estimate.likelihood.best,
        estimate.likelihood.unknowns,
    )
    alone = {n for c in estimate.combinations for n in c.names}
    parameters, starts = dict[str, ParameterEntry](), list[StartEntry]()

    def interval(j: int) -> tuple[float, float] | None:
        value, half = float(point.x[j]), math.nan if spread is None else spread.half(j)
        return (value - half, value + half) if math.isfinite(half) else None

    for j, (unknown, value) in enumerate(zip(unknowns, point.x.tolist(), strict=True)):
        p = unknown.parameter
        common = {"value": value, "unit": p.unit}
        if unknown.log is not None:
            path = str(logs.drives[unknown.log].log.path)
            starts.append(StartEntry(**common, log=path, name=p.name, ci95=interval(j), named=not unknown.is_shown))
            continue
        parameters[p.name] = ParameterEntry(
            **common,
            **p.entry(),
            ci95=None if p.name in alone else interval(j),
            status="at_bound" if value in (p.low, p.high) else "estimated",
        )
    for p in estimate.held.values():
        parameters[p.name] = ParameterEntry(value=p.start, unit=p.unit, **p.entry(), ci95=None, status="held")
    correlation, colour = None, np.full(len(logs.channels), np.nan)
    if spread is not None:
        shared, colour = [j for j, u in enumerate(unknowns) if u.log is None], spread.colour
        matrix = spread.matrix[np.ix_(shared, shared)]
        roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        correlation = np.clip(matrix / np.outer(roots, roots), -1.0, 1.0).tolist()
    noise = zip(logs.channels, point.sigma.tolist(), colour.tolist(), strict=True)
    record = Record(
        fmu=str(request.fmu),
        logs=[str(p) for p in request.estimation],
        sealed=[str(p) for p in request.sealed],
        verdict=parts[-1].verdict() if parts else "stopped",
        sentence="",
        windows=logs.horizon,
        windows_reason=estimate.reason,
        parameters=parameters,
        starts=starts,
        given=dict(given),
        correlation=correlation,
        singular_values=estimate.singular.tolist(),
        combinations=estimate.combinations,
        screening=list(estimate.screened),
        noise={n: NoiseEntry(sigma=s, colour=finite(c)) for n, s, c in noise},
        errors={"sealed" if part.sealed else "estimation": part.entry() for part in parts},
        simulations=logs.count,
        failed_simulations=logs.failed,
        seconds=seconds,
        warnings=[],
        notes=[],
    )
    record.sentence = _sentence(record, parts)
    record.warnings = [*_warnings(record, estimate, parts)]
    if logs.horizon is not None:
        record.notes = [f"the estimate uses windows of {logs.horizon:g} s in place of free runs: {estimate.reason}"]
    return record


def _sentence(record: Record, parts: Sequence[Part]) -> str:
    """Return the verdict: a headline with the outputs that change most, and a sentence on what was estimated."""
    count = sum(entry.status != "held" for entry in record.parameters.values())
    runs = counted(record.simulations, "simulation")
    effort = f"{counted(count, 'parameter')} from {counted(len(record.logs), 'log')} by {runs}."
    if not parts:
        return f"The fit was stopped before its proof. The best values so far: {effort}"
    part = parts[-1]  # sealed logs, or those of the estimate without any
    logs = counted(len(part.logs), "sealed log" if part.sealed else "log")
    where = f"On {logs}" if part.sealed else f"On the {logs} of the estimate"
    error = "free-run error" if part.horizon == FREE_RUN else f"error over {horizon_name(part.horizon)}"
    errors = {n: (a, b) for n, (a, b) in part.errors(part.horizon).items() if a > 0.0 and b > 0.0}
    units = part.units
    order = sorted(errors, key=lambda n: errors[n][1] / errors[n][0], reverse=record.verdict == "worse")
    texts = [f"{n} from {size(errors[n][0], units[n])} to {size(errors[n][1], units[n])}" for n in order[:MOST]]
    change = {"improved": "falls", "worse": "does not fall"}.get(record.verdict, "hardly changes")
    unproven = " No sealed log confirms it." if record.verdict == "improved" and not part.sealed else ""
    return f"{where} the {error} {change}: {join_names(texts) or 'there is none'}.{unproven} {effort}"


def _warnings(record: Record, estimate: Estimate, parts: Sequence[Part]) -> Iterator[str]:
    """Yield the warnings of a fit."""
    for c in estimate.combinations:
        held = record.parameters[c.held]
        yield (
            f"{c.sentence}; {c.held} is held at {amount(held.value, held.unit, 4)}, and none of them has an interval"
        )
    if estimate.idle:
        yield f"no effect on any measured output of these logs, so the value is kept: {join_names(estimate.idle)}"
    for name, entry in record.parameters.items():
        if entry.status == "at_bound":
            yield (
                f"{name} ends at its bound {amount(entry.value, entry.unit, 4)}: its interval ignores the bound, "
                "and the bound may be wrong"
            )
        elif entry.ci95 is not None and entry.ci95[1] - entry.ci95[0] > abs(entry.start) > 0.0:
            yield (
                f"{name} is barely determined by these logs: its 95 % interval is wider than its value before the fit"
            )
    if estimate.covariance is not None and not estimate.settled:
        yield "the estimate did not settle: the likelihood is rough, and the intervals are unsure"
    if estimate.logs.first_failure is not None:
        values, error = estimate.logs.first_failure
        shown = ", ".join(f"{n} = {plain(v, 4)}" for n, v in values.items() if n in record.parameters)
        count = f"{record.failed_simulations} of {record.simulations}"
        yield f"{count} simulations failed and were rejected, first at {shown}: {error}"
    if estimate.dropped:
        yield f"windows have start values of their own, so {join_names(estimate.dropped)} is not estimated"
    if parts and (risen := parts[-1].rises()):
        yield f"on sealed logs the error of {join_names(risen)} rises by more than its scatter from part to part"
    if estimate.covariance is not None and (names := estimate.above_noise()):
        yield (
            f"the error of {join_names(names)} stays above the noise and is not white: no value of these "
            "parameters explains it. `cosim refine` looks for what the FMU lacks, with a study of the same logs"
        )
