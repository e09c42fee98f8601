"""From the hypotheses of a search to claims: bundle, lack of fit, decision, and what is delivered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.units import unit_of_rate
from cosim.estimation.fit import Fit
from cosim.estimation.kernel.nameless import RATE
from cosim.estimation.problem import Problem
from cosim.estimation.sensor_noise import at_rest
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.bundle import beside_unnamed_terms, bundle_of, chance_of, drifts, misfit_of, prior_of
from cosim.refinement.decision.claims import Claims, equivalent_groups, experiment_for
from cosim.refinement.decision.posterior import CERTAIN, MISFIT, Bundle, Decision, decide, log_evidence, log_prior
from cosim.refinement.decision.scatter import (
    fit_given_model,
    fit_without,
    held_out_errors,
    noise_gains,
    unknown_input_gain,
    with_intervals,
)
from cosim.refinement.proof.measure import (
    FLOOR_SEED,
    Variant,
    log_noise,
    noise_floor,
    predicted_errors,
    refined_subject,
    variant_of,
)
from cosim.refinement.search.fits import Hypothesis, Progress, Search, SearchResult
from cosim.refinement.search.missing import unknown_inputs
from cosim.refinement.search.unnamed import Leftover, find_unnamed_terms
from cosim.refinement.study import Study

SHOWN = 3  # classes on the ladder of predictions
TESTS = 2  # of the fit: for terms without a name, and for parameters that change


def claims_of(study: Study, result: SearchResult, progress: Progress) -> Claims:
    """Return the claims of a study."""
    subject, search = study.subject, result.search
    bundle = bundle_of(search, result.candidates, result.hidden)
    first = decide(bundle)
    base, best = search.tried[frozenset()], search.tried[first.nearest]
    units = {"time": "s", **{q.name: q.unit for q in subject.states}}
    units |= {f"{RATE}{q.name}": unit_of_rate(q.unit) for q in subject.states}
    units |= {f"command {q.name}": q.unit for q in subject.inputs}
    progress("looking for what has no name", 0.0)
    kernel = subject.kernel(search.problem.layout.outputs, unnamed=True, constant=study.settings.per_log)
    values = {**dict.fromkeys(kernel.layout.parameters, 0.0), **search.problem.values}
    nameless = replace(search.problem, kernel=kernel, values=values, sensing=best.fit.noise)
    leftover = find_unnamed_terms(nameless, best.fit, search.price, units)
    by_chance = TESTS * chance_of(nameless, leftover, best.fit)
    leftover = leftover if by_chance < MISFIT else Leftover()
    changing = {name: (change, TESTS * p) for name, (change, p) in drifts(search.problem, best.fit).items()}
    by_chance = min(1.0, by_chance, *(p for _, p in changing.values()))
    residual = _residual(search.problem, base.fit, best.fit, leftover)
    residual["changing"] = {name: change for name, (change, p) in changing.items() if p < MISFIT}
    inflated = [name for name, entry in residual["process_noise"].items() if entry["inflated"]]
    moves = {n: share for n, share in unknown_inputs(search.problem, best.fit, units).items() if n in inflated}
    progress("replaying with the claim and without", 0.0)
    beside = {}
    if leftover.fit is not None and best.candidates:
        beside = beside_unnamed_terms(search, best, leftover.fit, first.dispersion, len(bundle.kinds))
    settings = study.settings

    def refined(f: Fit) -> Variant:
        fitted = refined_subject(subject, search.problem, replace(best, fit=f))
        return variant_of(fitted, settings, f, result.free_noise)

    logs, given = (
        study.logs,
        variant_of(subject, settings, fit_given_model(search.problem, base.fit), result.free_noise),
    )
    # a single log has no others
    fits = [best.fit if len(logs) == 1 else fit_without(search, search.problem, best, k) for k in range(len(logs))]
    errors = {
        "before": predicted_errors([given] * len(logs), search.problem, logs),
        "after": predicted_errors([refined(f) for f in fits], search.problem, logs),
    }
    quiet = replace(refined(best.fit), noise=log_noise(best.fit.noise, result.free_noise))
    floor = noise_floor(quiet, search.problem, logs, np.random.default_rng(FLOOR_SEED))
    misfit = misfit_of(by_chance, moves, errors, floor.level, beside)
    claimed = None
    if max(first.inclusion.values(), default=0.0) >= CERTAIN:
        claimed = with_intervals(search, best)
        bundle = replace(bundle, unsure=frozenset(_unsure(search, claimed, bundle.families)))
    bundle = replace(bundle, misfit=misfit)
    decision = decide(bundle)
    tried = _ranked(search, bundle, decision.dispersion)
    delivered = _delivered(decision, [h for h, _ in tried])
    if claimed is None or delivered is None or delivered.key != claimed.key:
        claimed = with_intervals(search, delivered) if delivered else None
    shown = [search.tried[parts] for parts in [*decision.classes][:SHOWN] if parts]
    ladder = _ladder(search, base, [*shown, *([claimed] if claimed else [])])
    nearest = None
    if decision.grade != "claimed":  # the most probable class that predicts logs left out no worse than the given model
        most = float(np.mean(ladder[0][1]))
        better = {h.key: h for h, error in ladder if h is not None and float(np.mean(error)) <= most}
        nearest = next((better[parts] for parts in decision.classes if parts in better), better.get(frozenset()))
    rivals = tuple(decision.rivals)
    return Claims(
        bundle=bundle,
        decision=decision,
        base=base,
        claimed=claimed,
        nearest=nearest,
        tried=tried,
        experiment=experiment_for(subject, rivals) if rivals else "",
        equivalent=equivalent_groups(bundle.equivalent),
        residual=residual,
        moves=moves,
        hidden=[name for name in result.hidden if name not in decision.claimed],
        still=at_rest(search.problem),
        ladder=ladder,
    )


def _delivered(decision: Decision, ranked: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the most probable hypothesis with all claimed parts, and none beside them but base numbers.

    Args:
        ranked: Hypotheses, most probable first.
    """
    claimed = frozenset(decision.claimed)
    if not claimed:
        return None
    nearest = next(h for h in ranked if h.key == decision.nearest)
    if decision.verdict == "ambiguous" and claimed <= decision.nearest:
        return nearest  # the certain parts alone may fit worse than the given model
    numbers = {n for n in decision.uncertain if decision.verdict != "ambiguous"} - decision.disputed
    suited = (h for h in ranked if h.ended and claimed <= h.key <= claimed | numbers)
    return next(suited, nearest)


def _unsure(search: Search, h: Hypothesis, families: Mapping[str, str]) -> Iterator[str]:
    """Yield the parts of a hypothesis of which each size has an interval that holds the value without the part.

    A rich part with a difference that its special case has not is unsure if the interval of that holds 0.
    """
    for c in h.candidates:
        above = [f for f in c.free if f.above] if c.name in families else []
        ends = [(h.fit.values[f.name] - h.fit.values[f.above], h.fit.sigma(f.name, f.above)) for f in above]
        if above and all(difference < NORMAL_95 * sigma for difference, sigma in ends):
            yield c.name
        sizes = [p for p in (prior_of(search, h, f) for f in c.free) if p.is_size]
        intervals = [h.fit.interval(p.name) for p in sizes]
        if sizes and all(low <= p.centre <= high for p, (low, high) in zip(sizes, intervals, strict=True)):
            yield c.name


def _ladder(search: Search, base: Hypothesis, others: Sequence[Hypothesis]) -> list[tuple[Hypothesis | None, Array]]:
    """Return models with the log error of their predictions of each log, by fits to the other logs; simplest first.

    The first model is the given one, None.
    """
    every = sorted({h.key: h for h in others}.values(), key=lambda h: len(h.names))
    return [(h, held_out_errors(search, h, base.fit)) for h in (None, base, *every)]


def _ranked(search: Search, bundle: Bundle, kappa: float) -> list[tuple[Hypothesis, float]]:
    """Return the hypotheses with their log odds to the recalibrated model, most probable first.

    Of a hypothesis without evidence, since it was only screened or stopped far from its optimum, the odds are those of
    its score.
    """
    count, base = len(bundle.kinds), search.tried[frozenset()]
    weights = {e.parts: log_evidence(e, kappa) + log_prior(len(e.parts), count) for e in bundle.hypotheses}
    zero = weights[frozenset()]
    every = [(h, weights.get(h.key, zero + (base.score - h.score) / kappa)) for h in search.tried.values()]
    return [(h, weight - zero) for h, weight in sorted(every, key=lambda pair: -pair[1])]


def _residual(problem: Problem, base: Fit, best: Fit, leftover: Leftover) -> dict[str, Any]:
    """Return the deficient equation, the signals of the misfit and the process noise."""
    densities = zip(problem.layout.forced, base.noise.density, best.noise.density, strict=False)
    noise = {
        equation: {
            "before": float(before),
            "after": float(after),
            "inflated": gain > unknown_input_gain(problem),
            "gain": gain,
        }
        for (equation, before, after), gain in zip(densities, noise_gains(problem, best), strict=True)
    }
    inflated = {name: entry["gain"] for name, entry in noise.items() if entry["inflated"]}
    terms = leftover.terms if leftover.is_stable else ()
    where = terms[0].equation if terms else max(inflated, key=lambda k: inflated[k], default=None)
    signals = list(dict.fromkeys(u.signal for u in terms if u.equation == where))
    if not leftover.is_placed:
        where, signals = None if terms else where, signals[:1]
    return {
        "equation": where,
        "signals": signals,
        "share": terms[0].share if terms else None,
        "process_noise": noise,
        "terms": [u.entry for u in leftover.terms],
    }
