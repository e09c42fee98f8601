"""Scatter of gains and estimates over blocks of time and over logs, and predictions of logs left out.

A likelihood assumes white residuals; residuals of a real system are correlated. The scatter of a gain and of an
estimate is therefore computed from blocks of time longer than the correlation of an unknown input,

    z = Σ g_b / √(Σ (g_b − ḡ)²)      cov θ̂ = F⁻¹ (Σ s_b s_b') F⁻¹      g_b, s_b: gain and score of block b

(Vuong 1989; White 1982), for a part of a hypothesis as in `gain_per_chance`. On a held-out log, what the other logs say
of a parameter is its prior. Each hypothesis predicts in open loop from its own filtered state.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit, fit, inverse, slopes, with_flat_directions
from cosim.estimation.kernel.kernel import Begin, simulate_all
from cosim.estimation.parallel import in_parallel, raise_if_cancelled
from cosim.estimation.past_readings import lagged_table
from cosim.estimation.per_log import fit_for_held_out
from cosim.estimation.posing import halve_log
from cosim.estimation.problem import Problem, Scored
from cosim.estimation.subject.candidates import Free
from cosim.refinement.search.fits import SCREEN_ITERATIONS, Search
from cosim.refinement.search.hypotheses import Hypothesis

BLOCK = 100  # least rows of a block
LASTING = 3.0  # length of a block, as a multiple of the correlation time of an unknown input
FEWEST = 12  # least number of blocks over all logs
DIVERGED = 1e6  # NLL of a measurement for which a filter has diverged
BACK = 200  # rows before a replay that a delay may reach back to
PREDICTED = 8  # least number of replays of a log for a model judged by a free run


def blocks_of(problem: Problem, scored: Scored, memory: float) -> Rows:
    """Return the time block of each scored measurement; blocks are longer than the correlation of the residual."""
    length = correlation_length(scored) if problem.trusted else memory / problem.logs[0].step
    rows = max(BLOCK, round(LASTING * length))
    total = sum(len(d.u) for d in problem.logs)
    rows = max(1, min(rows, total // FEWEST))
    numbers, first = [], 0
    for part in scored.of_each_log(scored.rows):
        block = first + part // rows
        numbers.append(block)
        first = int(block.max()) + 1 if block.size else first
    return np.concatenate(numbers)


def correlation_length(scored: Scored) -> float:
    """Return the autocorrelation length of normalised errors [rows]."""
    parts, rows = scored.of_each_log(scored.errors / np.sqrt(scored.variances)), scored.of_each_log(scored.rows)
    longest = 0.0
    for part, at in zip(parts, rows, strict=True):
        series = np.bincount(at, np.nan_to_num(part))
        power = np.abs(np.fft.rfft(series, 2 * len(series))) ** 2
        correlation = np.fft.irfft(power)[: len(series)]
        end = np.append(np.flatnonzero(correlation <= 0.0), len(correlation))[0]
        longest = max(longest, float(correlation[:end].sum() / (correlation[0] or 1.0)))
    return longest


def steadiness(problem: Problem, better: Fit, worse: Fit) -> float:
    """Return the likelihood gain of a fit over a fit that it contains, divided by the scatter of the gain by chance."""
    scored, others = (problem.score(f.values, f.noise) for f in (better, worse))
    if scored.errors.size != others.errors.size:
        return math.inf
    block = blocks_of(problem, scored, math.exp(better.noise.memory))
    return gain_per_chance(block, others, scored, worse.penalty - better.penalty) if block.size else math.inf


def gain_per_chance(block: Rows, worse: Scored, better: Scored, constant: float = 0.0) -> float:
    """Return a likelihood gain divided by its scatter about the gain that the better fit expects.

    Excitation is given: an effect that acts in few blocks gains there only, and that is no chance. Chance is the
    difference of the gain g_b of a block from the Kullback-Leibler divergence k_b of both predictions,

        z = Σ g_b / √(Σ ((g_b − k_b)/(1 − h_b))²)      h_b = k_b/Σ k_b

    The factor 1/(1 − h_b) is that of the jackknife over blocks; a gain in a single block would have no scatter without
    it (CV3 of MacKinnon, Nielsen and Webb 2023, J. Appl. Econometrics 38:671).
    """
    gains = _terms(worse) - _terms(better)
    expected = _divergences(block, better, worse)
    share = expected / (np.sum(expected) or 1.0)
    chance = (sum_by_block(block, gains) - expected) / np.maximum(1.0 - share, np.finfo(float).eps)
    return _ratio(constant + float(np.sum(gains)), math.sqrt(float(np.sum(chance**2))))


def _divergences(block: Rows, true: Scored, other: Scored) -> Array:
    """Return the Kullback-Leibler divergence of other predictions from true ones, by block."""
    moved, ratio = other.errors - true.errors, true.variances / other.variances
    with np.errstate(over="ignore", invalid="ignore"):
        divergence = 0.5 * (ratio - 1.0 - np.log(ratio) + moved**2 / other.variances)
    return sum_by_block(block, np.nan_to_num(divergence, nan=0.0, posinf=0.0))


def _terms(scored: Scored) -> Array:
    """Return the NLL of each measurement, finite for a diverged filter too."""
    return np.nan_to_num(scored.terms, nan=DIVERGED, posinf=DIVERGED)


def sum_by_block(block: Rows, numbers: Array) -> Array:
    """Return the sums over the blocks that contain a measurement."""
    return np.bincount(block, numbers).astype(np.float64)[np.bincount(block) > 0]


def gain_per_scatter(block: Rows, worse: Scored, better: Scored, constant: float) -> float:
    """Return a likelihood gain per scatter over time blocks, for hypotheses of which none contains the other."""
    gains = sum_by_block(block, _terms(worse) - _terms(better))
    return _ratio(constant + float(np.sum(gains)), float(np.std(gains)) * math.sqrt(gains.size))


def _ratio(total: float, spread: float) -> float:
    return total / spread if spread > 0.0 else math.copysign(math.inf, total) if total else 0.0


def log_error(problem: Problem, horizon: float, fits: Iterable[Fit], logs: Iterable[int] | None = None) -> float:
    """Return the logarithm of the open-loop RMSE, mean over the outputs, with a fit for each log, by default all."""
    logs = range(len(problem.logs)) if logs is None else logs
    errors = [Replays(problem, horizon, f, k).residuals(f.values) for f, k in zip(fits, logs, strict=False)]
    rows = np.concatenate([e.reshape(-1, e.shape[-1]) for e in errors])
    sums, counts = np.nansum(rows**2, axis=0), np.isfinite(rows).sum(axis=0)
    seen = (counts > 0) & (sums > 0.0)  # not an output without readings in these logs
    return float(np.mean(0.5 * np.log(sums[seen] / counts[seen]))) if seen.any() else math.inf


def fit_without(search: Search, problem: Problem, h: Hypothesis, log: int) -> Fit:
    """Return the fit of a hypothesis to all logs except `log`, from the cache if possible."""
    key = (h.names, log)
    if key not in search.cross_fits:
        others = [k for k in range(len(problem.logs)) if k != log]
        refit = fit(problem, search.free(h.candidates), h.fit.values, h.fit.noise, others, SCREEN_ITERATIONS)
        search.cross_fits[key] = fit_for_held_out(problem, refit, log)
    return search.cross_fits[key]


class Replays:
    """Consecutive open-loop predictions of a log, each from the state that a fit's filter estimates.

    Each lasts one horizon of the model, or an eighth of the log for a free run.
    """

    def __init__(self, problem: Problem, horizon: float, f: Fit, index: int, rows: Sequence[int] | None = None) -> None:
        """Filter the log.

        Args:
            rows: Rows at which the predictions start; None for one after the other.
        """
        self.problem, self.index = problem, index
        self.data, first = problem.data(f.values, index), count_unscored(problem.logs[index])
        every = len(self.data.u)
        length = every // PREDICTED if math.isinf(horizon) else round(horizon / self.data.step)
        self.length = max(2, min(length, (every - first) // 2))
        self.rows = range(first, every - self.length, self.length) if rows is None else rows
        run = problem.run(f.values, f.noise, index, states=True)
        self.starts = [(problem.begin_replay(run, k), run.memory[k]) for k in self.rows]

    def residuals(self, values: Mapping[str, float]) -> Array:
        """Return measurement − prediction with these parameters, NaN beyond 1e30, shape (replays, rows, outputs)."""
        raise_if_cancelled()
        problem, data = self.problem, self.data
        p = problem.numbers(problem.of_log(values, self.index))
        residuals = np.full((len(self.rows), self.length, data.y.shape[1]), np.nan)
        if problem.layout.is_free_run and len(self.rows):  # a library begins at the start of a log only
            begin, memory = self.starts[0][0], np.zeros(problem.layout.memory)
            whole = data.y - lagged_table(problem.kernel.simulate(data, p, begin, memory).outputs, data.lags)
            residuals[:] = [whole[row + 1 : row + 1 + self.length] for row in self.rows]
            return np.where(np.abs(residuals) < 1e30, residuals, np.nan)
        begins: list[Begin] = []
        for row, (state, memory) in zip(self.rows, self.starts, strict=True):
            back = min(row, BACK)
            begins.append((data.rows(row - back, row + self.length + 1), p, state, memory, None, back))
        runs = simulate_all(problem.kernel, begins)
        for replay, row, of_row, run in zip(residuals, self.rows, begins, runs, strict=True):
            back, end, predicted = of_row[-1], row + self.length + 1, run.outputs
            replay[:] = data.y[row + 1 : end] - lagged_table(predicted[back:], data.lags, data.y[row])[1:]
        return np.where(np.abs(residuals) < 1e30, residuals, np.nan)


def noise_gains(problem: Problem, f: Fit) -> list[float]:
    """Return the log-likelihood gain of each unknown input."""
    smallest = problem.noise.smallest
    without = np.where(np.eye(len(smallest), dtype=bool), smallest, f.noise.power)
    return [problem.score(f.values, replace(f.noise, power=power)).nll - f.nll for power in without]


def unknown_input_gain(problem: Problem) -> float:
    """Return the log-likelihood gain from which an equation has an unknown input, ½ ln N (half of BIC)."""
    return 0.5 * math.log(max(2, problem.samples))


def fit_given_model(problem: Problem, base: Fit, left_out: int | None = None) -> Fit:
    """Fit the unknown inputs of the given model, and its parameters per log.

    Parameters per log come from all logs, or from all but `left_out`. The noise must be refitted: a filter that trusts
    the given model as much as the recalibrated model would not follow the measurements.
    """
    fixed = fit(problem, (), problem.values, base.noise, None, SCREEN_ITERATIONS, sensing=False)
    if not problem.own:
        return fixed
    others = [k for k in range(len(problem.logs)) if k != left_out]
    values = {**problem.values, **{f.name: base.values[f.name] for f in problem.own}}
    refit = fit(problem, problem.own, values, fixed.noise, others, SCREEN_ITERATIONS, sensing=False)
    return refit if left_out is None else fit_for_held_out(problem, refit, left_out)


def scatter_ratio(problem: Problem, f: Fit) -> float:
    """Return the ratio of the estimates' variance from time blocks to the variance for a white residual, at least 1."""
    spread, white = with_sandwich_covariance(problem, f).scattered, inverse(f.information)
    assert spread is not None
    ratios = [spread[k, k] / white[k, k] for k in range(len(f.free)) if white[k, k] > 0.0]
    return max(1.0, float(np.median(ratios))) if ratios else 1.0


def with_intervals(search: Search, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis with the covariance of its estimates: scatter over blocks of time, and from log to log.

    An estimate without one log should differ from the estimate of all by N(0, σ₋ₖ² − σ²) (Hausman 1978). The variance
    grows by the ratio of these squared differences to their expectation, if above 1 (Birge 1932). For logs that say
    equally much this is the jackknife; a log that says nothing of a parameter does not widen its interval. A single log
    is halved.
    """
    f = with_flat_directions(search.problem, with_sandwich_covariance(search.problem, h.fit))
    if f.scattered is None:
        return replace(h, fit=f)
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
    logs = range(len(problem.logs))
    white, fits = replace(f, scattered=None), in_parallel(partial(fit_without, search, problem, h), logs)
    variances = np.array([_variance_with_logs(white, fits, x) for x in f.free])
    within = np.diag(f.scattered)
    wider = np.sqrt(np.maximum(1.0, np.divide(variances, within, out=np.ones_like(within), where=within > 0.0)))
    return replace(h, fit=replace(f, scattered=f.scattered * np.outer(wider, wider)))


def _variance_with_logs(f: Fit, fits: Sequence[Fit], x: Free) -> float:
    """Return the variance of an estimate from its differences to the estimates without each log.

    If the information of n logs adds up, the expectation is least for equal logs, σ²·n/(n − 1). An expectation below
    that is a matter of the noise that each fit estimates for itself; the variance is at most that of the jackknife.
    """
    if x.group:  # A fit without its log says nothing of a parameter per log.
        return 0.0
    variance, n = f.sigma(x.name) ** 2, len(fits)
    expected = max(variance * n / (n - 1), sum(max(0.0, other.sigma(x.name) ** 2 - variance) for other in fits))
    moved = sum((other.values[x.name] - f.values[x.name]) ** 2 for other in fits)
    return variance * moved / expected if expected > 0.0 else 0.0


def with_sandwich_covariance(problem: Problem, f: Fit) -> Fit:
    """Return the fit with White's sandwich covariance."""
    at_fit = slopes(problem, f)
    block = blocks_of(problem, at_fit.scored, math.exp(f.noise.memory))
    sums = np.stack([np.bincount(block, row) for row in at_fit.gradients])
    inside = inverse(at_fit.information)
    covariance = inside @ (sums @ sums.T) @ inside
    count = len(f.free)
    return replace(f, scattered=np.asarray(covariance[:count, :count]))
