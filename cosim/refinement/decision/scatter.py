"""Scatter of gains and estimates over blocks of time and over logs, and predictions of logs left out.

A likelihood assumes white residuals; residuals of a real system are correlated. The scatter of a gain and of an
estimate is therefore computed from the same blocks of time as the dispersion of the likelihood,

    cov θ̂ = F⁻¹ (Σ s_b s_b') F⁻¹      s_b: score of block b

(White 1982), that of a gain as in `gain_per_chance`. On a held-out log, what the other logs say of a parameter is its
prior. Each hypothesis predicts in open loop from its own filtered state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.estimation.data import count_unscored, lagged_table
from cosim.estimation.fit import Fit, fit, inverse, slopes, with_flat_directions
from cosim.estimation.kernel.kernel import Begin, simulate_all
from cosim.estimation.parallel import in_parallel, raise_if_cancelled
from cosim.estimation.per_log import fit_for_held_out
from cosim.estimation.posing import halve_log
from cosim.estimation.problem import Problem, Scored
from cosim.refinement.proof.measure import PARTS
from cosim.refinement.search.fits import SCREEN_ITERATIONS, Hypothesis, Search
from cosim.refinement.search.missing import rows_of_delay

BLOCKS = 20  # blocks of time of a study


def blocks_of_time(rows: Sequence[Rows]) -> tuple[Rows, Rows]:
    """Return the block of each measurement, and the log of each block; blocks last about equally long.

    Args:
        rows: Row of each measurement, log by log.
    """
    lengths = [int(np.ptp(r)) + 1 if r.size else 0 for r in rows]
    numbers, logs = [], list[int]()
    for log, (r, length) in enumerate(zip(rows, lengths, strict=True)):
        parts = max(1, round(BLOCKS * length / sum(lengths)))
        numbers.append(len(logs) + (r - r[:1]) * parts // max(1, length))
        logs += [log] * parts
    return np.concatenate(numbers), np.array(logs)


def steadiness(problem: Problem, better: Fit, worse: Fit, other: Problem | None = None) -> float:
    """Return the likelihood gain of a fit over another one, divided by the scatter of the gain by chance.

    Args:
        other: Problem of the better fit, if it has other inputs.
    """
    scored = (other or problem).score(better.values, better.noise)
    before = problem.score(worse.values, worse.noise)
    if scored.errors.size != before.errors.size:
        return math.inf
    block, _ = blocks_of_time(scored.of_each_log(scored.rows))
    return gain_per_chance(block, before, scored, worse.penalty - better.penalty)


def gain_per_chance(block: Rows, worse: Scored, better: Scored, constant: float = 0.0) -> float:
    """Return a likelihood gain divided by its scatter about the gain that the better fit expects.

    Excitation is given: an effect that acts in few blocks gains there only, and that is no chance. Chance is the
    difference of the gain g_b of a block from the Kullback-Leibler divergence k_b of both predictions,

        z = Σ g_b / √(Σ ((g_b − k_b)/(1 − h_b))²)      h_b = k_b/Σ k_b

    The factor 1/(1 − h_b) is that of the jackknife over blocks; a gain in a single block would have no scatter without
    it (CV3 of MacKinnon, Nielsen and Webb 2023, J. Appl. Econometrics 38:671).
    """
    gain = constant + worse.nll - better.nll
    if not math.isfinite(gain):  # a filter diverged
        return math.inf if math.isfinite(better.nll) else -math.inf
    moved, ratio = worse.errors - better.errors, better.variances / worse.variances
    divergences = 0.5 * (ratio - 1.0 - np.log(ratio) + moved**2 / worse.variances)
    expected = np.bincount(block, divergences)
    share = expected / (np.sum(expected) or 1.0)
    chance = (np.bincount(block, worse.terms - better.terms) - expected) / np.maximum(1.0 - share, np.finfo(float).eps)
    spread = float(np.linalg.norm(chance))
    return gain / spread if spread else math.copysign(math.inf, gain) if gain else 0.0


def fit_without(search: Search, problem: Problem, h: Hypothesis, log: int) -> Fit:
    """Return the fit of a hypothesis to all logs except `log`, from the cache if possible."""
    key = (h.key, log)
    if key not in search.cross_fits:
        others = [k for k in range(len(problem.logs)) if k != log]
        refit = fit(problem, search.free(h.candidates), h.fit.values, h.fit.noise, others, SCREEN_ITERATIONS)
        search.cross_fits[key] = fit_for_held_out(problem, refit, log)
    return search.cross_fits[key]


def held_out_errors(search: Search, h: Hypothesis | None, given: Fit) -> Array:
    """Return ln of the open-loop RMSE of each log, mean over the outputs, by fits to the other logs.

    A single log is halved.

    Args:
        h: The hypothesis; None for the given model.
        given: Fit of the base model, for the parameters per log of the given one.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
    found = []
    for k in range(len(problem.logs)):
        f = fit_without(search, problem, h, k) if h else fit_given_model(problem, given, k)
        errors = replay_errors(problem, search.subject.horizon, f, k)
        with np.errstate(over="ignore"):
            sums, counts = np.nansum(errors**2, axis=(0, 1)), (~np.isnan(errors)).sum(axis=(0, 1))
        seen = (counts > 0) & (sums > 0.0)  # not an output without readings in this log
        found.append(float(np.mean(0.5 * np.log(sums[seen] / counts[seen]))) if seen.any() else math.inf)
    return np.array(found)


def replay_errors(problem: Problem, horizon: float, f: Fit, index: int) -> Array:
    """Return measurement − open-loop prediction of a log, shape (replays, rows, outputs).

    NaN stands for a missing measurement, infinity for a prediction that diverges.

    Consecutive replays last one horizon of the model, at most half of the log, or a part of the log for a model judged
    by a free run, from the states that the filter estimates. A library begins at the start of a log only; its one free
    run is cut into as many.
    """
    raise_if_cancelled()
    data, first = problem.data(f.values, index), count_unscored(problem.logs[index])
    every = len(data.u)
    length = every // PARTS if math.isinf(horizon) else round(horizon / data.step)
    length = max(2, min(length, (every - first) // 2))
    run, p = problem.run(f.values, f.noise, index), problem.parameters(f.values, index)
    rows = range(first, every - length, length)
    if problem.layout.is_free_run:
        begin = problem.begin_replay(run, first)
        predicted = lagged_table(problem.simulate(f.values, index, begin, data).outputs, data.lags)
        replays = [(data.y[row + 1 : row + 1 + length], predicted[row + 1 : row + 1 + length]) for row in rows]
    else:
        back = rows_of_delay(problem, p, data.step)
        begins: list[Begin] = []
        for row in rows:
            part, before = data.rows(max(0, row - back), row + length + 1), min(row, back)
            begins.append((part, p, problem.begin_replay(run, row), run.memory[row], None, before))
        replays = []
        for row, begin_at, replay in zip(rows, begins, simulate_all(problem.kernel, begins), strict=True):
            predicted = lagged_table(replay.outputs[begin_at[-1] :], data.lags, data.y[row])[1:]
            replays.append((data.y[row + 1 : row + 1 + length], predicted))
    found = [np.where(np.isfinite(model) | np.isnan(y), y - model, np.inf) for y, model in replays]
    return np.array(found).reshape(len(rows), length, data.y.shape[1])


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
    others = [k for k in range(len(problem.logs)) if k != left_out]
    fixed = fit(problem, (), problem.values, base.noise, others, SCREEN_ITERATIONS, sensing=False)
    if not problem.own:
        return fixed
    values = {**problem.values, **{f.name: base.values[f.name] for f in problem.own}}
    refit = fit(problem, problem.own, values, fixed.noise, others, SCREEN_ITERATIONS, sensing=False)
    return refit if left_out is None else fit_for_held_out(problem, refit, left_out)


def with_intervals(search: Search, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis with the covariance of its estimates: scatter over blocks of time, and from log to log.

    An estimate without one log should differ from the estimate of all by N(0, σ₋ₖ² − σ²) (Hausman 1978). The variance
    grows by the ratio of these squared differences to their expectation, if above 1 (Birge 1932). For logs that say
    equally much this is the jackknife; a log that says nothing of a parameter does not widen its interval. A single log
    is halved.
    """
    at_fit = slopes(search.problem, h.fit)
    block, _ = blocks_of_time(at_fit.scored.of_each_log(at_fit.scored.rows))
    sums = np.stack([np.bincount(block, row) for row in at_fit.gradients])
    inside, count = inverse(at_fit.information), len(h.fit.free)
    covariance = (inside @ (sums @ sums.T) @ inside)[:count, :count]
    f = with_flat_directions(search.problem, h.fit, covariance)
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
    logs = range(len(problem.logs))
    white, fits = replace(f, scattered=None), in_parallel(partial(fit_without, search, problem, h), logs)
    variances = np.array([0.0 if x.group else _variance_with_logs(white, fits, x.name) for x in f.free])
    scattered = np.asarray(f.scattered)
    within = np.diag(scattered)
    wider = np.sqrt(np.maximum(1.0, np.divide(variances, within, out=np.ones_like(within), where=within > 0.0)))
    return replace(h, fit=replace(f, scattered=scattered * np.outer(wider, wider)))


def _variance_with_logs(f: Fit, fits: Sequence[Fit], name: str) -> float:
    """Return the variance of an estimate from its differences to the estimates without each log.

    If the information of n logs adds up, the expectation is least for equal logs, σ²·n/(n − 1). An expectation below
    that is a matter of the noise that each fit estimates for itself; the variance is at most that of the jackknife.
    """
    variance, n = f.sigma(name) ** 2, len(fits)
    expected = max(variance * n / (n - 1), sum(max(0.0, other.sigma(name) ** 2 - variance) for other in fits))
    moved = sum((other.values[name] - f.values[name]) ** 2 for other in fits)
    return variance * moved / expected if expected > 0.0 else 0.0
