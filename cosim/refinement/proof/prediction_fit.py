"""Fit of a claim's parameters to predictions over the model's own horizon.

A filter corrects its state at every row, so that its fit weighs the prediction of the next row most. With incomplete
equations, other parameters are best for predictions. The fit to predictions replaces the filter's if it predicts
held-out logs clearly better; its intervals then include the values of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.evidence import fit_without, log_error
from cosim.refinement.decision.trust import CLEARLY
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Hypothesis

EVALUATIONS = 8  # largest number of Jacobians of a fit


def fit_to_predictions(search: Search, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis refitted to predictions; unchanged if these do not improve clearly."""
    problem, horizon = search.problem, search.subject.horizon
    count = len(problem.logs)
    if problem.table or problem.own or count < 2 or not math.isfinite(horizon):
        return h

    def gain(log: int) -> float:
        """Return the decrease of the log error on a held-out log."""
        before = fit_without(search, problem, h, log)
        after = _refit(problem, before, horizon, [k for k in range(count) if k != log])
        return log_error(problem, horizon, [before], [log]) - log_error(problem, horizon, [after], [log])

    gains = in_parallel(gain, list(range(count)))
    if not (np.mean(gains) > CLEARLY and min(gains) > 0.0):
        return h
    fitted = _refit(problem, h.fit, horizon, range(count))
    sigmas = np.array([h.fit.sigma(f.name) for f in h.fit.free])
    moved = np.array([abs(fitted.values[f.name] - h.fit.values[f.name]) for f in h.fit.free])
    wider = 1.0 + np.divide(moved / NORMAL_95, sigmas, out=np.zeros_like(sigmas), where=sigmas > 0.0)
    covariance = np.diag(sigmas**2) if h.fit.scattered is None else h.fit.scattered
    return replace(h, fit=replace(fitted, scattered=covariance * np.outer(wider, wider)))


def _refit(problem: Problem, f: Fit, horizon: float, logs: Sequence[int]) -> Fit:
    """Return the fit with free parameters that minimise the squared errors of predictions, priors included."""
    from scipy.optimize import least_squares

    windows = [_Windows(problem, f, horizon, k) for k in logs]
    errors = np.concatenate([w.errors(f.values).reshape(-1, w.width) for w in windows])
    scale = np.sqrt(np.nansum(errors**2, axis=0) / np.maximum(1, np.isfinite(errors).sum(axis=0)))
    scale = np.where(scale > 0.0, scale, 1.0) * math.sqrt(max(w.length for w in windows))
    priors = [(k, *x.prior) for k, x in enumerate(f.free) if x.prior]

    def residuals(theta: Array) -> Array:
        values = {**f.values, **{x.name: float(v) for x, v in zip(f.free, theta, strict=True)}}
        parts = [np.nan_to_num(w.errors(values) / scale, nan=0.0, posinf=1e6, neginf=-1e6).ravel() for w in windows]
        return np.concatenate([*parts, [(theta[k] - mean) / sigma for k, mean, sigma in priors]])

    start = np.array([f.values[x.name] for x in f.free])
    low, high = np.array([x.low for x in f.free]), np.array([x.high for x in f.free])
    inside = np.clip(start, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    inside = np.where(np.isfinite(inside), inside, start)
    sizes = np.array([x.size for x in f.free])
    done = least_squares(residuals, inside, bounds=(low, high), x_scale=sizes, diff_step=1e-4, max_nfev=EVALUATIONS)
    values = {x.name: float(v) for x, v in zip(f.free, done.x, strict=True)}
    return replace(f, values={**f.values, **values})


class _Windows:
    """Consecutive predictions of a log over the horizon, from the filtered states of a fit."""

    def __init__(self, problem: Problem, f: Fit, horizon: float, index: int) -> None:
        self.problem, self.index = problem, index
        self.data = problem.data(f.values, index)
        rows, first = len(self.data.u), count_unscored(problem.logs[index])
        self.length = max(2, min(round(horizon / self.data.step), (rows - first) // 2))
        self.width = self.data.y.shape[1]
        self.rows = range(first, rows - self.length, self.length)
        run = problem.run(f.values, f.noise, index, states=True)
        self.starts = {k: (problem.drop_unknown_inputs(run.states[k]), run.memory[k]) for k in self.rows}

    def errors(self, values: Mapping[str, float]) -> Array:
        """Return measurement − prediction, shape (windows, rows, outputs)."""
        problem, data = self.problem, self.data
        p = problem.numbers(problem.of_log(values, self.index))
        errors = np.full((len(self.rows), self.length, self.width), np.nan)
        for window, (k, (state, memory)) in zip(errors, self.starts.items(), strict=True):
            end = k + self.length
            predicted = problem.kernel.simulate(data.rows(0, end + 1), p, state, memory, first=k).outputs
            window[:] = data.y[k + 1 : end + 1] - predicted[k + 1 : end + 1]
        return np.where(np.abs(errors) < 1e30, errors, np.nan)
