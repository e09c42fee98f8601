"""Comparison of a log with an FMU: free run, windows, noise floor and statistics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cosim.base.text import plain, size
from cosim.logs.channel_noise import least_noise_level
from cosim.logs.finding import Finding
from cosim.logs.gate import ORDER, refuse_faults
from cosim.logs.log import Log
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
        noise: Standard deviation of the measurement noise.
        floor: Noise floor over the horizon, or over the free run without windows.
        scores: Horizon → score.
        whiteness, inputs: Statistics of the residual over the shortest horizon.
    """

    name: str
    unit: str
    horizon: float
    noise: float
    floor: ChannelFloor
    scores: Mapping[float, Score]
    whiteness: Whiteness
    inputs: tuple[InputCorrelation, ...]

    @property
    def measure(self) -> float:
        """Return the horizon that decides the verdict [s]: that of the windows if available, else FREE_RUN."""
        return self.horizon if self.horizon in self.scores else FREE_RUN

    @property
    def lost(self) -> bool:
        """Return True if restarts without noise miss by more than the noise floor, due to a state without output."""
        return self.floor.astray > self.floor.rmse

    @property
    def excess(self) -> float:
        """Return the RMSE relative to the noise floor; NaN without a valid floor."""
        floor = self.floor.rmse
        return self.scores[self.measure].rmse / floor if not self.lost and floor > 0.0 else math.nan

    @property
    def exact(self) -> bool:
        """Return True if the error is at rounding level, or if nothing can be compared."""
        score = self.scores[self.measure]
        return score.rows == 0 or score.rmse == 0.0 or score.fit > 100.0 * (1.0 - EXACT)

    @property
    def is_matched(self) -> bool:
        """Return True if the error is not above that of noise or rounding."""
        return not self.lost and (self.exact or self.excess < self.floor.limit)

    @property
    def is_explained(self) -> bool:
        """Return True if the error is not above noise or rounding, and follows no input."""
        return self.is_matched and (self.exact or not any(u.strength > FOLLOWS for u in self.inputs[:1]))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of a replay; `replays` by horizon always includes FREE_RUN."""

    log: Log
    drive: Drive
    replays: Mapping[float, Replay]
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]

    @property
    def measure(self) -> float:
        """Return the horizon that decides the verdict [s]: the last of `horizons`."""
        return horizons(self.log)[-1]

    @property
    def basis(self) -> float:
        """Return the shortest horizon, whose residual is tested."""
        return min(self.replays)


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
    everything = sorted((*findings, *against, *_hidden_states(channels)), key=lambda f: ORDER.index(f.severity))
    return Comparison(log, drive, replays, channels, tuple(everything))


def steps_of(log: Log) -> int:
    """Return the approximate number of steps of a comparison."""
    return log.rows * (1 + len(HORIZONS) + 1 + draws(log, horizons(log)[-1]))


def _hidden_states(channels: Sequence[ChannelSummary]) -> Iterator[Finding]:
    for c in channels:
        if c.lost:
            message = (
                f"is missed by {size(c.floor.astray, c.unit)} over {plain(c.horizon)} s where the FMU is "
                "restarted from its own outputs: it keeps a state that no output shows, and only the free run "
                "measures it"
            )
            yield Finding("warning", "hidden_state", c.name, message, {"rmse": c.floor.astray, "noise": c.floor.rmse})


def _summary(
    log: Log, replays: Mapping[float, Replay], name: str, horizon: float, floor: ChannelFloor
) -> ChannelSummary:
    measured = log.outputs[name]
    scores = {horizon: score(measured, r.outputs[name]) for horizon, r in sorted(replays.items())}
    residual = measured - replays[min(replays)].outputs[name]
    lags = lags_of(log.rows, log.step)
    noise = least_noise_level(measured, replays[FREE_RUN].outputs[name])
    inputs = input_correlations(residual, log.inputs, lags)
    return ChannelSummary(name, log.units[name], horizon, noise, floor, scores, whiteness(residual, lags), inputs)
