"""Comparison of a log with an FMU: free run, windows, statistics, and sentences derived from the numbers.

The noise floor is the error of replays of the model's own output, with the sampling and noise of the log.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from cosim.core.arrays import Array, NamedArrays
from cosim.core.errors import SimulationError
from cosim.core.text import join_names, plain, size
from cosim.logs.gate import SEVERITIES, refuse_faults
from cosim.logs.log import SENSOR_FINDING, Finding, Log, least_noise_level
from cosim.logs.model_comparison import output_findings
from cosim.residuals.drive import Drive, as_columns
from cosim.residuals.residual_statistics import (
    FREE_RUN,
    InputCorrelation,
    Score,
    Whiteness,
    finite,
    input_correlations,
    lags_of,
    pool_errors,
    rmse,
    score,
    whiteness,
)
from cosim.residuals.windows import (
    HORIZONS,
    Replay,
    chains,
    first_start,
    horizons,
    replays_over,
    self_started,
)

MIN_DRAWN_WINDOWS, MIN_DRAWS, FREE_RUN_DRAWS, WINDOWS_SEED = 40, 2, 10, 1  # least number of windows drawn
BY_CHANCE = 1e-4  # false alarm probability of a correct model for each channel
AT_LEAST = 1.5  # least limit relative to the floor, since noise levels are estimates
ROUNDING_SHARE = 1e-9  # share of a channel's size
NEGLIGIBLE_ERROR_SHARE = 1e-4  # share of a channel's spread; a log without noise is matched to rounding
Verdict = Literal["explained", "unexplained", "undecided"]
FOLLOWS = 2.5  # multiple of the 95 % band beyond chance: five standard errors, because start errors are slow


class ChannelFloor(NamedTuple):
    """Noise floor of one channel (RMSE due to noise), and the largest error of a correct model relative to it.

    Attributes:
        astray: RMSE of windows that restart the model from its own outputs without noise; 0 if due to rounding.
    """

    rmse: float
    limit: float
    astray: float


@dataclass(frozen=True, eq=False)
class ChannelSummary:
    """Comparison of one measured channel with the model.

    Attributes:
        measure: Horizon [s] that decides the verdict: that of windows if there are any, otherwise FREE_RUN.
        noise: Standard deviation of the measurement noise.
        floor: Noise floor for this horizon.
        scores: Horizon → score (RMSE and fit).
        whiteness, inputs: Statistics of the residual over the shortest horizon.
        lost: True if restarts without noise have an error above the noise floor, due to a state without output.
        excess: RMSE divided by the noise floor; NaN without a valid floor.
        is_matched: True if noise or rounding explains the size of the error.
        is_explained: True if `is_matched`, and the error is not correlated with an input.
    """

    name: str
    unit: str
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
    """Result of a replay. `replays` (horizon → replay) always contains FREE_RUN."""

    log: Log
    drive: Drive
    replays: Mapping[float, Replay]
    channels: tuple[ChannelSummary, ...]
    findings: tuple[Finding, ...]


def compare(drive: Drive, free: Replay, findings: Sequence[Finding]) -> Comparison:
    """Return the comparison of a log with a free run, including windows, noise floor and statistics.

    Args:
        findings: Findings of the log's checks, which are included in the result.

    Raises:
        InputError: The comparison shows that a column has a wrong unit.
    """
    log = drive.log
    *_, measure = spans = horizons(log)
    against = output_findings(log, free.outputs)
    refuse_faults(log, against)
    replays = replays_over(drive, free, spans)
    every = floors(drive, free, replays.get(measure, free))
    channels, hidden, lags = [], list[Finding](), lags_of(log.rows, log.step)
    for name, measured in log.outputs.items():
        scores = {span: score(measured, replay.outputs[name]) for span, replay in sorted(replays.items())}
        residual, floor, unit = measured - replays[min(replays)].outputs[name], every[name], log.units[name]
        inputs = input_correlations(residual, log.inputs, lags)
        decisive = measure if measure in scores else FREE_RUN
        error, lost = scores[decisive], floor.astray > floor.rmse
        excess = error.rmse / floor.rmse if not lost and floor.rmse > 0.0 else math.nan
        # at rounding level, or without anything to compare
        exact = error.rows == 0 or error.rmse == 0.0 or error.fit > 100.0 * (1.0 - NEGLIGIBLE_ERROR_SHARE)
        matched = not lost and (exact or excess < floor.limit)
        explained = matched and (exact or not any(u.strength > FOLLOWS for u in inputs[:1]))
        noise, white = least_noise_level(measured, free.outputs[name]), whiteness(residual, lags)
        errors = noise, floor, scores, white, inputs
        channels.append(ChannelSummary(name, unit, decisive, *errors, lost, excess, matched, explained))
        if lost:
            message = (
                f"differs by {size(floor.astray, unit)} over {plain(measure)}\u00a0s if the FMU is restarted from its "
                "own outputs: the FMU has a state that no output determines, so only the run over the whole log "
                "judges it"
            )
            numbers = {"rmse": floor.astray, "noise": floor.rmse}
            hidden.append(Finding("warning", "hidden_state", name, message, numbers))
    everything = sorted((*findings, *against, *hidden), key=lambda f: SEVERITIES.index(f.severity))
    return Comparison(log, drive, replays, tuple(channels), tuple(everything))


def steps_of(log: Log) -> int:
    """Return the approximate number of steps of a comparison."""
    return log.rows * (1 + len(HORIZONS) + 1 + draws(log, horizons(log)[-1]))


def as_json(comparison: Comparison) -> list[dict[str, Any]]:
    """Return RMSE, fit [%], rows and noise floor of each channel and horizon.

    Infinite values are None; `horizon` [s] is the horizon that decides the verdict, None for the free run.
    """
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


# -- noise floor ----------------------------------------------------------------------------------


def draws(log: Log, horizon: float) -> int:
    """Return the number of random draws for the noise floor of a log; with few windows, more draws are needed."""
    if horizon == FREE_RUN:
        return FREE_RUN_DRAWS
    count = sum(sum(row >= begin for row in rows[:-1]) for rows, begin in chains(log, horizon))
    return max(MIN_DRAWS, math.ceil(MIN_DRAWN_WINDOWS / max(1, count)))


def floors(drive: Drive, free: Replay, measured: Replay) -> dict[str, ChannelFloor]:
    """Return channel → noise floor over the horizon of `measured`.

    The free run serves as a log: once with the noise and gaps of the log, once with gaps only. An error without noise
    is due to a state that no output shows.
    """
    log, horizon = drive.log, measured.horizon
    sampled = {n: np.where(np.isfinite(v), free.outputs[n], np.nan) for n, v in log.outputs.items()}
    levels = {name: least_noise_level(values, free.outputs[name]) for name, values in log.outputs.items()}

    def predict(readings: NamedArrays) -> NamedArrays:
        other = copy.copy(drive)
        other.log = replace(log, outputs=readings)
        if horizon != FREE_RUN:
            replayed = self_started(other, free, horizon)
            return {} if replayed is None else replayed.outputs
        if not free.parameters.keys() & readings.keys():  # a start without measurements is unchanged
            return free.outputs
        with suppress(SimulationError):  # noise may move a start value to where the FMU fails
            return as_columns(other.run(0, log.rows - 1, first_start(other, free.parameters)), drive.outputs)
        return free.outputs

    restarted, errors = predict(sampled), []
    for draw in range(count := draws(log, horizon)):
        rng = np.random.default_rng([WINDOWS_SEED, draw])
        noise = {n: np.nan_to_num(s) * rng.standard_normal(log.rows) for n, s in levels.items()}
        noisy = predict({n: values + noise[n] for n, values in sampled.items()})
        errors.append({n: sampled[n] + noise[n] - (noisy[n] - (restarted[n] - free.outputs[n])) for n in sampled})
    totals, starts, result = pool_errors(errors), sorted(measured.starts), {}
    for name, model in sampled.items():
        squares = []
        for error in (e[name] for e in errors):  # the mean squared error of each window
            rows = np.flatnonzero(np.isfinite(error))
            window = np.searchsorted(starts, rows, side="left")
            _, place, counts = np.unique(window, return_inverse=True, return_counts=True)
            squares.append(np.bincount(place, error[rows] ** 2) / counts)
        error = model - restarted[name]
        values, astray = model[np.isfinite(error)], 0.0
        if horizon != FREE_RUN and values.size:
            least = max(NEGLIGIBLE_ERROR_SHARE * float(np.std(values)), ROUNDING_SHARE * float(np.max(np.abs(values))))
            astray = rest if (rest := rmse(error)) > least else 0.0
        result[name] = ChannelFloor(totals[name], _limit(np.concatenate(squares), count), astray)
    return result


def _limit(squares: Array, count: int) -> float:
    """Return the error, relative to the noise floor, that a correct model exceeds with probability BY_CHANCE.

    A sum of squares follows χ² with 2·mean²/variance degrees of freedom per window (Satterthwaite 1946), and the ratio
    follows Fisher's F. `count` is the number of draws.
    """
    from scipy.special import fdtri

    mean, spread = (float(np.mean(squares)), float(np.var(squares))) if squares.size else (0.0, 0.0)
    if not spread > 0.0:
        return AT_LEAST
    freedom = max(1.0, 2.0 * mean**2 / spread) * squares.size / count
    return max(AT_LEAST, math.sqrt(float(fdtri(freedom, freedom * count, 1.0 - BY_CHANCE))))


# -- sentences ------------------------------------------------------------------------------------


def horizon_name(horizon: float | None) -> str:
    """Return the name of a horizon, such as `2 s` or `free run`."""
    return "free run" if horizon in (None, FREE_RUN) else f"{horizon:g}\u00a0s"


def verdict(comparison: Comparison) -> Verdict:
    """Return the verdict: unexplained if any channel is unexplained, else undecided if windows do not measure one."""
    if any(not (c.is_explained or c.lost) for c in comparison.channels):
        return "unexplained"
    return "undecided" if any(c.lost for c in comparison.channels) else "explained"


def worst_first(channels: Sequence[ChannelSummary]) -> list[ChannelSummary]:
    """Return the unexplained channels, then the others, both sorted by error relative to the noise floor."""

    def rank(c: ChannelSummary) -> tuple[bool, bool, bool, float]:
        excess = c.excess if math.isfinite(c.excess) else 0.0 if c.is_matched else math.inf  # above a floor of 0
        return c.is_explained, c.is_matched, c.lost, -excess

    return sorted(channels, key=rank)


def sentence(comparison: Comparison) -> str:
    """Return the verdict as a sentence: worst channel, inputs correlated with its residual, and probable cause."""
    channels = worst_first([c for c in comparison.channels if c.scores[c.measure].rows] or comparison.channels)
    worst, lost, answer = channels[0], [c for c in channels if c.lost], verdict(comparison)
    seconds = plain(float(comparison.log.time[-1] - comparison.log.time[0]))
    over = f"a free run of {seconds}\u00a0s" if worst.measure == FREE_RUN else horizon_name(worst.measure)
    error = f"{size(worst.scores[worst.measure].rmse, worst.unit)} (rms) over {over}"
    error += f", {plain(worst.excess, 2)} times its noise floor" if math.isfinite(worst.excess) else ""
    texts = []
    if answer == "unexplained":
        wrong = {c.name: c for c in channels if not (c.is_explained or c.lost)}
        follows, cause = "follows no input", "The cause may be an effect of the motion, a disturbance or a sensor"
        if pairs := [(c, u) for c in wrong.values() for u in c.inputs[:1] if u.stands_out]:
            channel, by = max(pairs, key=lambda pair: pair[1].strength)
            follows = f"of {channel.name} follows {by.name} (correlation {plain(float(by.rho[by.peak]), 2)})"
            cause = f"The model's response to {by.name} is wrong or incomplete"
            cause += "" if by.ahead else ", or the controller responds to a disturbance"
        delays = [f for f in comparison.findings if f.kind == "delay" and f.channel in wrong]
        if delays := [f for f in delays if abs(f.numbers["delay"]) > comparison.log.step]:
            cause = max(delays, key=lambda f: abs(f.numbers["delay"]) / f.numbers["error"]).whole
        cause = next((f.whole for f in comparison.findings if f.kind == SENSOR_FINDING), cause)
        texts.append(f"{worst.name} is off by {error}; the residual {follows}. {cause}.")
    elif answer == "explained":
        texts.append(f"All channels agree with the log within sensor noise; {worst.name} is off by {error}.")
    if lost:
        free = join_names([f"{size(c.scores[FREE_RUN].rmse, c.unit)} of {c.name}" for c in lost])
        texts.append(
            "Short replays cannot judge this FMU, because no output determines one of its states. Over the whole log, "
            f"the error is {free}."
        )
    return " ".join(texts)
