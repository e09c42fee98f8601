"""Hypotheses that act alike for every input, so that no experiment can separate them.

A settable damping of an FMU and the viscous term of the catalogue at the same velocity are one thing with two names.
Both are simulated along random inputs, at the estimated size and enlarged. The parameters of one hypothesis, and the
base parameters within their tolerances, adapt to the predictions of the other. They act alike if nothing is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from cosim.core.arrays import Array, NamedValues
from cosim.core.errors import FmuError, SimulationError
from cosim.estimation.data import lagged_table
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import WIDTHS
from cosim.refinement.decision.posterior import EQUIVALENT, MIXTURE
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.refinement.search.missing import MOST_ROWS

ENLARGED = max(MIXTURE)  # factor on the ranges of inputs, and least factor on the sizes of effects


def act_alike(search: Search, one: Hypothesis, other: Hypothesis) -> bool:
    """Return True if two hypotheses predict the same for inputs and sizes beyond those of the logs.

    The hypothesis with fewer parameters adapts, because one with more could imitate the other.
    """
    problem = search.problem
    if not problem.late.keys().isdisjoint(one.parameters + other.parameters):
        return False
    truth, adapted = sorted((one, other), key=lambda h: -len(h.parameters))
    free = [f for c in truth.candidates if c.kind != "parameter" for f in c.free if f.neutral is not None]
    distances = ((f, abs(truth.fit.values[f.name] - problem.values[f.name])) for f in free)
    usual = min((f.size / distance for f, distance in distances if distance), default=ENLARGED)
    return all(_is_imitated(search, truth, adapted, times) for times in (1.0, max(ENLARGED, usual)))


def _is_imitated(search: Search, truth: Hypothesis, adapted: Hypothesis, times: float) -> bool:
    """Return True if a hypothesis can adapt to the predictions of another one, both with enlarged effects.

    Base parameters adapt within one tolerance beyond those of the fit.
    """
    problem = search.problem
    given = {**truth.fit.values, **{n: problem.values[n] for n in truth.parameters}}
    sigma = np.exp(0.5 * problem.plain.sensors)
    for both_signs in (True, False):  # an FMU may fail with inputs of a sign that it never gets
        data = _exciting(problem, min(times, ENLARGED), both_signs=both_signs)
        wanted = _outputs(problem, data, given | _enlarged(truth, problem, times))
        without = _outputs(problem, data, given)
        if np.isfinite([wanted, without]).all():
            break
    scale = EQUIVALENT * float(np.linalg.norm((wanted - without) / sigma)) * sigma
    if not (np.isfinite(scale).all() and scale.any()):
        return False
    start, free = given | _enlarged(adapted, problem, times), search.free(adapted.candidates)
    names, begin = [f.name for f in free], np.array([start[f.name] for f in free])
    most = np.array([WIDTHS * f.prior[1] if f.prior else np.inf for f in free])
    low, high = (np.array([getattr(f, limit) for f in free]) for limit in ("low", "high"))
    low, high = np.maximum(low, np.minimum(begin, high) - most), np.minimum(high, np.maximum(begin, low) + most)

    def residuals(theta: Array) -> Array:
        errors = (_outputs(problem, data, start | dict(zip(names, theta.tolist(), strict=True))) - wanted) / scale
        return np.nan_to_num(errors.ravel(), nan=1.0 / EQUIVALENT**2)

    sizes = [f.size for f in free]
    done = least_squares(residuals, np.clip(begin, low, high), bounds=(low, high), x_scale=sizes, ftol=EQUIVALENT)
    return bool(np.linalg.norm(done.fun) < 1.0)


def _enlarged(h: Hypothesis, problem: Problem, times: float) -> dict[str, float]:
    """Return the parameters of the candidates with enlarged effects, within their limits; shapes stay."""
    values = {}
    for c in h.candidates:
        for f in c.free:
            value, given = h.fit.values[f.name], problem.values[f.name]
            if c.kind == "parameter" or f.neutral is not None:
                further = given + times * (value - given)
                keeps_sign = value * given <= 0.0 or further * given > 0.0
                value = further if keeps_sign else given * (value / given) ** times
            values[f.name] = min(max(value, f.low), f.high)
    return values


def _exciting(problem: Problem, times: float, *, both_signs: bool) -> Data:
    """Return a log with levels of random duration over the ranges of the inputs.

    Args:
        times: Factor on the ranges.
        both_signs: Let inputs with one sign have the other one, too, since a threshold at zero shows there only.
    """
    first = problem.logs[0].rows(0, MOST_ROWS)
    rng, rows = np.random.default_rng(0), len(first.u)
    u = np.empty_like(first.u)
    for k in range(u.shape[1]):
        columns = [d.u[:, k] for d in problem.logs]
        low, high = min(c.min() for c in columns), max(c.max() for c in columns)
        middle, half = 0.5 * (low + high), 0.5 * times * (high - low) or 0.5 * abs(high) or 1.0
        if both_signs and abs(middle) > half:
            middle, half = 0.0, abs(middle) + half
        holds = rng.geometric(1.0 / np.sqrt(rows), rows)
        u[:, k] = np.repeat(middle + half * rng.uniform(-1.0, 1.0, rows), holds)[:rows]
    return replace(first, u=u, late=None)


def _outputs(problem: Problem, data: Data, values: NamedValues) -> Array:
    """Return noise-free readings from the start of the first log, shape (rows, outputs); NaN if the FMU fails."""
    lags = problem.in_rows(problem.lagging, values, 0)
    try:
        run = problem.simulate(values, 0, data=data)
    except (FmuError, SimulationError):
        return np.full(data.y.shape, np.nan)
    return lagged_table(run.outputs, np.array([lags.get(k, 0.0) for k in range(data.y.shape[1])]))
