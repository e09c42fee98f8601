"""What a verdict depends on: evidence, equivalences and lack of fit of the fitted hypotheses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy import optimize
from scipy.special import expit, logit, logsumexp, ndtr

from cosim.core.arrays import Array, NamedValues, Rows
from cosim.core.errors import FmuError, SimulationError
from cosim.core.linear_algebra import least_squares
from cosim.core.text import join_names, plain
from cosim.credibility.bands import FREE_RUN_PARTS
from cosim.estimation.data import count_unscored, lagged_table
from cosim.estimation.fit import Fit, fit, fit_for_held_out, inverse, slopes, with_flat_directions
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.parallel import in_parallel, raise_if_cancelled
from cosim.estimation.posing import halve_log
from cosim.estimation.problem import Problem, Scored
from cosim.estimation.subject.candidates import (
    SIGMAS_PER_TOLERANCE,
    Candidate,
    Free,
    kind_within,
    spread_of_base,
    values_of_special_case,
)
from cosim.refinement.decision.posterior import (
    CERTAIN,
    EQUIVALENT,
    MISFIT,
    MIXTURE,
    POSSIBLE,
    TRIAL_TOLERANCE,
    Bundle,
    Evidence,
    Misfit,
    Parameter,
    chance_of_gain,
    folded,
    log_prior,
    posterior,
)
from cosim.refinement.search.fits import SCREEN_ITERATIONS, Hypothesis, Search
from cosim.refinement.search.unnamed import MAX_SMOOTHED_ROWS, Leftover
from cosim.residuals.residual_statistics import remaining_excess
from cosim.terms.catalogue import contains

COMPARED = 5  # classes of which equivalences are sought


def evidence(search: Search, h: Hypothesis) -> Evidence:
    """Return the evidence of a fitted hypothesis, from the cache if possible.

    Noise levels are integrated out (Schur complement). A level at a limit, beyond which the likelihood would increase,
    is fixed.
    """
    known = search.evidences.get(h.key)
    if known is not None and known[0] is h:
        return known[1]
    problem, count = search.problem, len(h.fit.free)
    at = slopes(problem, h.fit)
    gradients, s = at.gradients, at.scored.variances
    ends = np.cumsum(at.scored.counts)[:-1]
    by_log = zip(*(np.split(rows, ends, axis=1) for rows in (at.errors / np.sqrt(s), at.log_variances)), strict=True)
    informations = np.array([e @ e.T + 0.5 * v @ v.T for e, v in by_log])
    free, total = problem.limits.free, gradients.sum(axis=1)[count:]
    noise, low, high = (values[free] for values in (h.fit.noise.vector, problem.limits.low, problem.limits.high))
    pinned = ((noise <= low) & (total > 0.0)) | ((noise >= high) & (total < 0.0))
    nuisance, own = count + np.flatnonzero(~pinned), np.arange(count)
    F = informations.sum(axis=0)
    across = least_squares(F[np.ix_(nuisance, nuisance)], F[np.ix_(nuisance, own)])
    project = np.zeros((len(F), count))
    project[own, own], project[nuisance] = 1.0, -across
    block, logs = blocks_of_time(at.scored.of_each_log(at.scored.rows))
    moved = gradients[own] - across.T @ gradients[nuisance]
    found = Evidence(
        parts=h.key,
        parameters=tuple(prior_of(search, h, f) for f in h.fit.free),
        log_likelihoods=-np.bincount(block, at.scored.terms, len(logs)).astype(np.float64),
        gradients=np.stack([np.bincount(block, row, len(logs)) for row in moved], axis=1)
        if count
        else np.zeros((len(logs), 0)),
        informations=project.T @ informations @ project,  # makes the matrix of each log positive semidefinite
        logs=logs,
    )
    search.evidences[h.key] = h, found
    return found


def prior_of(search: Search, h: Hypothesis, f: Free) -> Parameter:
    """Return a free parameter of a fit, with its prior, for the posterior."""
    subject, problem, given = search.subject, search.problem, float(search.problem.values[f.name])
    of = next((c for c in h.candidates if f.name in c.parameters), None)
    part, is_size = of.name if of else "", f.neutral is not None
    if f.prior:
        part, is_size, (centre, width) = "", False, f.prior
    elif of and f.name in of.repeats[:1]:  # every period is equally probable: the normal prior has the same density
        centre, width, is_size = of.starts[0].get(f.name, given), of.among * math.sqrt(2.0 * math.pi) * f.size, False
    elif f.name in {p.name for p in subject.parameters}:
        p, stated = subject.declared[f.name], problem.settings.tolerance
        tolerance = stated.get(f.name, TRIAL_TOLERANCE if p.tolerance is None else p.tolerance)
        width = SIGMAS_PER_TOLERANCE * spread_of_base(p, given, tolerance) / MIXTURE[0]
        centre, is_size = given, True
    else:
        centre, width = f.neutral if f.neutral is not None and part not in subject.present else given, f.size
    low = max(f.low, h.fit.values.get(f.above, f.low))
    return Parameter(f.name, part, float(h.fit.values[f.name]), centre, width, is_size, low, f.high)


def sizes_of(search: Search, h: Hypothesis, c: Candidate) -> list[Parameter]:
    """Return the parameters of a part (candidate in a hypothesis) with their priors."""
    return [p for p in (prior_of(search, h, f) for f in c.free) if p.is_size]


def families(candidates: Sequence[Candidate]) -> dict[str, str]:
    """Return candidate → candidate that is its special case; for terms of an FMU, at the same place."""
    found = {}
    for rich in candidates:
        for simple in candidates:
            same = dict.fromkeys(simple.parameters, 1.0)
            is_own = not simple.name.rpartition("_at_")[1] and rich is not simple
            if contains(rich.name, simple.name) or (is_own and values_of_special_case(rich, simple, same)):
                found[rich.name] = simple.name
    return found


def optima(search: Search) -> list[Hypothesis]:
    """Return the hypotheses that were fitted to the end and to an optimum.

    A fit that is worse than the fit of a subset of its parts has stopped far from its optimum, where the evidence is
    meaningless.

    Raises:
        SimulationError: No fit has a finite likelihood.
    """
    ended = [h for h in search.tried.values() if h.ended]

    def bound(h: Hypothesis) -> float:
        return min((o.fit.objective for o in ended if o.key < h.key), default=math.inf)

    found = [h for h in ended if h.fit.objective < bound(h) + 1.0]
    if not found:
        reason = "its simulations along the logs fail or diverge for every fitted model"
        raise SimulationError(search.subject.title, 0.0, f"{reason}; narrow the bounds of its parameters")
    return found


def bundle_of(search: Search) -> Bundle:
    """Return the bundle for the hypotheses of a search, without lack of fit.

    Among the probable hypotheses, those with equal predictions for every input are listed as equivalent.
    """
    evidences = [evidence(search, h) for h in optima(search)]
    sets, _ = posterior(evidences, len(search.candidates))
    probable = [parts for parts, p in folded(sets, ()).items() if p > POSSIBLE][:COMPARED]
    apart = [(one, other) for one, other in combinations(probable, 2) if not (one <= other or other <= one)]
    return Bundle(
        hypotheses=evidences,
        kinds={c.name: kind_within(c, search.subject) for c in search.candidates},
        equivalent=[pair for pair in apart if act_alike(search, *(search.tried[parts] for parts in pair))],
        families=families(search.candidates),
        hidden=frozenset(search.hidden),
    )


def beside_unnamed_terms(search: Search, h: Hypothesis, together: Fit, kappa: float, count: int) -> dict[str, float]:
    """Return part → probability of the part when unmodelled dynamics are fitted too.

    Let a be the estimated sizes of the part, relative to no effect, V their covariance and N(0, T) their prior. The
    Bayes factor is N(a; 0, V + T)/N(a; 0, V), the ratio of the densities of prior and posterior at no effect (Dickey
    1971, Annals of Mathematical Statistics 42:204).

    Args:
        together: Fit of the hypothesis together with the unmodelled dynamics.
        count: Number of candidates.
    """
    covariance, names = kappa * inverse(together.information), [f.name for f in together.free]
    odds = log_prior(len(h.candidates), count) - log_prior(len(h.candidates) - 1, count)
    found = {}
    for c in h.candidates:
        sizes = sizes_of(search, h, c)
        places = [names.index(p.name) for p in sizes]
        away = np.array([together.values[p.name] - p.centre for p in sizes])
        block, widths = covariance[np.ix_(places, places)], np.array([p.width for p in sizes])
        with_it = [_log_density(away, block + np.diag((times * widths) ** 2)) for times in MIXTURE]
        factor = float(logsumexp(with_it)) - math.log(len(MIXTURE)) - _log_density(away, block)
        found[c.name] = float(expit(factor + odds))
    return found


def _log_density(x: Array, covariance: Array) -> float:
    """Return the logarithm of the normal density N(x; 0, covariance), without the constant."""
    return -0.5 * float(x @ inverse(covariance) @ x) - 0.5 * float(np.linalg.slogdet(covariance)[1])


def chance_of(problem: Problem, leftover: Leftover, alone: Fit) -> float:
    """Return the probability that unmodelled dynamics improve a fit by chance as much as they do.

    The probability is that of the χ² test for the best of all tried terms (Bonferroni) or, if larger, that of the gain
    relative to its scatter over blocks of time.

    Args:
        problem: Problem with unmodelled dynamics in the kernel.
        alone: Fit without these terms.
    """
    if leftover.fit is None:
        return 1.0
    of_gain = leftover.among * chance_of_gain(leftover.gain, sum(len(u.names) for u in leftover.terms))
    return min(1.0, max(of_gain, float(ndtr(-steadiness(problem, leftover.fit, alone)))))


def drifts(problem: Problem, f: Fit) -> dict[str, tuple[float, float]]:
    """Return parameter → (change from first to last row of each log, probability of the gain by chance).

    A parameter changes as P(t) = h₁·t + h₂·(3t² − 1)/2, t from −1 to 1 over each log (Nyblom 1989, J. Am. Stat. Assoc.
    84:223, tests for changes of any kind). To first order, the innovations change by P·∂e; the other parameters and the
    noise are re-optimised. The probability is as in `chance_of`.
    """
    at = slopes(problem, f)
    scored, gradients, covariance = at.scored, at.gradients, inverse(at.information)
    rows = scored.of_each_log(scored.rows)
    block, _ = blocks_of_time(rows)
    t = np.concatenate([2.0 * (r - r[0]) / max(1, np.ptp(r)) - 1.0 for r in rows if r.size])
    shapes, weights, found = np.stack([t, 1.5 * t**2 - 0.5]), 1.0 / scored.variances, {}
    for p, error, log_variance, gradient in zip(f.free, at.errors, at.log_variances, gradients, strict=False):
        de, dv = shapes * error, shapes * log_variance
        across = at.errors @ (weights * de).T + 0.5 * at.log_variances @ dv.T
        others = -covariance @ across
        information = (weights * de) @ de.T + 0.5 * dv @ dv.T + across.T @ others
        sizes = -inverse(information) @ (shapes @ gradient)
        errors = scored.errors + sizes @ (de + others.T @ at.errors)
        variances = scored.variances * np.exp(sizes @ (dv + others.T @ at.log_variances))
        changing = replace(scored, errors=errors, variances=variances)
        of_priors = float(sizes @ others.T @ gradients.sum(axis=1))  # their gradient at an optimum is minus that of −ℓ
        gain = scored.nll - changing.nll + of_priors
        of_gain = len(f.free) * chance_of_gain(gain, len(shapes))
        steady = float(ndtr(-gain_per_chance(block, scored, changing, of_priors)))
        found[p.name] = 2.0 * float(sizes[0]), min(1.0, max(of_gain, steady))
    return found


def misfit_of(
    by_chance: float,
    moves: NamedValues,
    errors: Mapping[str, NamedValues],
    floor: NamedValues,
    beside: NamedValues,
) -> Misfit:
    """Return the lack of fit of a hypothesis.

    Args:
        by_chance: Probability by chance of the gain of unmodelled dynamics, or of a parameter that changes.
        moves: Forced state → size of its unknown input relative to its derivative.
        errors: `before` and `after`: channel → error of replays with the given model, and with the hypothesis.
        floor: Channel → noise floor of the hypothesis.
        beside: Part → probability when unmodelled dynamics are fitted too.
    """
    before, after = errors["before"], errors["after"]
    known = {n: f for n, f in floor.items() if f > 0.0 and n in after and math.isfinite(before.get(n, math.nan))}
    shares = {n: remaining_excess(before[n], after[n], f) for n, f in known.items() if not math.isnan(after[n])}
    return Misfit(
        probability=by_chance,
        beside=beside,
        unknown_share=max(moves.values(), default=0.0),
        remaining={n: max(0.0, share) for n, share in shares.items() if not math.isnan(share)},
        over_floor={n: after[n] / f for n, f in known.items() if not math.isnan(after[n])},
    )


# Scatter of gains and estimates over blocks of time and over logs, and predictions of held-out logs.
#
# A likelihood assumes white residuals; residuals of a real system are correlated. The scatter of a gain and of an
# estimate is therefore computed from the same blocks of time as the dispersion of the likelihood,
#
#     cov θ̂ = F⁻¹ (Σ s_b s_b') F⁻¹      s_b: score of block b
#
# (White 1982), that of a gain as in `gain_per_chance`. For a held-out log, the estimate of a parameter from the other
# logs is the prior. Each hypothesis predicts in open loop from its own filtered state.
#


TIME_BLOCKS = 20  # blocks of time of a study


def blocks_of_time(rows: Sequence[Rows]) -> tuple[Rows, Rows]:
    """Return the block of each measurement, and the log of each block; blocks have about equal duration.

    Args:
        rows: Row of each measurement, log by log.
    """
    lengths = [int(np.ptp(r)) + 1 if r.size else 0 for r in rows]
    numbers, logs = [], list[int]()
    for log, (r, length) in enumerate(zip(rows, lengths, strict=True)):
        parts = max(1, round(TIME_BLOCKS * length / sum(lengths)))
        numbers.append(len(logs) + (r - r[:1]) * parts // max(1, length))
        logs += [log] * parts
    return np.concatenate(numbers), np.array(logs)


def steadiness(problem: Problem, better: Fit, worse: Fit, other: Problem | None = None) -> float:
    """Return z: the likelihood gain of one fit over another, divided by the scatter of the gain by chance.

    Args:
        other: Problem of the better fit, if it differs in inputs.
    """
    scored = (other or problem).score(better.values, better.noise)
    before = problem.score(worse.values, worse.noise)
    if scored.errors.size != before.errors.size:
        return math.inf
    block, _ = blocks_of_time(scored.of_each_log(scored.rows))
    return gain_per_chance(block, before, scored, worse.penalty - better.penalty)


def gain_per_chance(block: Rows, worse: Scored, better: Scored, constant: float = 0.0) -> float:
    """Return z: a likelihood gain divided by its scatter about the gain that the better fit predicts.

    The excitation is taken as given: that an effect acts in few blocks only is not chance. Chance is the difference
    between the gain g_b of a block and the Kullback-Leibler divergence k_b of both predictions:

        z = Σ g_b / √(Σ ((g_b − k_b)/(1 − h_b))²)      h_b = k_b/Σ k_b

    The factor 1/(1 − h_b) comes from the jackknife over blocks; without it, a gain in a single block would have no
    scatter (CV3 of MacKinnon, Nielsen and Webb 2023, J. Appl. Econometrics 38:671).
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


def fits_without_each_log(search: Search, h: Hypothesis) -> list[Fit]:
    """Return the fit of a hypothesis without each log in turn; with a single log, the fit to it."""
    logs = range(len(search.problem.logs))
    return [h.fit] if len(logs) == 1 else [fit_without(search, search.problem, h, k) for k in logs]


def held_out_errors(search: Search, h: Hypothesis | None, given: Fit) -> Array:
    """Return, for each held-out log, the logarithm of the open-loop RMSE (mean over outputs) by a fit to the others.

    A single log is divided into two halves.

    Args:
        h: The hypothesis; None for the given model.
        given: Fit of the base model, which has the parameters per log for the given model.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
    found = []
    for k in range(len(problem.logs)):
        f = fit_without(search, problem, h, k) if h else fit_given_model(problem, given, k)
        errors = replay_errors(problem, search.subject.horizon, f, k)
        with np.errstate(over="ignore"):
            sums, counts = np.nansum(errors**2, axis=(0, 1)), (~np.isnan(errors)).sum(axis=(0, 1))
        seen = (counts > 0) & (sums > 0.0)  # ignores outputs without readings in this log
        found.append(float(np.mean(0.5 * np.log(sums[seen] / counts[seen]))) if seen.any() else math.inf)
    return np.array(found)


def replay_errors(problem: Problem, horizon: float, f: Fit, index: int) -> Array:
    """Return measurement − open-loop prediction of a log, shape (replays, rows, outputs).

    NaN marks a missing measurement, infinity a diverging prediction.

    Consecutive replays start from filtered states and last one horizon of the model, at most half of the log. For a
    model whose horizon is a free run, they last a part of the log. A co-simulation FMU starts only at the beginning of
    a log; its free run is divided into these parts.
    """
    raise_if_cancelled()
    data, first = problem.data(f.values, index), count_unscored(problem.logs[index])
    every = len(data.u)
    length = every // FREE_RUN_PARTS if math.isinf(horizon) else round(horizon / data.step)
    length = max(2, min(length, (every - first) // 2))
    run = problem.run(f.values, f.noise, index)
    rows = range(first, every - length, length)
    if problem.layout.is_free_run:
        begin = problem.begin_replay(run, first)
        predicted = lagged_table(problem.simulate(f.values, index, begin, data).outputs, data.lags)
        replays = [(data.y[row + 1 : row + 1 + length], predicted[row + 1 : row + 1 + length]) for row in rows]
    else:
        points = rows, [problem.begin_replay(run, row) for row in rows], run.memory[rows]
        replays = []
        for row, replay in zip(rows, problem.simulate_from(f.values, index, points, length), strict=True):
            predicted = lagged_table(replay.outputs, data.lags, data.y[row])[1:]
            replays.append((data.y[row + 1 : row + 1 + length], predicted))
    found = [np.where(np.isfinite(model) | np.isnan(y), y - model, np.inf) for y, model in replays]
    return np.array(found).reshape(len(rows), length, data.y.shape[1])


def noise_gains(problem: Problem, f: Fit) -> list[float]:
    """Return the log-likelihood gain due to each unknown input."""
    smallest = problem.noise.smallest
    without = np.where(np.eye(len(smallest), dtype=bool), smallest, f.noise.power)
    return [problem.score(f.values, replace(f.noise, power=power)).nll - f.nll for power in without]


def fit_given_model(problem: Problem, base: Fit, left_out: int | None = None) -> Fit:
    """Return a fit of the given model: only unknown inputs, and parameters with a value per log, are fitted.

    The other parameters keep their values. The noise of `base`, whose parameters were adjusted, would be too small: the
    filter would not follow the measurements.

    Args:
        left_out: Log that the fit does not use.
    """
    others = [k for k in range(len(problem.logs)) if k != left_out]
    fixed = fit(problem, (), problem.values, base.noise, others, SCREEN_ITERATIONS, sensing=False)
    if not problem.own:
        return fixed
    values = {**problem.values, **{f.name: base.values[f.name] for f in problem.own}}
    refit = fit(problem, problem.own, values, fixed.noise, others, SCREEN_ITERATIONS, sensing=False)
    return refit if left_out is None else fit_for_held_out(problem, refit, left_out)


def with_intervals(search: Search, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis with the covariance of its estimates, from scatter over blocks of time and over logs.

    An estimate without one log should differ from the estimate with all logs by N(0, σ₋ₖ² − σ²) (Hausman 1978). The
    variance is multiplied by the ratio of these squared differences to their expectation, if above 1 (Birge 1932). For
    n logs whose information adds up, the expected sum is at least σ²·n/(n − 1); it can be smaller because each fit
    estimates its own noise. For equally informative logs this is the jackknife; a log without information on a
    parameter does not widen its interval. A single log is divided into two halves.
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
    scattered, wider, n = np.asarray(f.scattered), np.ones(count), len(fits)
    for k, x in enumerate(f.free):
        if x.group:
            continue
        variance, within = white.sigma(x.name) ** 2, scattered[k, k]
        expected = max(variance * n / (n - 1), sum(max(0.0, each.sigma(x.name) ** 2 - variance) for each in fits))
        moved = sum((each.values[x.name] - f.values[x.name]) ** 2 for each in fits)
        if expected > 0.0 and within > 0.0:
            wider[k] = np.sqrt(max(1.0, variance * moved / expected / within))
    return replace(h, fit=replace(f, scattered=scattered * np.outer(wider, wider)))


# Observationally equivalent hypotheses, which have equal predictions for every input, so that no experiment can
# separate them.
#
# For example, a settable damping of an FMU and the viscous term of the catalogue at the same velocity are the same.
# Both are simulated with random inputs, at the estimated and at larger sizes. The parameters of one hypothesis, and the
# base parameters within their tolerances, are fitted to the predictions of the other. The hypotheses are equivalent if
# no difference remains.


ENLARGED = max(MIXTURE)  # factor on the ranges of inputs, and smallest factor on the sizes of effects


def act_alike(search: Search, one: Hypothesis, other: Hypothesis) -> bool:
    """Return True if two hypotheses have equal predictions, also for inputs and sizes beyond those of the logs.

    The hypothesis with fewer parameters is fitted, because one with more parameters could imitate the other.
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
    """Return True if a hypothesis can be fitted to the predictions of another one, both with enlarged effects.

    Base parameters vary within one tolerance around their fitted values.
    """
    problem = search.problem
    given = {**truth.fit.values, **{n: problem.values[n] for n in truth.parameters}}
    sigma = np.exp(0.5 * problem.plain.sensors)
    for both_signs in (True, False):  # an FMU may fail with inputs of a sign that does not occur in the logs
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
    most = np.array([SIGMAS_PER_TOLERANCE * f.prior[1] if f.prior else np.inf for f in free])
    low, high = (np.array([getattr(f, limit) for f in free]) for limit in ("low", "high"))
    low, high = np.maximum(low, np.minimum(begin, high) - most), np.minimum(high, np.maximum(begin, low) + most)

    def residuals(theta: Array) -> Array:
        errors = (_outputs(problem, data, start | dict(zip(names, theta.tolist(), strict=True))) - wanted) / scale
        return np.nan_to_num(errors.ravel(), nan=1.0 / EQUIVALENT**2)

    sizes = [f.size for f in free]
    done = optimize.least_squares(
        residuals, np.clip(begin, low, high), bounds=(low, high), x_scale=sizes, ftol=EQUIVALENT
    )
    return bool(np.linalg.norm(done.fun) < 1.0)


def _enlarged(h: Hypothesis, problem: Problem, times: float) -> dict[str, float]:
    """Return the candidates' parameters with enlarged sizes, within their limits; other parameters are unchanged."""
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
    """Return a log whose inputs have random levels, of random duration, within their ranges.

    Args:
        times: Factor on the ranges.
        both_signs: Let inputs change sign even if they do not in the logs, since only this shows a threshold at zero.
    """
    first = problem.logs[0].rows(0, MAX_SMOOTHED_ROWS)
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
    """Return simulated readings without noise from the start of the first log (rows, outputs); NaN if the FMU fails."""
    lags = problem.in_rows(problem.lagging, values, 0)
    try:
        run = problem.simulate(values, 0, data=data)
    except (FmuError, SimulationError):
        return np.full(data.y.shape, np.nan)
    return lagged_table(run.outputs, np.array([lags.get(k, 0.0) for k in range(data.y.shape[1])]))


# Comparison, by likelihood, of inputs that are held and interpolated between rows.


def between_rows(problem: Problem, base: Hypothesis) -> tuple[float, str]:
    """Refit the recalibrated model with every input held instead of interpolated between rows, or vice versa.

    Returns:
        Log-likelihood gain, and a warning if the gain has the probability that a claim needs (with even prior odds) and
        is not due to chance over blocks of time.
    """
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    # Unknown inputs start at a large level, because inputs that compensated the wrong choice converge slowly.
    refit = fit(other, base.fit.free, base.fit.values, other.plain)
    gain, steady = base.fit.objective - refit.objective, steadiness(problem, refit, base.fit, other)
    if gain <= float(logit(CERTAIN)) or float(ndtr(-steady)) >= MISFIT:
        return gain, ""
    ways = [("interpolated", "held") if name in ramped else ("held", "interpolated") for name in names]
    setting = f"{{{', '.join(f'{name}: {other}' for name, (_, other) in zip(names, ways, strict=True))}}}"
    setting = ways[0][1] if len(set(ways)) == 1 else setting
    inputs = join_names([f"{name} is assumed to be {way}" for name, (way, _) in zip(names, ways, strict=True)])
    return gain, (
        f"between rows, {inputs}. The alternative raises the log-likelihood by {plain(gain)}, {plain(steady, 2)} times "
        f"its standard deviation; if the rig commands its inputs that way, write `inputs: {setting}` in the study"
    )
