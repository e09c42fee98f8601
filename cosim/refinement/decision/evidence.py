"""Evidence for each part of a hypothesis: likelihood and its scatter, held-out logs, open-loop predictions.

A likelihood assumes white residuals; residuals of a real system are correlated. The scatter of a gain and of an
estimate is therefore computed from blocks of time longer than the correlation of an unknown input,

    z = Σ g_b / √(Σ (g_b − ḡ)²)      cov θ̂ = F⁻¹ (Σ s_b s_b') F⁻¹      g_b, s_b: gain and score of block b

(Vuong 1989; White 1982). On a held-out log, parameters keep the values fitted to the other logs. Each hypothesis
predicts in open loop from its own filtered state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.estimation.data import unscored
from cosim.estimation.expected import fit_for_held_out
from cosim.estimation.fit import Fit, fit, inverse, scores
from cosim.estimation.parallel import in_parallel
from cosim.estimation.posing import halve_log
from cosim.estimation.problem import Problem, Scored
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.search.fits import SCREEN_ITERATIONS, Search
from cosim.refinement.search.hypotheses import Hypothesis

BLOCK = 100  # least rows of a block
LASTING = 3.0  # length of a block, as a multiple of the correlation time of an unknown input
FEWEST = 12  # least number of blocks over all logs
DIVERGED = 1e6  # NLL of a measurement for which a filter has diverged
BACK = 200  # rows before a replay that a delay may reach back to
BY_CHANCE = 0.01  # probability below which chance is unlikely
PREDICTED = 8  # least number of replays of a log for a model judged by a free run


def blocks_of(problem: Problem, scored: Scored, memory: float) -> Rows:
    """Return the block index of each scored measurement.

    Blocks are longer than the correlation of the residual.
    """
    data = problem.logs[0]
    lasting = correlated(scored) if problem.trusted else memory / data.step
    rows = max(BLOCK, round(LASTING * lasting))
    total = sum(len(d.u) for d in problem.logs)
    rows = max(1, min(rows, total // FEWEST))
    numbers, first = [], 0
    for part in scored.of_each_log(scored.rows):
        block = first + part // rows
        numbers.append(block)
        first = int(block.max()) + 1 if block.size else first
    return np.concatenate(numbers)


def number_of_blocks(problem: Problem, f: Fit) -> int:
    """Return the number of scored blocks of a fit."""
    return int(np.unique(blocks_of(problem, problem.scored(f.values, f.noise), math.exp(f.noise.memory))).size)


def correlated(scored: Scored) -> float:
    """Return the autocorrelation length of normalised errors [rows]."""
    parts, rows = scored.of_each_log(scored.errors / np.sqrt(scored.variances)), scored.of_each_log(scored.rows)
    longest = 0.0
    for part, at in zip(parts, rows, strict=True):
        series = np.bincount(at, np.nan_to_num(part))
        power = np.abs(np.fft.rfft(series, 2 * len(series))) ** 2
        like = np.fft.irfft(power)[: len(series)]
        none = np.flatnonzero(like <= 0.0)
        longest = max(longest, float(like[: none[0] if none.size else len(like)].sum() / (like[0] or 1.0)))
    return longest


def steadiness(problem: Problem, better: Fit, worse: Fit, costs: float = 0.0) -> float:
    """Return a gain divided by its scatter over blocks.

    Args:
        costs: Additional cost of `worse` relative to `better` (Vuong 1989, eq. 5.9).
    """
    scored = [problem.scored(f.values, f.noise) for f in (better, worse)]
    if scored[0].errors.size != scored[1].errors.size:
        return math.inf
    block = blocks_of(problem, scored[0], math.exp(better.noise.memory))
    return by_block(block, scored[1], scored[0], costs + worse.penalty - better.penalty)


def by_block(block: Rows, worse: Scored, better: Scored, known: float) -> float:
    """Return a gain divided by its scatter over blocks."""
    terms, others = (np.nan_to_num(s.terms, nan=DIVERGED, posinf=DIVERGED) for s in (worse, better))
    gains = np.bincount(block, terms - others).astype(np.float64)
    return in_scatter(gains[np.bincount(block) > 0], known)


def in_scatter(gains: Array, known: float = 0.0) -> float:
    """Return a sum divided by its standard deviation."""
    total, spread = known + float(np.sum(gains)), float(np.std(gains)) * math.sqrt(gains.size)
    return total / spread if spread > 0.0 else math.copysign(math.inf, total) if total else 0.0


def held_out(search: Search, better: Hypothesis, worse: Hypothesis) -> tuple[float, float]:
    """Return the held-out gains in likelihood and open loop.

    Parameters claimed by only one hypothesis keep the values from the other logs, or of the model. For the likelihood,
    the remaining parameters and the noise are refitted on the held-out log for both hypotheses, because a log with
    little excitation leaves these parameters open. Open-loop predictions use nothing of the held-out log. A single log
    is halved.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
    count = len(problem.logs)
    both = set(better.names) & set(worse.names)
    names = {f.name for c in (*better.candidates, *worse.candidates) if c.name not in both for f in c.free}
    shared = tuple(c for c in better.candidates if c.name in both)
    settling = [f for f in search.free(shared) if f.name not in names]

    def one(left_out: int) -> tuple[float, list[Array]]:
        objectives, missed = [], []
        for h in (worse, better):
            learnt = learnt_without(search, problem, h, left_out)
            missed.append(open_loop(problem, search.subject.horizon, learnt.values, learnt, left_out))
            if problem.table:  # A few rows of a table cannot determine parameters.
                objectives.append(problem.scored(learnt.values, learnt.noise, [left_out]).nll)
                continue
            own = {f.name for c in h.candidates for f in c.free}
            stays = {n: learnt.values[n] if n in own else problem.values[n] for n in names}
            values, only = {**h.fit.values, **stays}, [left_out]
            settled = fit(problem, settling, values, h.fit.noise, only, SCREEN_ITERATIONS, sensing=False)
            objectives.append(settled.objective)
        return objectives[0] - objectives[1], missed

    found = in_parallel(one, list(range(count)))
    return sum(gain for gain, _ in found), in_scatter(_nearer([missed for _, missed in found]))


def predicts(problem: Problem, horizon: float, better: Fit, worse: Fit) -> float:
    """Return the open-loop gain per scatter on held-out logs."""
    problem = problem if len(problem.logs) > 1 else halve_log(problem)
    logs = range(len(problem.logs))

    def one(left_out: int) -> list[Array]:
        others = [k for k in logs if k != left_out]
        learnt = [fit(problem, f.free, f.values, f.noise, others, SCREEN_ITERATIONS) for f in (worse, better)]
        known = [fit_for_held_out(problem, f, left_out) for f in learnt]
        return [open_loop(problem, horizon, f.values, f, left_out) for f in known]

    return in_scatter(_nearer(in_parallel(one, list(logs))))


def best_of(scatters: float, tried: int) -> float:
    """Return the required gain per scatter of several candidates.

    The probability that the best of n ineffective candidates passes z is at most n·(1 − Φ(z)) (Bonferroni).
    """
    from scipy.special import ndtr, ndtri

    return float(-ndtri(ndtr(-scatters) / max(1, tried)))


def beyond_chance(problem: Problem, f: Fit, tried: int) -> float:
    """Return the gain per scatter that excludes chance.

    An estimate of t standard deviations gains ½·t², which is ½·|t| times the scatter of the gain. t follows Student's
    distribution over the blocks of time, with Bonferroni's correction for `tried` candidates.
    """
    from scipy.special import stdtrit

    blocks = number_of_blocks(problem, f)
    return 0.5 * float(stdtrit(max(1, blocks - 1), 1.0 - 0.5 * BY_CHANCE / max(1, tried)))


def learnt_without(search: Search, problem: Problem, h: Hypothesis, left_out: int) -> Fit:
    """Return a cached fit to all logs but one."""
    key = (h.names, left_out)
    if key not in search.learnt:
        others = [k for k in range(len(problem.logs)) if k != left_out]
        free = search.free(h.candidates)
        learnt = fit(problem, free, h.fit.values, h.fit.noise, others, SCREEN_ITERATIONS)
        search.learnt[key] = fit_for_held_out(problem, learnt, left_out)
    return search.learnt[key]


def _nearer(found: Sequence[Sequence[Array]]) -> Array:
    """Return the scaled decrease of squared errors per replay."""
    longest = max(missed[0].shape[1] for missed in found)  # Rows of the longest replay: logs may differ in length.
    worse, better = (np.concatenate([_padded(missed[k], longest) for missed in found]) for k in (0, 1))
    both = np.isfinite(worse) & np.isfinite(better)
    counts = np.maximum(1, both.sum(axis=1))
    squares = [np.where(both, e, 0.0) ** 2 for e in (worse, better)]
    size = 0.5 * sum(s.sum(axis=(0, 1)) for s in squares) / np.maximum(1, both.sum(axis=(0, 1)))
    size = np.where(size > 0.0, size, 1.0)
    per_replay = ((squares[0] - squares[1]).sum(axis=1) / counts / size).sum(axis=1)
    return np.asarray(per_replay[both.any(axis=(1, 2))])


def _padded(missed: Array, rows: int) -> Array:
    """Return replays padded with NaN to equal length."""
    return np.pad(missed, ((0, 0), (0, rows - missed.shape[1]), (0, 0)), constant_values=np.nan)


def open_loop(problem: Problem, horizon: float, values: Mapping[str, float], f: Fit, index: int) -> Array:
    """Return the open-loop residual of each replay.

    Each replay starts from the filtered state. Consecutive replays last one horizon of the model, or an eighth of the
    log for a free run.

    Returns:
        Residuals, shape (replays, rows, outputs).
    """
    if problem.table:  # Each row is predicted from its own inputs.
        return problem.innovations(values, f.noise, index)[0][:, None, :]
    data, first = problem.data(values, index), unscored(problem.logs[index])
    rows = len(data.u)
    length = rows // PREDICTED if math.isinf(horizon) else round(horizon / data.step)
    length = max(2, min(length, (rows - first) // 2))
    run = problem.run(values, f.noise, index, states=True)
    p = problem.numbers(problem.of_log(values, index))
    missed = np.full((max(1, (rows - 1 - first) // length), length, data.y.shape[1]), np.nan)
    for replay, row in zip(missed, range(first, rows - length, length), strict=False):
        back = min(row, BACK)
        part, start = data.rows(row - back, row + length + 1), problem.undisturbed(run.states[row])
        predicted = problem.kernel.simulate(part, p, start, run.memory[row], first=back).outputs
        replay[:] = data.y[row + 1 : row + 1 + length] - predicted[back + 1 : back + 1 + length]
    return np.where(np.abs(missed) < 1e30, missed, np.nan)


def as_given(problem: Problem, base: Fit, left_out: int | None = None) -> Fit:
    """Fit the unknown inputs of the given model, and its parameters per log.

    Parameters per log come from all logs, or from all but `left_out`. The noise must be refitted: a filter that trusts
    the given model as much as the recalibrated model would not follow the measurements.
    """
    given = fit(problem, (), problem.values, base.noise, None, SCREEN_ITERATIONS, sensing=False)
    if not problem.own:
        return given
    others = [k for k in range(len(problem.logs)) if k != left_out]
    known = {**problem.values, **{f.name: base.values[f.name] for f in problem.own}}
    learnt = fit(problem, problem.own, known, given.noise, others, SCREEN_ITERATIONS, sensing=False)
    return learnt if left_out is None else fit_for_held_out(problem, learnt, left_out)


def scatter(problem: Problem, f: Fit) -> float:
    """Return the ratio of scattered to white estimate variances."""
    spread, white = scattered(problem, f).scattered, inverse(f.information)
    assert spread is not None
    ratios = [spread[k, k] / white[k, k] for k in range(len(f.free)) if white[k, k] > 0.0]
    return max(1.0, float(np.median(ratios))) if ratios else 1.0


def _of_few(covariance: Array, rows: int, free: int) -> Array:
    """Widen a covariance for few rows.

    With few rows, residuals underestimate the noise and normal intervals are too narrow (Student).
    """
    from scipy.special import stdtrit

    left = max(1, rows - free)
    return np.asarray(covariance * (float(stdtrit(left, 0.975)) / NORMAL_95) ** 2 * rows / left)


def scattered(problem: Problem, f: Fit) -> Fit:
    """Return the fit with White's sandwich covariance."""
    each, information = scores(problem, f)
    scored = problem.scored(f.values, f.noise)
    block = blocks_of(problem, scored, math.exp(f.noise.memory))
    sums = np.stack([np.bincount(block, row) for row in each])
    inside = inverse(information)
    covariance = inside @ (sums @ sums.T) @ inside
    count = len(f.free)
    if problem.table:
        covariance = _of_few(covariance, problem.samples, sum(x.prior is None for x in f.free))
    return replace(f, scattered=np.asarray(covariance[:count, :count]))
