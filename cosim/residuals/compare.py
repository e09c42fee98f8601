"""Comparison of a log with an FMU: free run, windows, noise floor and statistics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.core.text import plain, size
from cosim.logs.channel_noise import least_noise_level
from cosim.logs.gate import ORDER, refuse_faults
from cosim.logs.log import Finding, Log
from cosim.logs.model_comparison import output_findings
from cosim.residuals.drive import Drive
from cosim.residuals.floor import EXACT, ChannelFloor, draws, floors
from cosim.residuals.residual_statistics import (
    FREE_RUN,
    InputCorrelation,
    Score,
    Whiteness,
    input_correlations,
    lags_of,
    score,
    whiteness,
)
from cosim.residuals.starts import start_parameters
from cosim.residuals.windows import HORIZONS, Replay, horizons, self_started

FOLLOWS = 2.5  # multiple of the 95 % band, five standard errors: beyond chance despite slow start errors


@dataclass(frozen=True, eq=False)
class ChannelSummary:
    """Comparison of one measured channel with the model.

    Attributes:
        horizon: Horizon of the windows [s].
        measure: Horizon that decides the verdict [s]: that of the windows if available, else FREE_RUN.
        noise: Standard deviation of the measurement noise.
        floor: Noise floor over the horizon, or over the free run without windows.
        scores: Horizon → score.
        whiteness, inputs: Statistics of the residual over the shortest horizon.
        lost: Restarts without noise miss by more than the noise floor, due to a state without output.
        excess: RMSE relative to the noise floor; NaN without a valid floor.
        is_matched: The error is not above that of noise or rounding.
        is_explained: The error is matched, and follows no input.
    """

    name: str
    unit: str
    horizon: float
    measure: float
    noise: float
    floor: ChannelFloor
    scores: Mapping[float, Score]
    whiteness: Whiteness
    inputs: tuple[InputCorrelation, ...]
    lost: bool
    excess: float
    is_matched: bool
    is_explained: bool


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of a replay; `replays` by horizon always includes FREE_RUN."""

    log: Log
    drive: Drive
    replays: Mapping[float, Replay]
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]


def compare(drive: Drive, free: Replay, findings: Sequence[Finding] = ()) -> Comparison:
    """Return the complete comparison for a free run, with windows, noise floor and statistics.

    Args:
        findings: Earlier findings on the log, included in the result.

    Raises:
        InputError: The comparison shows a wrong unit.
    """
    log, replays, parameters = drive.log, {FREE_RUN: free}, start_parameters(drive)
    *_, measure = spans = horizons(log)
    against = output_findings(log, free.outputs)
    refuse_faults(log, against)
    for horizon in spans:
        if (windowed := self_started(drive, parameters, free, horizon)) is not None:
            replays[horizon] = windowed
    floor = floors(drive, parameters, free, replays.get(measure, free))
    channels = tuple(_summary(log, replays, name, measure, floor[name]) for name in log.outputs)
    hidden = [
        Finding(
            "warning",
            "hidden_state",
            c.name,
            f"is missed by {size(c.floor.astray, c.unit)} over {plain(c.horizon)}\u00a0s where the FMU is restarted "
            "from its own outputs: it keeps a state that no output shows, and only the free run measures it",
            {"rmse": c.floor.astray, "noise": c.floor.rmse},
        )
        for c in channels
        if c.lost
    ]
    everything = sorted((*findings, *against, *hidden), key=lambda f: ORDER.index(f.severity))
    return Comparison(log, drive, replays, channels, tuple(everything))


def steps_of(log: Log) -> int:
    """Return the approximate number of steps of a comparison."""
    return log.rows * (1 + len(HORIZONS) + 1 + draws(log, horizons(log)[-1]))


def _summary(
    log: Log, replays: Mapping[float, Replay], name: str, horizon: float, floor: ChannelFloor
) -> ChannelSummary:
    measured = log.outputs[name]
    scores = {horizon: score(measured, r.outputs[name]) for horizon, r in sorted(replays.items())}
    residual = measured - replays[min(replays)].outputs[name]
    lags = lags_of(log.rows, log.step)
    inputs = input_correlations(residual, log.inputs, lags)
    measure = horizon if horizon in scores else FREE_RUN
    error, lost = scores[measure], floor.astray > floor.rmse
    excess = error.rmse / floor.rmse if not lost and floor.rmse > 0.0 else math.nan
    # at rounding level, or without anything to compare
    exact = error.rows == 0 or error.rmse == 0.0 or error.fit > 100.0 * (1.0 - EXACT)
    matched = not lost and (exact or excess < floor.limit)
    return ChannelSummary(
        name=name,
        unit=log.units[name],
        horizon=horizon,
        measure=measure,
        noise=least_noise_level(measured, replays[FREE_RUN].outputs[name]),
        floor=floor,
        scores=scores,
        whiteness=whiteness(residual, lags),
        inputs=inputs,
        lost=lost,
        excess=excess,
        is_matched=matched,
        is_explained=matched and (exact or not any(u.strength > FOLLOWS for u in inputs[:1])),
    )


def as_json(comparison: Comparison) -> list[dict[str, Any]]:
    """Return RMSE, fit [%], rows and noise floor of each channel and horizon.

    Infinite values are None; `horizon` [s] is that of the verdict, None for the free run.
    """

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    channels = []
    for c in comparison.channels:
        scores = {h: {"rmse": finite(s.rmse), "fit": finite(s.fit), "rows": s.rows} for h, s in c.scores.items()}
        channels.append(
            {
                "name": c.name,
                "unit": c.unit,
                "horizon": finite(c.measure),
                **scores[c.measure],
                "noise_floor": finite(c.floor.rmse),
                "times_noise": finite(c.excess),
                "explained": c.is_explained,
                "free_run": scores[FREE_RUN],
                "windows": [{"horizon": h, **s} for h, s in sorted(scores.items()) if h != FREE_RUN],
            }
        )
    return channels
