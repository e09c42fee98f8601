"""A log against an FMU: free run, windows, what noise alone would leave, and the answer in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.refine.against import delays, scales
from cosim.refine.drive import Drive
from cosim.refine.finding import Finding
from cosim.refine.gate import ORDER, refuse_faults
from cosim.refine.log import Column, Log
from cosim.refine.replay import HORIZONS, Replay, horizons, self_started
from cosim.refine.residual import (
    FREE_RUN,
    InputCorrelation,
    Score,
    Whiteness,
    input_correlations,
    lags_of,
    noise_level,
    pooled,
    rmse,
    score,
    whiteness,
)
from cosim.refine.starts import StartParameter, start_parameters
from cosim.report.text import plain, size

FLOOR_DRAWS, FLOOR_SEED = 2, 1
BEYOND_NOISE = 1.5  # times the floor, which two draws give to about 15 %
ROUNDING = 1e-9  # of a channel's size
EXACT = 1e-4  # of a channel's spread; a log without noise is matched to rounding, not to noise


@dataclass(frozen=True, eq=False)
class ChannelSummary:
    """One measured channel against the model.

    horizon: of the windows that measure [s]
    noise:   standard deviation of its measurement noise, `floor`: RMSE over the horizon that noise alone explains
    astray:  the same of the model against itself, restarted from its own outputs without noise; 0 if by rounding only
    scores:  horizon → score; whiteness and inputs are of the residual over the shortest horizon
    """

    name: str
    unit: str
    horizon: float
    noise: float
    floor: float
    astray: float
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
        return self.astray > self.floor

    @property
    def excess(self) -> float:
        """RMSE over what noise explains; NaN where no window measures."""
        windowed = self.measure != FREE_RUN and not self.lost
        return self.scores[self.horizon].rmse / self.floor if windowed and self.floor > 0.0 else math.nan

    @property
    def matched(self) -> bool:
        """No larger than noise explains, or than rounding; or there is nothing to compare."""
        found = self.scores[self.measure]
        exact = found.rows == 0 or found.fit > 100.0 * (1.0 - EXACT)
        return not self.lost and (exact or self.excess < BEYOND_NOISE)


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
        if (found := self_started(drive, parameters, free, horizon)) is not None:
            replays[horizon] = found
    floor, astray = against_itself(drive, parameters, free, measure) if measure in replays else ({}, {})
    channels = tuple(
        _summary(log, replays, name, measure, floor.get(name, math.nan), astray.get(name, math.nan))
        for name in log.outputs
    )
    everything = sorted((*findings, *against, *_lost(channels)), key=lambda f: ORDER.index(f.severity))
    return Comparison(log, drive, replays, channels, tuple(everything))


def steps_of(log: Log) -> int:
    """Steps a comparison makes, about."""
    return log.rows * (1 + len(HORIZONS) + 1 + FLOOR_DRAWS)


def against_itself(
    drive: Drive, parameters: Mapping[str, StartParameter], free: Replay, horizon: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Channel → RMSE over the horizon that noise alone explains; that of the model restarted from its own outputs.

    The model is replayed against its free run, seen through the noise and the holes of the log, and through the
    holes only. What it misses even so is not the noise's: it keeps something that no output shows.
    """
    log = drive.log
    alike = {n: np.where(np.isfinite(v), free.outputs[n], np.nan) for n, v in log.outputs.items()}

    def predicted(seen: Mapping[str, Column]) -> Mapping[str, Column]:
        found = self_started(drive.on(replace(log, outputs=seen)), parameters, free, horizon)
        return {} if found is None else found.outputs

    restarted, errors = predicted(alike), []
    for draw in range(FLOOR_DRAWS):
        rng = np.random.default_rng([FLOOR_SEED, draw])
        levels = {name: noise_level(values) for name, values in log.outputs.items()}
        noise = {n: (0.0 if math.isnan(s) else s) * rng.standard_normal(log.rows) for n, s in levels.items()}
        noisy = predicted({n: values + noise[n] for n, values in alike.items()})
        errors.append({n: alike[n] + noise[n] - (noisy[n] - (restarted[n] - free.outputs[n])) for n in alike})
    return pooled(errors), {n: _astray(values, restarted[n]) for n, values in alike.items()}


def _astray(model: Column, restarted: Column) -> float:
    error = model - restarted
    seen = model[np.isfinite(error)]
    least = max(EXACT * float(np.std(seen)), ROUNDING * float(np.max(np.abs(seen)))) if seen.size else math.inf
    return found if (found := rmse(error)) > least else 0.0


def _lost(channels: Sequence[ChannelSummary]) -> Iterator[Finding]:
    for c in (c for c in channels if c.lost):
        yield Finding(
            "warning", "hidden_state", c.name,
            f"is missed by {size(c.astray, c.unit)} over {plain(c.horizon)}\u00a0s where the FMU is restarted from "
            "its own outputs: it keeps a state that no output shows, and only the free run measures it",
            {"rmse": c.astray, "noise": c.floor},
        )  # fmt: skip


def _summary(
    log: Log, replays: Mapping[float, Replay], name: str, horizon: float, floor: float, astray: float
) -> ChannelSummary:
    measured = log.outputs[name]
    scores = {horizon: score(measured, r.outputs[name]) for horizon, r in sorted(replays.items())}
    residual = measured - replays[min(replays)].outputs[name]
    lags = lags_of(log.rows, log.step)
    return ChannelSummary(
        name, log.units[name], horizon, noise_level(measured), floor, astray, scores,
        whiteness(residual, lags), input_correlations(residual, log.inputs, lags),
    )  # fmt: skip
