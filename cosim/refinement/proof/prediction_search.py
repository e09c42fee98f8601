"""Search for the model that predicts best over the horizon, if the fits of the filter support no claim.

The filter corrects its state at every row, and an estimated unknown input imitates slow effects. Several small effects
then gain less than they cost, although predictions over the model's own horizon need them. This search adds candidates
one by one (forward stepwise). All parameters and the power of the unknown inputs are fitted to overlapping predictions;
the power decides how far the filter's start depends on the equations. Some predictions cross an event that no model
explains. Cauchy's loss c²·ln(1 + z²/c²) of the size z of a prediction's error limits their weight.

Each part of the logs is left out in turn. The fit without the part is one Gauss–Newton step from the fit to all parts.
Sealed logs are not used, and the search changes no claim.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.linear_algebra import least_squares, orthonormal
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import DIFFERENCE, NOISE_DIFFERENCE, Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import SHARE
from cosim.refinement.decision.claims import Claims, Nearest, Rung
from cosim.refinement.decision.evidence import Replays, rows_of_replay
from cosim.refinement.decision.trust import CLEARLY
from cosim.refinement.proof.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.proof.nearest import SIMPLER, is_as_good, nearest
from cosim.refinement.proof.prediction_fit import EVALUATIONS
from cosim.refinement.proof.refined_models import refined_subject, variant_of
from cosim.refinement.proof.replay_check import errors_per_floor, moved_beyond_tolerance
from cosim.refinement.search.attribution import HOPE
from cosim.refinement.search.fits import Search, key_of
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.refinement.study import Study
from cosim.subject.candidates import Candidate, Free

OVERLAP = 2  # predictions that cover each row
PARTS = 6  # least number of parts of the logs, each left out once
LEAST_PARTS = 3  # number of parts below which there is no standard error
CAUCHY = 2.385  # constant of Cauchy's loss, in units of the median error
DIVERGED = 1e6  # error, in units of the median error, of a prediction that diverges
TRIED = 3  # most promising candidates fitted in each round
QUICK = 3  # largest number of Jacobians of a fit that only ranks
AIC = 2.0  # least decrease of −2·ln L per parameter of an added candidate
ROUNDS = 6  # largest number of added candidates
IDLE = 2  # candidates added without a better prediction of left-out parts, after which the search ends
TOLERANCE = 1e-3  # relative change of a fit's objective or step at which the fit ends


@dataclass(frozen=True, eq=False)
class Windows:
    """Overlapping predictions of the logs, none of which extends over two parts.

    Attributes:
        rows: For each log, the first row of each prediction.
        parts: Part of each prediction.
        groups: Log of each part; of a single log, its half.
    """

    problem: Problem
    horizon: float
    rows: tuple[tuple[int, ...], ...]
    parts: Rows
    groups: Rows

    @classmethod
    def of(cls, problem: Problem, horizon: float) -> Windows:
        """Return the predictions of all logs."""
        count = len(problem.logs)
        rows: list[tuple[int, ...]] = []
        parts: list[int] = []
        groups: list[int] = []
        for index, log in enumerate(problem.logs):
            first, end, length = count_unscored(log), len(log.u) - 1, rows_of_replay(problem, horizon, index)
            number = max(1, min(-(-PARTS // count), (end - first) // (2 * length)))
            edges = np.linspace(first, end, number + 1).astype(int).tolist()
            starts = [range(a, b - length + 1, max(1, length // OVERLAP)) for a, b in pairwise(edges)]
            rows.append(tuple(row for part in starts for row in part))
            for k, part in enumerate(starts):
                parts += [len(groups)] * len(part)
                groups.append(index if count > 1 else 2 * k // number)
        return cls(problem, horizon, tuple(rows), np.array(parts, np.intp), np.array(groups, np.intp))

    def errors(self, f: Fit) -> Array:
        """Return measurement − prediction, infinite if the model diverges, shape (predictions, rows, outputs)."""
        replays = [Replays(self.problem, self.horizon, f, k, rows) for k, rows in enumerate(self.rows)]
        longest = max(r.length for r in replays)
        parts = []
        for r in replays:
            e = r.residuals(f.values)
            measured = np.stack([np.isfinite(r.data.y[row + 1 : row + 1 + r.length]) for row in r.rows])
            e = np.where(measured & ~np.isfinite(e), np.inf, e)
            parts.append(np.pad(e, ((0, 0), (0, longest - r.length), (0, 0)), constant_values=np.nan))
        return np.concatenate(parts)

    def log_errors(self, errors: Array, part: int) -> float:
        """Return the logarithm of the root mean square error of a part, mean over the outputs."""
        e = errors[self.parts == part].reshape(-1, errors.shape[-1])
        squares, counts = np.nansum(e**2, axis=0), np.isfinite(e).sum(axis=0)
        seen = (counts > 0) & (squares > 0.0)
        return float(np.mean(0.5 * np.log(squares[seen] / counts[seen]))) if seen.any() else np.inf

    def by_log(self, errors: Sequence[float]) -> Array:
        """Return the mean over the parts of each log."""
        return np.array([np.mean(np.array(errors)[self.groups == k]) for k in np.unique(self.groups)])


def median_errors(errors: Array) -> Array:
    """Return the median root mean square error of a prediction, for each output."""
    counts = np.isfinite(errors).sum(axis=1)
    squares = np.where(np.isfinite(errors), errors, 0.0) ** 2
    sizes = np.sqrt(squares.sum(axis=1) / np.maximum(1, counts))
    medians = [np.median(column[n > 0]) if (n > 0).any() else 0.0 for column, n in zip(sizes.T, counts.T, strict=True)]
    return np.where(np.array(medians) > 0.0, medians, 1.0)


def limited(errors: Array, scale: Array) -> Array:
    """Return errors in units of `scale`, scaled down so that a prediction's sum of squares is Cauchy's loss."""
    z = np.clip(np.nan_to_num(errors / scale, nan=0.0, posinf=DIVERGED, neginf=-DIVERGED), -DIVERGED, DIVERGED)
    counts = np.maximum(1, np.isfinite(errors).sum(axis=(1, 2)))
    size = np.maximum(np.sum(z**2, axis=(1, 2)) / counts, 1e-12)
    loss = CAUCHY**2 * np.log1p(size / CAUCHY**2)
    return np.asarray(z * np.sqrt(loss / size / counts / OVERLAP)[:, None, None])


@dataclass(frozen=True, eq=False)
class Prediction:
    """A set of candidates with parameters that predict best.

    Attributes:
        fit: Values and noise; `free` are the free parameters.
        places: Indices of the free values in the noise vector.
        scale: Unit of each output's error.
    """

    windows: Windows
    candidates: tuple[Candidate, ...]
    fit: Fit
    places: Rows
    scale: Array

    @property
    def priors(self) -> list[tuple[int, float, float]]:
        """Return place, mean and standard deviation of each prior."""
        return [(k, *x.prior) for k, x in enumerate(self.fit.free) if x.prior]

    @property
    def theta(self) -> Array:
        """Return the free values."""
        return np.array([*(self.fit.values[x.name] for x in self.fit.free), *self.fit.noise.vector[self.places]])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Return the limits of the free values."""
        limits, free = self.windows.problem.limits, self.fit.free
        low = np.array([*(x.low for x in free), *limits.low[self.places]])
        return low, np.array([*(x.high for x in free), *limits.high[self.places]])

    @property
    def sizes(self) -> Array:
        """Return the usual change of each free value."""
        return np.array([*(x.size for x in self.fit.free), *np.ones(len(self.places))])

    def at(self, theta: Array) -> Fit:
        """Return the fit with other free values."""
        vector, count = self.fit.noise.vector, len(self.fit.free)
        vector[self.places] = theta[count:]
        values = {x.name: float(v) for x, v in zip(self.fit.free, theta[:count], strict=True)}
        return replace(self.fit, values={**self.fit.values, **values}, noise=self.fit.noise.like(vector))

    def weigh(self, errors: Array, theta: Array) -> Array:
        """Return weighted errors and priors in one vector."""
        priors = [(theta[k] - mean) / sigma for k, mean, sigma in self.priors]
        return np.concatenate([limited(errors, self.scale).ravel(), priors])

    def evaluate(self, theta: Array) -> Array:
        """Return weighted errors and priors at other free values."""
        return self.weigh(self.windows.errors(self.at(theta)), theta)

    @cached_property
    def residuals(self) -> Array:
        """Return weighted errors of predictions, followed by the priors."""
        return self.evaluate(self.theta)

    @cached_property
    def jacobian(self) -> Array:
        """Return the derivatives of `residuals` by free parameters and noise."""
        return self.derivatives(self.theta)

    @property
    def objective(self) -> float:
        """Return the minimised sum."""
        return float(self.residuals @ self.residuals)

    def required(self, count: int) -> float:
        """Return the objective below which so many further parameters are worth their cost.

        For n independent errors of estimated size, −2·ln L is n·ln(objective). Errors within a prediction depend on
        each other, so that n is the number of consecutive predictions and outputs.
        """
        number = len(self.windows.parts) / OVERLAP * len(self.scale)
        return self.objective * math.exp(-max(AIC * count / number, 2.0 * SIMPLER))

    def derivatives(self, theta: Array) -> Array:
        """Return derivatives of the weighted errors by differences, inwards at an upper limit."""
        around, high = self.evaluate(theta), self.bounds[1]
        shares = [DIFFERENCE] * len(self.fit.free) + [NOISE_DIFFERENCE] * len(self.places)

        def column(k: int) -> Array:
            h = shares[k] * self.sizes[k]
            h = h if theta[k] + h <= high[k] else -h
            moved = theta.copy()
            moved[k] += h
            return np.asarray((self.evaluate(moved) - around) / h)

        return np.stack(in_parallel(column, range(len(theta))), axis=1)

    def fitted(self, evaluations: int = EVALUATIONS) -> Prediction:
        """Return the prediction with free values that minimise the objective, at least as good as these."""
        from scipy.optimize import least_squares as minimise

        low, high = self.bounds
        margin = np.where(np.isfinite(high - low), 1e-9 * (high - low), 0.0)
        start = np.clip(self.theta, low + margin, high - margin)
        done = minimise(
            self.evaluate,
            start,
            jac=self.derivatives,
            bounds=(low, high),
            x_scale=self.sizes,
            max_nfev=evaluations,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
        )
        other = replace(self, fit=self.at(done.x))
        other.__dict__.update(residuals=done.fun, jacobian=done.jac)
        return other

    def rescaled(self) -> Prediction:
        """Return the prediction with its own median errors as units."""
        return replace(self, scale=median_errors(self.windows.errors(self.fit)))

    def held_out_errors(self) -> Array:
        """Return the log error of each log, in predictions of parts that are left out of the fit."""
        windows, low_high = self.windows, self.bounds
        count = (len(self.residuals) - len(self.priors)) // len(windows.parts)
        parts = np.concatenate([np.repeat(windows.parts, count), np.full(len(self.priors), -1)])

        def error(part: int) -> float:
            rest = parts != part
            step = least_squares(self.jacobian[rest] * self.sizes, -self.residuals[rest], rcond=1e-8) * self.sizes
            return windows.log_errors(windows.errors(self.at(np.clip(self.theta + step, *low_high))), part)

        return windows.by_log(in_parallel(error, range(len(windows.groups))))


# -- search ------------------------------------------------------------------------------------


def search_nearest(
    study: Study, claims: Claims, a: Attribution, problem: Problem, search: Search, candidates: Sequence[Candidate]
) -> Claims:
    """Return the claims with the nearest model of this search, if nothing is claimed and it predicts clearly better.

    The model must predict held-out parts of each log better than the nearest model so far predicts the logs that its
    fit includes.

    Args:
        problem: Problem for replays of the logs.
        search: Search of the filter, with its problem.
    """
    windows = (
        Windows.of(search.problem, study.subject.horizon) if _is_applicable(study, claims, search.problem) else None
    )
    if windows is None or len(windows.groups) < LEAST_PARTS or not _is_far_from_noise(study, claims, a, problem):
        return claims
    rungs = ladder_by_predictions(search, windows, a, candidates)
    h = nearest(rungs) if rungs else None
    if h is None or not set(h.names) - set(claims.nearest.names if claims.nearest else ()):
        return claims
    before = windows.errors(_nearest_fit(claims, a))
    gains = windows.by_log([windows.log_errors(before, k) for k in range(len(windows.groups))])
    gains -= next(rung.errors for rung in rungs if rung.hypothesis is h)
    if not (np.mean(gains) > CLEARLY and np.min(gains) > 0.0):
        return claims
    return replace(claims, ladder=tuple(rungs), nearest=Nearest(h, moved_beyond_tolerance(h.fit)))


def _is_applicable(study: Study, claims: Claims, problem: Problem) -> bool:
    """Return True if nothing is claimed or excluded, and all logs have a horizon and one set of values."""
    has_predictions = math.isfinite(study.subject.horizon) and not (problem.table or problem.own)
    return has_predictions and claims.name == "unexplained" and claims.claimed is None


def _nearest_fit(claims: Claims, a: Attribution) -> Fit:
    """Return the fit of the nearest model so far."""
    return claims.nearest_hypothesis.fit if claims.nearest_hypothesis else a.unfitted


def _is_far_from_noise(study: Study, claims: Claims, a: Attribution, problem: Problem) -> bool:
    """Return True if replays of the nearest model miss an output by far more than sensor noise explains.

    The floor contains no unknown input, because that may be the missing effect.
    """
    subject = refined_subject(study.subject, study.settings, claims.nearest_hypothesis)
    variant = variant_of(subject, study.settings, _nearest_fit(claims, a))
    noise = replace(variant.noise, power=problem.noise.smallest)
    random = np.random.default_rng(FLOOR_SEED)
    floor = noise_floor(replace(variant, noise=noise), problem, study.logs, random).level
    return bool(errors_per_floor(predicted_errors(variant, problem, study.logs), floor))


def ladder_by_predictions(
    search: Search, windows: Windows, a: Attribution, candidates: Sequence[Candidate]
) -> list[Rung]:
    """Return the errors of predictions of held-out parts, from the given model to more and more candidates.

    Without a candidate that decreases the objective, there is no ladder.
    """
    effects = [c for c in candidates if c.kind != "parameter"]  # base parameters are free in every fit
    scale = median_errors(windows.errors(a.base.fit))
    path = [_prediction(search, windows, a.base.fit, (), scale).fitted()]
    errors = [path[0].held_out_errors()]
    while len(path) <= ROUNDS and len(path) - 1 - int(np.argmin([np.mean(e) for e in errors])) < IDLE:
        larger = _extended(search, path[-1], effects)
        if larger is None:
            break
        path.append(larger)
        errors.append(larger.held_out_errors())
    if len(path) == 1:
        return []
    given = _prediction(search, windows, a.unfitted, (), scale, fixed=True).fitted()
    rungs = [Rung(None, given.held_out_errors())]
    rungs += [Rung(_hypothesis(search, p), e) for p, e in zip(path, errors, strict=True)]
    return _without_idle_parts(search, path, rungs)


def _prediction(
    search: Search, windows: Windows, at: Fit, parts: Sequence[Candidate], scale: Array, *, fixed: bool = False
) -> Prediction:
    """Return the candidates with start values of their fit.

    Args:
        fixed: Fit the unknown inputs alone.
    """
    problem, free = search.problem, () if fixed else tuple(search.free(tuple(parts)))
    kept = {x.name: at.values[x.name] for x in free if x.name in at.values}
    places = problem.limits.free[problem.limits.free < len(at.noise.power)]
    return Prediction(windows, tuple(parts), replace(at, free=free, values={**problem.values, **kept}), places, scale)


def _hypothesis(search: Search, p: Prediction) -> Hypothesis:
    """Return a prediction as a hypothesis, with the likelihood and the information of its fit."""
    information = p.jacobian.T @ p.jacobian
    by_log = search.problem.score(p.fit.values, p.fit.noise).by_log
    fit = replace(p.fit, information=information, nll_by_log=by_log, penalty=0.0, scattered=None)
    return Hypothesis(p.candidates, fit, fit.objective + search.cost(p.candidates))


def _extended(search: Search, p: Prediction, candidates: Sequence[Candidate]) -> Prediction | None:
    """Return the prediction with the candidate that decreases the objective most; None if the decrease is too small."""
    tried = []
    for c, values in _promises(p, [c for c in candidates if c not in p.candidates])[:TRIED]:
        start = replace(p.fit, values={**p.fit.values, **values})
        larger = _prediction(search, p.windows, start, (*p.candidates, c), p.scale).fitted(QUICK)
        if larger.objective < p.required(len(c.free)):
            tried.append(larger)
    return min(tried, key=lambda larger: larger.objective).rescaled().fitted() if tried else None


def _promises(p: Prediction, candidates: Sequence[Candidate]) -> list[tuple[Candidate, Mapping[str, float]]]:
    """Return candidates with linear estimates of their parameters, most promising first.

    Candidates that promise too little, or whose estimates exceed their limits, are omitted.
    """
    values, theta, basis = p.fit.values, p.theta, orthonormal(p.jacobian * p.sizes)
    trials = [(c, move) for c in candidates for move in _moves(c, values)]

    def effect(trial: tuple[Candidate, Mapping[str, float]]) -> Array:
        moved = replace(p.fit, values={**values, **{n: values[n] + step for n, step in trial[1].items()}})
        row = p.weigh(p.windows.errors(moved), theta) - p.residuals
        return row - basis @ (basis.T @ row)

    rows = in_parallel(effect, trials)
    promises = []
    for c in candidates:
        own = [(move, row) for (other, move), row in zip(trials, rows, strict=True) if other is c]
        matrix = np.stack([row for _, row in own], axis=1)
        multiples = least_squares(matrix, -p.residuals, rcond=1e-6)
        gain = 2.0 * float(-p.residuals @ matrix @ multiples) - float(np.sum((matrix @ multiples) ** 2))
        estimates = {n: values[n] for n in c.parameters}
        for times, (move, _) in zip(multiples.tolist(), own, strict=True):
            estimates |= {n: estimates[n] + times * step for n, step in move.items()}
        if p.objective - HOPE * gain < p.required(len(c.free)) and all(_is_within(f, estimates) for f in c.free):
            promises.append((gain, c, estimates))
    return [(c, estimates) for _, c, estimates in sorted(promises, key=lambda entry: -entry[0])]


def _is_within(f: Free, estimates: Mapping[str, float]) -> bool:
    """Return True if an estimate respects its limits."""
    return max(f.low, estimates.get(f.above, f.low)) <= estimates[f.name] <= f.high


def _moves(c: Candidate, values: Mapping[str, float]) -> list[dict[str, float]]:
    """Return steps of a candidate's parameters towards its starts, jointly and one by one, or of their usual size."""
    moves = []
    for start in c.starts:
        steps = {n: SHARE * (v - values[n]) for n, v in start.items() if v != values[n]}
        moves += [steps] if steps else []
        moves += [{n: step} for n, step in steps.items()] if len(steps) > 1 else []
    moved = {n for move in moves for n in move}
    for f in c.free:
        if f.name not in moved:
            step = SHARE * f.size
            moves.append({f.name: step if values[f.name] + step <= f.high else -step})
    return moves


def _without_idle_parts(search: Search, path: Sequence[Prediction], rungs: list[Rung]) -> list[Rung]:
    """Return the rungs with smaller sets: the nearest model without candidates that do not help on every log."""
    by_names = {key_of(p.candidates): p for p in path}
    h = nearest(rungs)
    while h is not None and len(h.names) > 1:
        p, own = by_names[h.names], next(rung.errors for rung in rungs if rung.hypothesis is h)
        smaller: list[tuple[Prediction, Rung]] = []
        for c in p.candidates:
            rest = tuple(other for other in p.candidates if other is not c)
            if key_of(rest) in by_names:
                continue
            without = _prediction(search, p.windows, p.fit, rest, p.scale).fitted().rescaled().fitted()
            smaller.append((without, Rung(_hypothesis(search, without), without.held_out_errors())))
        as_good = [entry for entry in smaller if is_as_good(entry[1].errors - own)]
        if not as_good:
            break
        without, rung = min(as_good, key=lambda entry: float(np.mean(entry[1].errors)))
        rungs.append(rung)
        assert rung.hypothesis is not None
        h = rung.hypothesis
        by_names[h.names] = without
    return sorted(rungs, key=lambda rung: len(rung.hypothesis.names) if rung.hypothesis else -1)
