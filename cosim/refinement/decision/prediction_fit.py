"""Fits to predictions over the model's horizon, and the ratio of two hypotheses' errors on held-out logs.

A filter explains a part of the motion by an unknown input. Its estimate from few logs may then be far from the best
predictor of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.fit import Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.posing import halve_log
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import (
    Replays,
    error_decreases,
    fit_without,
    log_error,
    open_loop,
    sum_per_scatter,
)
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Hypothesis

EVALUATIONS = 8  # largest number of Jacobians of a fit


def has_predictions(search: Search) -> bool:
    """Return True for logs with a horizon and one set of values, so that predictions can be fitted."""
    return not why_no_predictions(search.problem, search.subject.horizon)


def why_no_predictions(problem: Problem, horizon: float) -> str:
    """Return the reason for which no predictions can be fitted, as a clause; "" if they can."""
    if not math.isfinite(horizon):
        return "each prediction lasts a whole log"
    return "some parameters have a value for each log" if problem.own else ""


def logs_to_leave_out(problem: Problem) -> Problem:
    """Return the problem with several logs; a single log is halved."""
    return problem if len(problem.logs) > 1 else halve_log(problem)


def predicted_gain(search: Search, better: Hypothesis, worse: Hypothesis) -> float:
    """Return the decrease of squared errors on held-out logs per scatter, by fits to predictions of the other logs."""
    problem, horizon = logs_to_leave_out(search.problem), search.subject.horizon

    def errors(log: int) -> list[Array]:
        return [open_loop(problem, horizon, fit_to_others(search, h, log), log) for h in (worse, better)]

    return sum_per_scatter(error_decreases(in_parallel(errors, list(range(len(problem.logs))))))


def fit_to_others(search: Search, h: Hypothesis, log: int) -> Fit:
    """Return the fit of a hypothesis to predictions of all logs except `log`, from the cache if possible.

    A single log is halved.
    """
    key = (h.names, log)
    if key not in search.prediction_fits:
        problem = logs_to_leave_out(search.problem)
        others = [k for k in range(len(problem.logs)) if k != log]
        by_filter = fit_without(search, problem, h, log)
        search.prediction_fits[key] = fit_to_predictions(problem, by_filter, search.subject.horizon, others)
    return search.prediction_fits[key]


def error_ratios(search: Search, better: Hypothesis, worse: Hypothesis, *, to_predictions: bool) -> tuple[float, ...]:
    """Return the ratio of open-loop errors of two hypotheses on each held-out log, in the mean over the outputs.

    A single log is halved. A log on which both predictions are exact is omitted. If the worse hypothesis predicts a log
    worse than the given model does, the given model takes its place.

    Args:
        to_predictions: Whether the fits to the other logs go on as fits to predictions.
    """
    problem, horizon = logs_to_leave_out(search.problem), search.subject.horizon

    def log_ratio(log: int) -> float:
        both = better, worse
        if to_predictions:
            fits = [fit_to_others(search, h, log) for h in both]
        else:
            fits = [fit_without(search, problem, h, log) for h in both]
        fits.append(replace(fits[1], values={**fits[1].values, **problem.values}))
        after, *before = (log_error(problem, horizon, [f], [log]) for f in fits)
        return after - min(before)

    logarithms = in_parallel(log_ratio, list(range(len(problem.logs))))
    return tuple(math.exp(value) for value in logarithms if math.isfinite(value))


def fit_to_predictions(problem: Problem, f: Fit, horizon: float, logs: Sequence[int]) -> Fit:
    """Return the fit with free parameters that minimise the squared errors of predictions, priors included."""
    from scipy.optimize import least_squares

    replays = [Replays(problem, horizon, f, k) for k in logs]
    errors = np.concatenate([e.reshape(-1, e.shape[-1]) for e in (r.residuals(f.values) for r in replays)])
    scale = np.sqrt(np.nansum(errors**2, axis=0) / np.maximum(1, np.isfinite(errors).sum(axis=0)))
    scale = np.where(scale > 0.0, scale, 1.0) * math.sqrt(max(r.length for r in replays))
    priors = [(k, *x.prior) for k, x in enumerate(f.free) if x.prior]

    def residuals(theta: Array) -> Array:
        values = {**f.values, **{x.name: float(v) for x, v in zip(f.free, theta, strict=True)}}
        parts = [np.nan_to_num(r.residuals(values) / scale, nan=0.0, posinf=1e6, neginf=-1e6).ravel() for r in replays]
        return np.concatenate([*parts, [(theta[k] - mean) / sigma for k, mean, sigma in priors]])

    start = np.array([f.values[x.name] for x in f.free])
    low, high = np.array([x.low for x in f.free]), np.array([x.high for x in f.free])
    inside = np.clip(start, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    inside = np.where(np.isfinite(inside), inside, start)
    sizes = np.array([x.size for x in f.free])
    done = least_squares(residuals, inside, bounds=(low, high), x_scale=sizes, diff_step=1e-4, max_nfev=EVALUATIONS)
    values = {x.name: float(v) for x, v in zip(f.free, done.x, strict=True)}
    return replace(f, values={**f.values, **values})
