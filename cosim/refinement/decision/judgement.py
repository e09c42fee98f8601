"""Judgement of a hypothesis: gain of each part, limits, remaining noise, rivals, and reasons against the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cosim.core.text import join_names
from cosim.estimation.fit import MAX_SECONDS, Fit, inverse
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import WIDTHS, Candidate, Free
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.equivalence import split_alike
from cosim.refinement.decision.evidence import (
    chance_limit,
    deviations_by_chance,
    fit_given_model,
    held_out_gains,
    refutation,
    refuting_deviations,
    steadiness,
    with_intervals,
)
from cosim.refinement.decision.prediction_fit import error_ratios, has_predictions, predicted_gain
from cosim.refinement.search.fits import Search, SearchResult, key_of
from cosim.refinement.search.hypotheses import (
    NOISE,
    TOGETHER,
    Attribution,
    Hypothesis,
    Support,
    are_halved,
    best_hypothesis,
    settled,
)
from cosim.terms.alike import are_alike, contains

RIVAL = 3.0  # score difference within which another hypothesis explains the logs equally well
BY_CHANCE = 0.05  # probability below which the gain of a richer term that looks alike is no chance
NEAR = 8.0  # score difference beyond which no hypothesis is a rival, whatever the scatter
SIGNIFICANT = 3.0  # standard deviations from the neutral value
MOST_OTHERS = 2  # hypotheses judged in place of one with refused parts
LITTLE = "its gain may be chance"
PLAIN, PLAINLY = 100.0, 4.0  # gain, and gain per scatter, from which a part needs no test on held-out logs
NO_WORSE = 1.0  # NLL by which a final fit may exceed the objective of a hypothesis contained in it
WORSE, BETTER = -3.0, 3.0  # gain per scatter of held-out predictions that rejects or supports a part
TOLERANCES = (0.5, 2.0)  # factors on the tolerances that test whether a claim depends on them


def decide(result: SearchResult) -> Attribution:
    """Return the best supported hypothesis and its rivals."""
    search, base = result.search, result.search.tried[()]
    rest = _with_nearly_paid(search, _unrefuted(search, _supported(search, result.best, result.candidates)))
    best = rest.best
    if search.subject.probed and best.candidates and rest.dropped:
        search.fit_alike(_rivals_without(search, best, rest.dropped), best)
    rivals, alike = split_alike(search, best, _rivals(search, best))
    tried = tuple(sorted(search.tried.values(), key=lambda h: h.score))
    reasons = {h.names: _reason(search, h, best, rivals, rest.dropped) for h in tried if h.names != best.names}
    reasons |= {names: f"acts like {join_names(h.names)} for every input" for names, h in alike.items()}
    total = _support(search, best, base) if best.candidates else Support(0.0, 0.0)
    unfitted, noise = fit_given_model(search.problem, base.fit), noise_gain(search.problem, best.fit)
    ratios = _error_ratios(search, best, base, noise) if best.candidates else ()
    evidence = (total, rest.support, noise, reasons, result.hidden, result.effects, rest.fuller, ratios, alike)
    plain = {name: refusal.reason for name, refusal in rest.dropped.items() if refusal.is_plain}
    return Attribution(base, unfitted, tried, best, rivals, *evidence, plain)


def halving_subset(search: Search, a: Attribution) -> Attribution | None:
    """Return the attribution with the smallest fitted subset of the best hypothesis that halves the held-out error.

    Parts that together predict other logs badly say nothing against one of them. A subset has an effect or a sensor
    error; the best of equally many parts is taken.
    """
    within = [h for h in settled(search.tried.values(), a.base.score) if a.best.extends(h) and not h.is_of_parameters]
    for h in sorted(within, key=lambda h: (len(h.candidates), h.score)):
        noise = noise_gain(search.problem, h.fit)
        ratios = _error_ratios(search, h, a.base, noise)
        if are_halved(ratios):
            alone = (
                f"without {join_names(sorted(set(a.best.names) - set(h.names)))}, the error of held-out logs is halved"
            )
            reasons = {**a.reasons, a.best.names: alone}
            found = replace(
                a, best=with_intervals(search, h), rivals=(), noise_gain=noise, reasons=reasons, fuller=None
            )
            return replace(found, error_ratios=ratios, alike={})
    return None


def _error_ratios(search: Search, best: Hypothesis, base: Hypothesis, noise: Sequence[float]) -> tuple[float, ...]:
    """Return the ratios of errors on held-out logs, by the filter's fits or, beside unknown inputs, to predictions."""
    ratios = error_ratios(search, best, base, to_predictions=False)
    if are_halved(ratios) or max(noise, default=0.0) <= NOISE or not has_predictions(search):
        return ratios
    return error_ratios(search, best, base, to_predictions=True)


def _supported(search: Search, best: Hypothesis, candidates: Sequence[Candidate]) -> _Remainder:
    """Return the supported parts of the best hypothesis; of an FMU, or of another one that is then better.

    A refused part says nothing against a simpler one in its place.
    """
    found, judged = _remainder(search, best), [best]
    if search.subject.probed:
        _fit_special_cases(search, best, found.dropped, candidates)
    while search.subject.probed and found.dropped and len(judged) <= MOST_OTHERS:
        others = [
            h
            for h in settled(search.tried.values(), found.best.score - RIVAL)
            if h not in judged and found.dropped.keys().isdisjoint(h.names)
        ]
        if not others:
            break
        judged.append(best_hypothesis(others))
        other = _remainder(search, judged[-1])
        kept = other if other.best.score < found.best.score else found
        found = replace(kept, dropped={**other.dropped, **found.dropped})
    return found


def _fit_special_cases(
    search: Search, best: Hypothesis, dropped: Collection[str], candidates: Sequence[Candidate]
) -> None:
    """Fit the special case of each dropped part in its place, from its values."""
    pairs = ((rich, simple) for rich in best.candidates for simple in candidates if contains(rich.name, simple.name))
    for rich, simple in pairs:
        if rich.name not in dropped:
            continue
        names = {f.name.replace(simple.name, rich.name): f.name for f in simple.free}
        values = {names[n]: best.fit.values[n] for n in rich.parameters if n in names}
        parts = tuple(simple if c is rich else c for c in best.candidates)
        h = search.hypothesis(parts, best.fit, promised=values)
        earlier = search.tried.get(h.names)
        if not (earlier and earlier.ended and earlier.score <= h.score):
            search.tried[h.names] = h


def _unrefuted(search: Search, rest: _Remainder) -> _Remainder:
    """Return the remainder, or in its place a richer rival that refutes it, if all parts of the rival are supported."""
    best = rest.best
    near = [h for h in settled(search.tried.values(), best.score + RIVAL) if h.is_apart(best)]
    for h in sorted(near, key=lambda h: h.score):
        if _refutes(search, h, best):
            found = _remainder(search, h)
            if found.best.names == h.names:
                return replace(found, dropped={**rest.dropped, **found.dropped})
    return rest


def _with_nearly_paid(search: Search, rest: _Remainder) -> _Remainder:
    """Return the remainder with a fuller hypothesis if one more part nearly pays its cost, and gains more than chance.

    Such a part is no claim, but is named beside the verdict.
    """
    best, size = rest.best, len(rest.best.candidates) + 1
    larger = [
        h for h in settled(search.tried.values(), best.score + RIVAL) if h.extends(best) and len(h.candidates) == size
    ]
    larger = [h for h in larger if rest.dropped.keys().isdisjoint(h.names)]
    if rest.fuller or not larger:
        return rest
    h = best_hypothesis(larger)
    (part,) = (c for c in h.candidates if c.name not in best.names)
    support = _support(search, h, best)
    limit = chance_limit(search.problem, h.fit, search.on_trial * part.among)
    is_named = part.kind != "parameter" and support.steady >= limit and support.held_out > 0.0
    return replace(rest, fuller=h) if is_named else rest


def _refutes(search: Search, rich: Hypothesis, simple: Hypothesis) -> bool:
    """Return True if the logs refute a hypothesis beside one with as many candidates, but more parameters.

    The score charges each further parameter alike. If the simple hypothesis is true and the rich one contains it, each
    is expected to gain ½, and the divergence is as large.
    """
    more = sum(len(c.free) for c in rich.candidates) - sum(len(c.free) for c in simple.candidates)
    if more < 1 or len(rich.candidates) != len(simple.candidates):
        return False
    deviations = refutation(search.problem, rich.fit, simple.fit, -more * search.problem.scatter)
    return deviations >= refuting_deviations(len(simple.candidates))


def _remainder(search: Search, best: Hypothesis) -> _Remainder:
    """Return the supported parts of a hypothesis that are certain, or a fuller hypothesis in which all are."""
    rest = _drop_unsupported(search, best)
    if not rest.best.candidates:
        return rest
    certain = _with_certain_parts(search, rest.best, rest.dropped)
    fuller = _fuller_certain(search, rest.best, certain) if certain.names != rest.best.names else None
    if fuller is None:
        return replace(rest, best=certain)
    support = {n: _support(search, fuller, without) for n, without in _fit_without_each(search, fuller).items()}
    return _Remainder(fuller, support, {n: doubt for n, doubt in rest.dropped.items() if n not in fuller.names})


def _fuller_certain(search: Search, refused: Hypothesis, rest: Hypothesis) -> Hypothesis | None:
    """Return a hypothesis that contains a refused one, if it is better than what remains and all its parts are certain.

    Estimates of a part differ between the logs, too, if another part is missing beside it. Its gain beside the refused
    hypothesis may be a little less than its cost.

    Args:
        refused: Hypothesis with a part that is not certain.
        rest: The hypothesis without this part.
    """
    limit = min(rest.score, refused.score + RIVAL)
    near = [h for h in settled(search.tried.values(), limit) if h.extends(refused)]
    for h in sorted(near, key=lambda h: h.score):
        new = [c for c in h.candidates if c.name not in refused.names]
        if any(c.kind == "parameter" for c in new) or _parameters_at_limit(h, new, search.problem.values):
            continue
        h = with_intervals(search, h)
        if any(may_be_chance(search, h, c) for c in h.candidates):
            continue
        joint = _support(search, h, rest)
        is_chance = joint.steady < chance_limit(search.problem, h.fit, search.on_trial)
        if not (is_chance or joint.held_out <= 0.0 or joint.predicted < WORSE):
            return h
    return None


@dataclass(frozen=True)
class Refusal:
    """Reason against a part, its evidence, and the names of the set in which it was judged."""

    names: tuple[str, ...]
    reason: str
    support: Support | None = None

    @property
    def is_plain(self) -> bool:
        """Return True if the part explains far more than chance would."""
        s = self.support
        return s is not None and s.gain > PLAIN and s.steady > PLAINLY

    def against(self, part: str, h: Hypothesis) -> str:
        """Return the reason against a hypothesis that contains the part."""
        text = f"{part}: {self.reason}"
        return text if h.names == self.names else f"in the set {TOGETHER.join(self.names)}: {text}"


@dataclass
class _Remainder:
    """The supported remainder of a hypothesis.

    Attributes:
        support: Evidence for each remaining part.
        dropped: Name of a dropped part → its refusal.
        fuller: Hypothesis before the first part was dropped only for its small gain.
    """

    best: Hypothesis
    support: dict[str, Support] = field(default_factory=dict)
    dropped: dict[str, Refusal] = field(default_factory=dict)
    fuller: Hypothesis | None = None


def _drop_unsupported(search: Search, best: Hypothesis) -> _Remainder:
    """Drop the weakest unsupported part of a hypothesis repeatedly, until all remaining parts have support.

    Parts with small gains stay if their joint gain is sufficient.
    """
    rest, of_fuller = _Remainder(best), dict[str, Hypothesis]()
    while rest.best.candidates:
        best, without = rest.best, _fit_without_each(search, rest.best)
        rest.support = {}
        for c in sorted(best.candidates, key=lambda c: without[c.name].fit.objective):  # weakest first
            rest.support[c.name] = _support(search, best, without[c.name])
            if doubt := _doubt(search, best, c, rest.support[c.name]):
                break
        else:
            break
        rest.dropped[c.name], rest.best = Refusal(best.names, doubt, rest.support[c.name]), without[c.name]
        if not doubt.startswith(LITTLE):
            rest.fuller = None
        elif rest.fuller is None:
            rest.fuller, of_fuller = best, without
    fuller = rest.fuller
    if fuller is None or not _gain_together(search, fuller, rest.best):
        return rest
    support = {c.name: _support(search, fuller, of_fuller[c.name]) for c in fuller.candidates}
    return _Remainder(fuller, support, {n: doubt for n, doubt in rest.dropped.items() if n not in fuller.names})


def _with_certain_parts(search: Search, best: Hypothesis, dropped: dict[str, Refusal]) -> Hypothesis:
    """Return a hypothesis with intervals, without parts that may have no effect.

    One candidate of many often corrects another one, or something outside the catalogue, at a value that differs
    between the logs. A part is certain if it stands further from the model's value than the best of all candidates by
    chance.

    Args:
        dropped: Name of a dropped part → its refusal, to add to.
    """
    best = with_intervals(search, best)
    weak = next((c for c in best.candidates if may_be_chance(search, best, c)), None)
    if weak is None:
        return best
    least = deviations_by_chance(search.on_trial * weak.among)
    reason = f"its value is less than {least:.1f} standard deviations from that of the model"
    dropped[weak.name] = Refusal(best.names, reason)
    rest = _without_part(search, best, weak)
    return _with_certain_parts(search, rest, dropped) if rest.candidates else rest


def _without_part(search: Search, h: Hypothesis, c: Candidate) -> Hypothesis:
    """Return a hypothesis without one of its parts, as fitted before if possible."""
    others = tuple(other for other in h.candidates if other.name != c.name)
    rest = search.tried.get(key_of(others)) or search.hypothesis(others, h.fit)
    search.tried[rest.names] = rest
    return rest


def may_be_chance(search: Search, h: Hypothesis, c: Candidate) -> bool:
    """Return True if a part is as near to the model's value as the best of all candidates and shapes by chance.

    Where the likelihood is flat at the estimate, as for a lag shorter than the time between rows, the interval holds
    values that explain the logs alike; its width is no standard deviation and says nothing here. Nor does the distance
    say anything against a part that halves the error of held-out logs, or without which a hypothesis would not do so:
    two parameters of a part may be known together only, and neither by itself.
    """
    distances = [f.name for f in c.free if f.neutral is not None]
    is_judged = bool(distances) and c.kind != "parameter" and not any(map(h.fit.is_flat, distances))
    if not is_judged or h.is_away(c, deviations_by_chance(search.on_trial * c.among), search.problem.values):
        return False
    return not _halves_error(search, h, c)


def _halves_error(search: Search, h: Hypothesis, c: Candidate) -> bool:
    """Return True if a part halves the error of held-out logs, or if the hypothesis does only with it.

    In both cases, the part reduces the error on each log.
    """
    rest, noise, base = _without_part(search, h, c), noise_gain(search.problem, h.fit), search.tried[()]
    ratios = _error_ratios(search, h, rest, noise)
    if are_halved(ratios) or not rest.candidates or max(ratios, default=1.0) >= 1.0:
        return are_halved(ratios)
    with_part, without = (are_halved(_error_ratios(search, x, base, noise)) for x in (h, rest))
    return with_part and not without


def _gain_together(search: Search, fuller: Hypothesis, rest: Hypothesis) -> bool:
    """Return True if small dropped parts together gain enough."""
    small = [c for c in fuller.candidates if c.name not in rest.names]
    if len(small) < 2 or rest.fit.objective - fuller.fit.objective < search.cost(small):
        return False
    limit = chance_limit(search.problem, fuller.fit, search.on_trial)
    return steadiness(search.problem, fuller.fit, rest.fit) > limit


def _fit_without_each(search: Search, h: Hypothesis) -> dict[str, Hypothesis]:
    """Return candidate → fit of the hypothesis without this candidate."""

    def fit_without(c: Candidate) -> Hypothesis:
        rest = tuple(other for other in h.candidates if other.name != c.name)
        earlier = search.tried.get(key_of(rest))
        if earlier and earlier.ended:
            return earlier
        quick = search.hypothesis(rest, h.fit, loosen=False, patient=False)
        if quick.fit.objective <= search.bound_within(rest) + NO_WORSE:
            return quick
        return search.hypothesis(rest, h.fit)  # With the noise of `h`, the fit without the part stays too high.

    fitted = dict(zip((c.name for c in h.candidates), in_parallel(fit_without, list(h.candidates)), strict=True))
    search.tried |= {f.names: f for f in fitted.values()}
    return fitted


def _support(search: Search, better: Hypothesis, worse: Hypothesis) -> Support:
    gain = worse.fit.objective - better.fit.objective
    steady = steadiness(search.problem, better.fit, worse.fit)
    is_chosen = any(c.repeats for c in better.candidates if c.name not in worse.names)
    if gain > PLAIN and steady > PLAINLY and not is_chosen:  # one of many periods may fit whatever is missing
        return Support(gain, steady)
    held_out, predicted = held_out_gains(search, better, worse)
    if predicted < WORSE and has_predictions(search):  # A filter's fit of few logs may explain motion by noise.
        predicted = predicted_gain(search, better, worse)
    return Support(gain, steady, held_out, predicted)


def _doubt(search: Search, h: Hypothesis, c: Candidate, s: Support) -> str:
    """Return the reason against a part, or ""."""
    if s.gain < search.cost([c]):
        return f"gains {s.gain:.1f}, less than the {search.cost([c]):.0f} that it costs"
    if limits := _parameters_at_limit(h, [c], search.problem.values):
        return f"{limits[0]} is at its limit"
    if c.kind == "parameter":  # Held-out logs say the same about the base model.
        return "" if is_outside_tolerance(search, h, c) else "is within its tolerance"
    if s.steady < chance_limit(search.problem, h.fit, search.on_trial * c.among) and not s.held_out > search.cost([c]):
        return f"{LITTLE}: {s.gain:.1f}, {s.steady:.1f} times its scatter"
    if s.held_out <= 0.0 and not s.predicted > BETTER:
        return "gains nothing on logs left out"
    if s.predicted < WORSE:
        return "predictions of logs left out are worse with it"
    return ""


def is_outside_tolerance(search: Search, h: Hypothesis, c: Candidate) -> bool:
    """Return True if the confidence interval of a base parameter is outside its tolerance."""
    (name,) = c.parameters
    priors = {f.name: f.prior for f in search.free(()) if f.prior}
    return name not in priors or is_beyond_tolerance(h.fit, name, priors[name])


def is_beyond_tolerance(f: Fit, name: str, prior: tuple[float, float]) -> bool:
    """Return True if the 95 % interval of a base parameter is completely outside its tolerance."""
    mean, sigma = prior
    return abs(f.values[name] - mean) - NORMAL_95 * f.sigma(name) > WIDTHS * sigma


def _rivals(search: Search, best: Hypothesis) -> tuple[Hypothesis, ...]:
    """Return hypotheses that explain the logs equally well.

    Hypotheses without more candidates than the best also count if other tolerances would make them equal.
    """
    if not best.candidates:
        return ()
    near = [h for h in settled(search.tried.values(), best.score + NEAR) if h.is_apart(best)]
    near = [h for h in near if len(h.candidates) <= len(best.candidates) or h.score - best.score < RIVAL]
    rivals = [h for h in sorted(near, key=lambda h: h.score) if _is_rival(search, best, h)]
    # A superset of a rival with no better score is not a separate rival.
    return tuple(h for k, h in enumerate(rivals) if not any(set(r.names) < set(h.names) for r in rivals[:k]))


def _rivals_without(search: Search, best: Hypothesis, dropped: Collection[str]) -> list[Hypothesis]:
    """Return what came near the best hypothesis beside dropped parts, without these parts, where it was not fitted.

    The search fits what replaces a part of its own best hypothesis, which had more parts.
    """
    found: dict[tuple[str, ...], Hypothesis] = {}
    for h in search.tried.values():
        beside = [c for c in h.candidates if c.name in dropped]
        rest = replace(h, candidates=tuple(c for c in h.candidates if c not in beside))
        before = search.tried.get(key_of((*best.candidates, *beside)))
        earlier = search.tried.get(rest.names)
        is_new = beside and rest.is_apart(best) and not (earlier and earlier.ended)
        if before and is_new and h.score - before.score < NEAR:
            found[rest.names] = rest
    return [*found.values()]


def _is_rival(search: Search, best: Hypothesis, h: Hypothesis) -> bool:
    """Return True if a hypothesis explains the logs as well as the best.

    A term that contains one of the best hypothesis, at a limit of its own, tells no more than that one.
    """
    richer = [c for c in h.candidates if any(contains(c.name, name) for name in best.names)]
    if _refutes(search, best, h) or (richer and _parameters_at_limit(h, richer, search.problem.values)):
        return False
    if h.score - best.score < RIVAL or (search.subject.probed and _is_richer_twin(search, best, h)):
        return True
    weight, cost, least = search.problem.scatter, search.cost(h.candidates), search.cost(best.candidates)
    if any(_with_tolerance(h, t, weight) + cost < _with_tolerance(best, t, weight) + least for t in TOLERANCES):
        return True
    # The larger cost of a richer hypothesis counts against it; otherwise every extension of the best would be a rival.
    deviations = refutation(search.problem, best.fit, h.fit, max(0.0, cost - least))
    return deviations < refuting_deviations(len(h.candidates))


def _is_richer_twin(search: Search, best: Hypothesis, h: Hypothesis) -> bool:
    """Return True if a hypothesis has a richer term in place of one that looks alike, and explains the logs as well.

    The gain need not be worth the cost of the further parameters: the simpler term alone would be a wrong name. A term
    that contains the simpler one must gain more than chance. Any other term must explain the logs at its usual shape,
    because most terms imitate a simpler one at some extreme shape.
    """
    from scipy.special import chdtri

    own, others = set(best.names) - set(h.names), set(h.names) - set(best.names)
    more = sum(len(c.free) for c in h.candidates) - sum(len(c.free) for c in best.candidates)
    if len(own) != 1 or len(others) != 1 or more < 1:
        return False
    (simple,), (rich,) = own, others
    if not are_alike(simple, rich):
        return False
    if best.fit.objective - h.fit.objective > 0.5 * float(chdtri(more, BY_CHANCE)):
        return True
    return not contains(rich, simple) and _at_usual_shape(search, h, rich) - best.fit.objective < RIVAL


def _at_usual_shape(search: Search, h: Hypothesis, name: str) -> float:
    """Return the objective of a hypothesis with the shape of one term, all parameters without neutral value, fixed."""
    (rich,) = (c for c in h.candidates if c.name == name)
    fixed = [f.name for f in rich.free if f.neutral is None]
    if not fixed:
        return h.fit.objective
    usual = replace(rich, free=tuple(f for f in rich.free if f.neutral is not None))
    rest = tuple(c for c in h.candidates if c is not rich)
    start = replace(h.fit, free=tuple(f for f in h.fit.free if f.name not in fixed))
    return search.hypothesis((*rest, usual), start, loosen=False, patient=False).fit.objective


def _with_tolerance(h: Hypothesis, times: float, weight: float) -> float:
    """Return the objective of a fit with scaled tolerances.

    The result is the minimum of ½(θ−θ̂)'F(θ−θ̂) + priors, with F the information without priors and θ̂ its optimum.

    Args:
        times: Factor on every tolerance.
        weight: Weight of the priors relative to the likelihood.
    """
    f = h.fit
    priors = [(k, x.prior) for k, x in enumerate(f.free) if x.prior]
    if not priors:
        return f.objective
    n = len(f.information)
    now, then, off = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    for k, (mean, sigma) in priors:
        now[k, k], then[k, k] = weight * sigma**-2, weight * (times * sigma) ** -2
        off[k] = f.values[f.free[k].name] - mean
    bare = f.information - now
    pull = now @ off  # gradient of the priors, balanced here by the likelihood
    # about θ: L(δ) = −pull·δ + ½ δ'F δ, prior(δ) = ½ (off + δ)'then(off + δ)
    delta = inverse(bare + then) @ (pull - then @ off)
    likelihood = float(-pull @ delta + 0.5 * delta @ bare @ delta)
    prior = 0.5 * float((off + delta) @ then @ (off + delta))
    return f.objective - 0.5 * float(off @ now @ off) + likelihood + prior


def loss_without(h: Hypothesis, c: Candidate, neutral: Mapping[str, float]) -> float:
    """Return the estimated log-likelihood loss without a part."""
    away = np.array([h.fit.values[f.name] - neutral[f.name] for f in c.free])
    return 0.5 * float(away @ h.fit.marginal(c.parameters) @ away)


def noise_gain(problem: Problem, f: Fit) -> tuple[float, ...]:
    """Return the log-likelihood gain of each unknown input."""
    without = np.diag(problem.noise.smallest - f.noise.power) + f.noise.power
    return tuple(problem.score(f.values, replace(f.noise, power=power)).nll - f.nll for power in without)


def is_at_limit(h: Hypothesis, f: Free, neutral: Mapping[str, float]) -> bool:
    """Return True if a parameter is at a limit other than its neutral value.

    The neutral value is no limit, since it removes the effect; nor is the resolution of the integration.
    """
    value = h.fit.values[f.name]
    limits = f.high, h.fit.values.get(f.above), *(() if f.resolved else (f.low,))
    return value in limits and value not in (neutral[f.name], f.neutral)


def _parameters_at_limit(h: Hypothesis, parts: Sequence[Candidate], neutral: Mapping[str, float]) -> list[str]:
    """Return the parameters at a limit, other than that of a complete error, as of a sensor without direction."""
    free = [f for c in parts for f in c.free if h.fit.values[f.name] != c.complete.get(f.name)]
    return [f.name for f in free if is_at_limit(h, f, neutral)]


def _reason(
    search: Search, h: Hypothesis, best: Hypothesis, rivals: Sequence[Hypothesis], dropped: Mapping[str, Refusal]
) -> str:
    """Return the first reason that applies against a hypothesis, in words; "" if only its score decides."""
    base = search.tried[()]
    than = join_names(best.names) or "the base model"
    if any(h.names == r.names for r in rivals):
        return f"explains as well as {than}"
    if extra := [n for n in h.names if n in dropped]:
        return dropped[extra[0]].against(extra[0], h)
    if h.fit.is_cut:
        return f"its fit was stopped after {MAX_SECONDS:.0f} s of processor time"
    if h.fit.objective >= base.fit.objective:
        return "no gain"
    if base.score - h.score < 0.0:
        return "gains less than it costs"
    if limits := _parameters_at_limit(h, h.candidates, search.problem.values):
        return f"{limits[0]} is at its limit"
    return ""
