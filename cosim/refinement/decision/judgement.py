"""By what a hypothesis is judged: what its parts gain, limits, noise that it leaves, rivals, and why others lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cosim.base.text import listed
from cosim.estimation.fit import Fit, inverse
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.evidence import as_given, beyond_chance, held_out, scattered, steadiness
from cosim.refinement.search.fits import Found, Search, key_of
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.subject.base_parameters import WIDTHS
from cosim.subject.candidates import Candidate, Free

RIVAL = 3.0  # score within which another hypothesis explains as well
UNSURE = 2.0  # times its scatter, below which a difference in log-likelihood is none
SMALL = 3.0  # a part gains little, below so many times its cost: then chance must be less likely
NEAR = 8.0  # of score, beyond which none is a rival however it scatters
SIGNIFICANT = 3.0  # standard deviations from neutral
LITTLE = "gains little"
HELD = 0.7  # of what a part gains, that it gains on logs left out too
PLAIN, PLAINLY = 100.0, 4.0  # gain, and how steady, of a part that need not be tried on logs left out
NO_WORSE = 1.0  # of NLL, by which a fit that ended may be above what a hypothesis within it has reached
WORSE, BETTER = -3.0, 3.0  # times its scatter, by which predictions on logs left out refuse a part, or bear it out
TOLERANCES = (0.5, 2.0)  # times which the tolerances are taken, to see whether a claim hangs on them


def decided(found: Found) -> Attribution:
    """Return the best hypothesis of which every part is borne out, its rivals, and why the others lost."""
    search, base = found.search, found.search.tried[()]
    kept = _borne_out(search, found.best)
    best = kept.best
    if best.candidates:
        best = replace(best, fit=scattered(search.problem, best.fit))
    rivals = _rivals(search, best)
    tried = tuple(sorted(search.tried.values(), key=lambda h: h.score))
    reasons = Reasons(base, best, tried, rivals, search, kept.dropped).all()
    total = _support(search, best, base) if best.candidates else Support(0.0, 0.0)
    given, noise = as_given(search.problem, base.fit), noise_gain(search.problem, best.fit)
    return Attribution(
        base, given, tried, best, rivals, total, kept.support, noise, reasons, found.hidden, found.effects, kept.fuller
    )


@dataclass
class _Kept:
    """What is left of a hypothesis without the parts that are not borne out.

    support: of each part that is left; dropped: part → why it is not borne out
    fuller:  the hypothesis before the first of parts that are merely small, where these were dropped
    """

    best: Hypothesis
    support: dict[str, Support] = field(default_factory=dict)
    dropped: dict[str, str] = field(default_factory=dict)
    fuller: Hypothesis | None = None


def _borne_out(search: Search, best: Hypothesis) -> _Kept:
    """Drop the weakest part that is not borne out, until every part is; small ones stay where together they gain."""
    kept, of_fuller = _Kept(best), dict[str, Hypothesis]()
    while kept.best.candidates:
        best, without = kept.best, _without_each(search, kept.best)
        kept.support = {}
        for c in sorted(best.candidates, key=lambda c: without[c.name].fit.objective):  # the weakest first
            kept.support[c.name] = _support(search, best, without[c.name])
            if doubt := _doubt(search, best, c, kept.support[c.name]):
                break
        else:
            break
        kept.dropped[c.name], kept.best = doubt, without[c.name]
        if not doubt.startswith(LITTLE):
            kept.fuller = None
        elif kept.fuller is None:
            kept.fuller, of_fuller = best, without
    if kept.fuller is None or not _stand_together(search, kept.fuller, kept.best):
        return kept
    every = kept.fuller
    support = {c.name: _support(search, every, of_fuller[c.name]) for c in every.candidates}
    return _Kept(every, support, {n: doubt for n, doubt in kept.dropped.items() if n not in every.names})


def _stand_together(search: Search, every: Hypothesis, left: Hypothesis) -> bool:
    """Whether several parts that are merely small gain enough together."""
    small = [c for c in every.candidates if c.name not in left.names]
    if len(small) < 2 or left.fit.objective - every.fit.objective < search.cost(small):
        return False
    return steadiness(search.problem, every.fit, left.fit) > surely(search, every.fit)


def surely(search: Search, f: Fit) -> float:
    """Return how many times its scatter a gain must be for chance to be unlikely, with so many candidates."""
    return beyond_chance(search.problem, f, search.on_trial)


def _without_each(search: Search, h: Hypothesis) -> dict[str, Hypothesis]:
    """Fit the hypothesis without each of its parts to the end."""

    def one(c: Candidate) -> Hypothesis:
        left = tuple(other for other in h.candidates if other.name != c.name)
        known = search.tried.get(key_of(left))
        if known and known.ended:
            return known
        made = search.hypothesis(left, h.fit, loosen=False, patient=False)
        if made.fit.objective <= search.reached_within(left) + NO_WORSE:
            return made
        return search.hypothesis(left, h.fit)  # the noise of `h` explains too little without the part

    fitted = dict(zip((c.name for c in h.candidates), in_parallel(one, list(h.candidates)), strict=True))
    search.tried |= {f.names: f for f in fitted.values()}
    return fitted


def _support(search: Search, better: Hypothesis, worse: Hypothesis) -> Support:
    gain = worse.fit.objective - better.fit.objective
    steady = steadiness(search.problem, better.fit, worse.fit)
    if gain > PLAIN and steady > PLAINLY:
        return Support(gain, steady)
    return Support(gain, steady, *held_out(search, better, worse))


def _doubt(search: Search, h: Hypothesis, c: Candidate, s: Support) -> str:
    """Return the reason why a part is not borne out; empty where it is."""
    if s.gain < search.cost([c]):
        return f"gains {s.gain:.1f}, less than the {search.cost([c]):.0f} that it costs"
    if limits := _limits(h, [c], search.problem.values):
        return f"{limits[0]} is at its limit"
    if c.kind == "parameter":  # what logs left out say of it, they say to the base model too
        return "" if outside(search, h, c) else "is within its tolerance"
    if s.gain < SMALL * search.cost([c]) and s.steady < surely(search, h.fit):
        return f"{LITTLE}, and that is {s.steady:.1f} times its own scatter over time"
    if s.steady < UNSURE and not s.held_out > HELD * s.gain:  # what acts seldom gains in few blocks, but in each log
        return f"what it gains is {s.steady:.1f} times its own scatter over time"
    if s.held_out <= 0.0 and not s.predicted > BETTER:
        return "gains nothing on logs left out"
    if s.predicted < WORSE:
        return "predictions of logs left out are worse with it"
    return ""


def outside(search: Search, h: Hypothesis, c: Candidate) -> bool:
    """Whether the interval of a base parameter is wholly beyond its tolerance."""
    (name,) = c.parameters
    held = {f.name: f.prior for f in search.free(()) if f.prior}
    if name not in held:
        return True
    return beyond(h.fit, name, held[name])


def beyond(f: Fit, name: str, prior: tuple[float, float]) -> bool:
    """Whether the 95 % interval of a base parameter is wholly further from its stated value than its tolerance."""
    mean, sigma = prior
    return abs(f.values[name] - mean) - NORMAL_95 * f.sigma(name) > WIDTHS * sigma


def _rivals(search: Search, best: Hypothesis) -> tuple[Hypothesis, ...]:
    """Return hypotheses that explain as well; of no more candidates, those too that would with other tolerances."""
    if not best.candidates:
        return ()
    near = [h for h in search.tried.values() if h.ended and h.score - best.score < NEAR and h.is_apart(best)]
    near = [h for h in near if len(h.candidates) <= len(best.candidates) or h.score - best.score < RIVAL]
    rivals = [h for h in sorted(near, key=lambda h: h.score) if _is_rival(search, best, h)]
    # one with more than another, and no better for it, is no rival of its own
    return tuple(h for k, h in enumerate(rivals) if not any(set(r.names) < set(h.names) for r in rivals[:k]))


def _is_rival(search: Search, best: Hypothesis, h: Hypothesis) -> bool:
    if h.score - best.score < RIVAL:
        return True
    weight, cost, least = search.problem.scatter, search.cost(h.candidates), search.cost(best.candidates)
    if any(_with_tolerance(h, t, weight) + cost < _with_tolerance(best, t, weight) + least for t in TOLERANCES):
        return True
    # that a richer one costs more counts against it, or one that holds the best as a special case always were a rival
    return steadiness(search.problem, best.fit, h.fit, max(0.0, cost - least)) < UNSURE


def _with_tolerance(h: Hypothesis, times: float, weight: float) -> float:
    """Return the objective where every tolerance is so many times as wide, by the fit's own quadratic.

    weight: of priors against likelihood. With F the information without priors and θ̂ where it alone would lead, the
    minimum of ½(θ−θ̂)'F(θ−θ̂) + priors.
    """
    f = h.fit
    held = [(k, x.prior) for k, x in enumerate(f.free) if x.prior]
    if not held:
        return f.objective
    n = len(f.information)
    now, then, off = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    for k, (mean, sigma) in held:
        now[k, k], then[k, k] = weight * sigma**-2, weight * (times * sigma) ** -2
        off[k] = f.values[f.free[k].name] - mean
    bare = f.information - now
    pull = now @ off  # gradient of the priors here, which that of the likelihood balances
    # about θ: L(δ) = −pull·δ + ½ δ'F δ, prior(δ) = ½ (off + δ)'then(off + δ)
    delta = inverse(bare + then) @ (pull - then @ off)
    likelihood = float(-pull @ delta + 0.5 * delta @ bare @ delta)
    prior = 0.5 * float((off + delta) @ then @ (off + delta))
    return f.objective - 0.5 * float(off @ now @ off) + likelihood + prior


def loss_without(h: Hypothesis, c: Candidate, neutral: Mapping[str, float]) -> float:
    """Return the log-likelihood that a hypothesis would lose without a part, by the information of its fit."""
    away = np.array([h.fit.values[f.name] - neutral[f.name] for f in c.free])
    return 0.5 * float(away @ h.fit.marginal(c.parameters) @ away)


def noise_gain(problem: Problem, f: Fit) -> tuple[float, ...]:
    """Return the log-likelihood that the unknown input of each forced equation gains in a fit."""
    without = np.diag(problem.noise.smallest - f.noise.power) + f.noise.power
    return tuple(problem.scored(f.values, replace(f.noise, power=power)).nll - f.nll for power in without)


def at_limit(h: Hypothesis, f: Free, neutral: Mapping[str, float]) -> bool:
    """Whether a parameter was moved as far as it may; neutral is where an effect belongs that there is too much of."""
    value = h.fit.values[f.name]
    limits = f.low, f.high, h.fit.values.get(f.above)
    return value in limits and value not in (neutral[f.name], f.neutral)


def _limits(h: Hypothesis, parts: Sequence[Candidate], neutral: Mapping[str, float]) -> list[str]:
    """Return the parameters of some parts that are at a limit."""
    return [f.name for c in parts for f in c.free if at_limit(h, f, neutral)]


@dataclass(frozen=True)
class Reasons:
    """Why each hypothesis but the best is not the answer, in words."""

    base: Hypothesis
    best: Hypothesis
    tried: Sequence[Hypothesis]
    rivals: Sequence[Hypothesis]
    search: Search
    dropped: Mapping[str, str]

    def all(self) -> dict[tuple[str, ...], str]:
        """Return the reasons by the names of each hypothesis."""
        return {h.names: self._reason(h) for h in self.tried if h.names != self.best.names}

    def _reason(self, h: Hypothesis) -> str:
        """Return the first reason that applies."""
        gained, behind = self.base.score - h.score, h.score - self.best.score
        than = listed(self.best.names) or "the base model"
        if any(h.names == r.names for r in self.rivals):
            return f"a rival: explains as well as {than}"
        if extra := [n for n in h.names if n in self.dropped]:
            return f"{extra[0]}: {self.dropped[extra[0]]}"
        if h.fit.objective >= self.base.fit.objective:
            return "no gain"
        if gained < 0.0:
            return "gains less than it costs"
        if limits := _limits(h, h.candidates, self.search.problem.values):
            return f"{limits[0]} is at its limit"
        if behind < 0.0:
            return f"gains {-behind:.1f} on {than}, but not with every part borne out"
        return f"explains less than {than} by {behind:.1f}"
