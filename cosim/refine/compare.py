"""A log against an FMU: free run, windows, what noise alone would leave, and the answer in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.refine.against import delays, scales
from cosim.refine.drive import Drive
from cosim.refine.finding import Finding
from cosim.refine.gate import ORDER, refuse_faults
from cosim.refine.log import Log
from cosim.refine.replay import HORIZON, HORIZONS, Replay, self_started
from cosim.refine.residual import (
    FREE_RUN,
    InputCorrelation,
    Score,
    Whiteness,
    input_correlations,
    lags_of,
    noise_level,
    pooled,
    score,
    whiteness,
)
from cosim.refine.starts import StartParameter, start_parameters

FLOOR_DRAWS, FLOOR_SEED = 2, 1
BEYOND_NOISE = 1.5  # times the floor, which two draws give to about 15 %
EXACT = 1e-4  # of a channel's spread; a log without noise is matched to rounding, not to noise


@dataclass(frozen=True, eq=False)
class ChannelSummary:
    """One measured channel against the model.

    noise:  standard deviation of its measurement noise, `floor`: RMSE over HORIZON that noise alone explains
    scores: horizon → score; whiteness and inputs are of the residual over the shortest horizon
    """

    name: str
    unit: str
    noise: float
    floor: float
    scores: Mapping[float, Score]
    whiteness: Whiteness
    inputs: tuple[InputCorrelation, ...]

    @property
    def measure(self) -> float:
        """The horizon that counts: HORIZON where there are windows, else the free run."""
        return HORIZON if HORIZON in self.scores else FREE_RUN

    @property
    def excess(self) -> float:
        """RMSE over what noise explains; NaN where there are no windows."""
        return self.scores[HORIZON].rmse / self.floor if HORIZON in self.scores and self.floor > 0.0 else math.nan

    @property
    def matched(self) -> bool:
        """No larger than noise explains, or than rounding; or there is nothing to compare."""
        found = self.scores[self.measure]
        return found.rows == 0 or found.fit > 100.0 * (1.0 - EXACT) or self.excess < BEYOND_NOISE


@dataclass(frozen=True, eq=False)
class Comparison:
    """Everything a replay found out; `replays` by horizon, FREE_RUN always among them."""

    log: Log
    drive: Drive
    replays: Mapping[float, Replay]
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]

    @property
    def basis(self) -> float:
        """The horizon whose residual is tested: the shortest."""
        return min(self.replays)


def compare(drive: Drive, free: Replay, findings: Sequence[Finding] = ()) -> Comparison:
    """Windows, noise floor and residual statistics around a free run; InputError where it shows a wrong unit."""
    log, replays, parameters = drive.log, {FREE_RUN: free}, start_parameters(drive)
    against = [*scales(log, free.outputs), *delays(log, free.outputs)]
    refuse_faults(log, against)
    for horizon in HORIZONS:
        if (found := self_started(drive, parameters, free, horizon)) is not None:
            replays[horizon] = found
    floor = noise_floor(drive, parameters, free) if HORIZON in replays else {}
    channels = tuple(_summary(log, replays, name, floor.get(name, math.nan)) for name in log.outputs)
    everything = sorted((*findings, *against), key=lambda f: ORDER.index(f.severity))
    return Comparison(log, drive, replays, channels, tuple(everything))


def steps_of(log: Log) -> int:
    """Steps a comparison makes, about."""
    return log.rows * (1 + len(HORIZONS) + FLOOR_DRAWS)


def noise_floor(drive: Drive, parameters: Mapping[str, StartParameter], free: Replay) -> dict[str, float]:
    """Channel → RMSE over HORIZON of the model against itself, its outputs seen through the log's noise and holes."""
    log, errors = drive.log, []
    for draw in range(FLOOR_DRAWS):
        rng = np.random.default_rng([FLOOR_SEED, draw])
        seen = {}
        for name, values in log.outputs.items():
            level = noise_level(values)
            noise = (0.0 if math.isnan(level) else level) * rng.standard_normal(log.rows)
            seen[name] = np.where(np.isfinite(values), free.outputs[name] + noise, np.nan)
        pretended = replace(log, outputs=seen)
        windows = self_started(drive.on(pretended), parameters, free, HORIZON)
        if windows is not None:
            errors.append(windows.errors(pretended))
    return pooled(errors)


def _summary(log: Log, replays: Mapping[float, Replay], name: str, floor: float) -> ChannelSummary:
    measured = log.outputs[name]
    scores = {horizon: score(measured, r.outputs[name]) for horizon, r in sorted(replays.items())}
    residual = measured - replays[min(replays)].outputs[name]
    lags = lags_of(log.rows, log.step)
    return ChannelSummary(
        name, log.units[name], noise_level(measured), floor, scores,
        whiteness(residual, lags), input_correlations(residual, log.inputs, lags),
    )  # fmt: skip
