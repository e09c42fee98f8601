"""A log against an FMU: free run, windows, what noise alone would leave, and the answer in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cosim.base.text import plain, size
from cosim.logs.channel_noise import noise_beside
from cosim.logs.finding import Finding
from cosim.logs.gate import ORDER, refuse_faults
from cosim.logs.log import Log
from cosim.residuals.against import delays, scales
from cosim.residuals.drive import Drive
from cosim.residuals.floor import EXACT, Floor, draws, floors
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

FOLLOWS = 2.5  # times the 95 % band, five standard errors: no chance, though errors of the start are slow


@dataclass(frozen=True, eq=False)
class ChannelSummary:
    """One measured channel against the model.

    horizon: of the windows that measure [s]
    noise:   standard deviation of its measurement noise
    floor:   what noise alone explains over that, or over the free run where there are no windows
    scores:  horizon → score; whiteness and inputs are of the residual over the shortest horizon
    """

    name: str
    unit: str
    horizon: float
    noise: float
    floor: Floor
    scores: Mapping[float, Score]
    whiteness: Whiteness
    inputs: tuple[InputCorrelation, ...]

    @property
    def measure(self) -> float:
        """The horizon that counts: the windows' where there are any, else the free run."""
        return self.horizon if self.horizon in self.scores else FREE_RUN

    @property
    def lost(self) -> bool:
        """Windows are no measure: the model loses itself in them by more than noise explains."""
        return self.floor.astray > self.floor.rmse

    @property
    def excess(self) -> float:
        """RMSE over what noise explains; NaN where neither windows nor noise are a measure."""
        floor = self.floor.rmse
        return self.scores[self.measure].rmse / floor if not self.lost and floor > 0.0 else math.nan

    @property
    def exact(self) -> bool:
        """No larger than rounding, or there is nothing to compare."""
        found = self.scores[self.measure]
        return found.rows == 0 or found.rmse == 0.0 or found.fit > 100.0 * (1.0 - EXACT)

    @property
    def matched(self) -> bool:
        """No larger than noise explains, or than rounding."""
        return not self.lost and (self.exact or self.excess < self.floor.limit)

    @property
    def explained(self) -> bool:
        """Matched, and what is left follows no command, however small it is."""
        return self.matched and (self.exact or not any(u.strength > FOLLOWS for u in self.inputs[:1]))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Everything a replay found out; `replays` by horizon, FREE_RUN always among them."""

    log: Log
    drive: Drive
    replays: Mapping[float, Replay]
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]

    @property
    def measure(self) -> float:
        """The horizon that counts, where there are windows of it."""
        return horizons(self.log)[-1]

    @property
    def basis(self) -> float:
        """The horizon whose residual is tested: the shortest."""
        return min(self.replays)


def compare(drive: Drive, free: Replay, findings: Sequence[Finding] = ()) -> Comparison:
    """Windows, noise floor and residual statistics around a free run; InputError where it shows a wrong unit."""
    log, replays, parameters = drive.log, {FREE_RUN: free}, start_parameters(drive)
    *_, measure = spans = horizons(log)
    against = [*scales(log, free.outputs), *delays(log, free.outputs)]
    refuse_faults(log, against)
    for horizon in spans:
        if (windowed := self_started(drive, parameters, free, horizon)) is not None:
            replays[horizon] = windowed
    floor = floors(drive, parameters, free, replays.get(measure, free))
    channels = tuple(_summary(log, replays, name, measure, floor[name]) for name in log.outputs)
    everything = sorted((*findings, *against, *_lost(channels)), key=lambda f: ORDER.index(f.severity))
    return Comparison(log, drive, replays, channels, tuple(everything))


def steps_of(log: Log) -> int:
    """Steps a comparison makes, about."""
    return log.rows * (1 + len(HORIZONS) + 1 + draws(log, horizons(log)[-1]))


def _lost(channels: Sequence[ChannelSummary]) -> Iterator[Finding]:
    for c in (c for c in channels if c.lost):
        error = f"{size(c.floor.astray, c.unit)} over {plain(c.horizon)}\u00a0s"
        why = "it keeps a state that no output shows, and only the free run measures it"
        sentence = f"is missed by {error} where the FMU is restarted from its own outputs: {why}"
        yield Finding("warning", "hidden_state", c.name, sentence, {"rmse": c.floor.astray, "noise": c.floor.rmse})


def _summary(log: Log, replays: Mapping[float, Replay], name: str, horizon: float, floor: Floor) -> ChannelSummary:
    measured = log.outputs[name]
    scores = {horizon: score(measured, r.outputs[name]) for horizon, r in sorted(replays.items())}
    residual = measured - replays[min(replays)].outputs[name]
    lags = lags_of(log.rows, log.step)
    noise = noise_beside(measured, replays[FREE_RUN].outputs[name])
    inputs = input_correlations(residual, log.inputs, lags)
    return ChannelSummary(name, log.units[name], horizon, noise, floor, scores, whiteness(residual, lags), inputs)
