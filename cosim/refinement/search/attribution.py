"""Search for missing effects: score tests of all sets of candidates, fits of the most promising, choice of the best.

The base model is fitted first. Near the best hypothesis so far, a score test predicts the gain of sets of candidates
(one or two more, one replaced, one less) by one filter run per parameter. The sets with the largest predicted gain are
fitted. Parts that a fit moves to neutral are removed, and the rest is fitted again. The search continues around the new
best hypothesis until no set has a predicted gain. This corrects an effect that, alone, was fitted with a wrong sign or
in place of another effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, combinations
from typing import Any, Self

import numpy as np
from scipy.special import ndtri

from cosim.estimation.fit import CONVERGED_GAIN, NOISE_DIFFERENCE, Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.posing import coarsen, erring_stamps, with_equations_trusted, with_finer_steps, with_likely_starts
from cosim.estimation.problem import Problem
from cosim.estimation.screen import Choice, Promise, ScoreTest, Terms
from cosim.estimation.subject.candidates import Candidate, values_of_special_case
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.bundle import evidence, held_out_errors, noise_gains, optima
from cosim.refinement.decision.posterior import (
    CERTAIN,
    CLEARLY,
    MISFIT,
    POSSIBLE,
    Names,
    dispersion,
    folded,
    log_prior,
    posterior,
)
from cosim.refinement.search.fits import (
    FITTED_WITHIN_NATS,
    HOPE,
    Hypothesis,
    Parts,
    Progress,
    Search,
    Trial,
    best_hypothesis,
    key_of,
)
from cosim.refinement.search.unnamed import with_likely_periods

FITTED = 6  # sets fitted in each round; candidates with the largest predicted gain from which sets are formed
DONE = 1.0  # least improvement of the score by a round [nats]
USUAL_STAMP = 0.05  # usual error of time stamps, as a share of a row; start value of a fit
BREADTH = 4  # most probable sets whose neighbours are tried in a round; additions, replacements of a part
EXPANSIONS = 4  # rounds in which neighbours are tried
Start = tuple[Parts, Fit]


class Attributor(Search):
    """Search for missing effects: fit of the base model, rounds of sets of candidates, final fits of the best sets.

    Attributes:
        fine: Problem with all substeps; `problem` has the fewest that leave the likelihood unchanged.
        usual: Candidates with usual periods of forces; `candidates` have likely periods.
        identifiable: Candidate → largest χ² of its terms at their usual size.
        best: The best hypothesis at the end.
    """

    def __init__(
        self,
        subject: Subject,
        problem: Problem,
        candidates: Sequence[Candidate],
        progress: Progress = lambda stage, share: None,
    ) -> None:
        super().__init__(subject, coarsen(problem), len(candidates), progress)
        self.candidates, self.usual, self.fine = [*candidates], tuple(candidates), problem
        self.identifiable: dict[str, float] = {}

    def run(self) -> Self:
        """Fit the base model, then sets of candidates in rounds, then the best sets to convergence."""
        self.progress("recalibrating the base model", 0.0)
        base = self._with_likely_starts(self.from_the_prior(self.hypothesis((), None)))
        base = self._with_enough_substeps(self._with_stamp_errors(self._with_stated_noise(base)))
        self.tried = {base.key: base}
        self.problem = replace(self.problem, sensing=base.fit.noise)
        self._rescore()
        best = self.tried[base.key]
        while proposed := self._proposals(best):
            is_first = len(self.tried) == 1
            stage = "trying every effect, sensor and parameter" if is_first else "searching for further candidates"
            fitted = self.fit_all(proposed, best, stage)
            reduced: dict[Names, Trial] = {}  # without parts that have no effect
            for h in fitted:
                parts = tuple(c for c in h.candidates if h.loss_without(c, self.problem.values) > self.cost([c]))
                if parts and len(parts) < len(h.candidates):
                    reduced[key_of(parts)] = parts, {n: h.fit.values[n] for c in parts for n in c.parameters}
            self.fit_all([*reduced.values()], best, "removing candidates without effect")
            self._rescore()
            before, best = self.tried[best.key].score, best_hypothesis(self.tried.values())
            if best.score > before - DONE * self.problem.scatter:
                break
            (settled,) = self.fit_to_the_end([(best.candidates, best.fit)])
            settled = self._with_stamp_errors(settled)
            # The others, which were fitted with the previous noise, would gain about as much by the new one.
            further = best.score - settled.score
            self.tried = {n: replace(o, score=o.score - further) for n, o in self.tried.items()}
            self.tried[settled.key] = settled
            self._rescore()
            best = best_hypothesis(self.tried.values())
        self._finish(base, best)
        return self

    def _pose(self, **changes: Any) -> None:
        """Replace fields of the fitting problem."""
        self.fine, self.problem = (replace(p, **changes) for p in (self.fine, self.problem))

    def _rescore(self) -> None:
        """Update all scores for the non-white residuals of fits with trusted equations."""
        if not self.problem.trusted:
            return
        likeliest = min(self.tried.values(), key=lambda h: h.fit.nll)
        self.problem = replace(self.problem, scatter=dispersion(evidence(self, likeliest)))
        self.tried = {n: replace(o, score=o.fit.objective + self.cost(o.candidates)) for n, o in self.tried.items()}

    def _with_likely_starts(self, base: Hypothesis) -> Hypothesis:
        """Return the base model, fitted alternately with start states.

        Start states of free runs depend on the parameters: those for the given parameters may be far from those of the
        fit.
        """
        while (posed := with_likely_starts(self.problem, base.fit.values, base.fit.noise)) is not self.problem:
            self._pose(x0=posed.x0)
            before, base = base, self.hypothesis((), base.fit, loosen=False)
            if base.fit.objective > before.fit.objective - DONE:
                break
        return base

    def _with_stated_noise(self, base: Hypothesis) -> Hypothesis:
        """Fix the noise of sensors at the stated noise if the estimate is at its lower limit.

        The stated noise may include errors that these logs do not contain. A limit above the stated noise comes from
        quantisation, and is kept.
        """
        problem = self.problem
        low, stated = base.fit.noise.like(problem.limits.low).sensors, np.log(problem.r)
        silent = problem.stated & problem.adjusted & (base.fit.noise.sensors <= low + NOISE_DIFFERENCE) & (low < stated)
        if not silent.any():
            return base
        sensors = np.where(silent, stated, base.fit.noise.sensors)
        self._pose(adjusted=problem.adjusted & ~silent)
        start = replace(base.fit, noise=replace(base.fit.noise, sensors=sensors))
        return self.hypothesis((), start)

    def _with_enough_substeps(self, h: Hypothesis) -> Hypothesis:
        """Return a hypothesis, fitted with more substeps as long as the likelihood at the fit depends on them.

        With too few substeps, integration errors may imitate what the model lacks; fits therefore also start at the
        given values.
        """
        while (posed := with_finer_steps(self.problem, h.fit.values, h.fit.noise)) is not self.problem:
            self.fine, self.problem = with_finer_steps(self.fine, h.fit.values, h.fit.noise), posed
            h = best_hypothesis(self.hypothesis(h.candidates, start, loosen=False) for start in (h.fit, None))
        return h

    def _with_stamp_errors(self, h: Hypothesis) -> Hypothesis:
        """Return a hypothesis, fitted again with errors of time stamps if the innovations indicate them."""
        problem, noise = self.problem, h.fit.noise
        late = erring_stamps(problem, h.fit)
        if not late.any():
            return h
        usual = 2.0 * np.log(USUAL_STAMP * max(d.step for d in problem.logs))
        noise = replace(noise, timing=np.where(late, usual, noise.timing))
        self._pose(sensing=noise)
        start = replace(h.fit, noise=noise)
        timed = self.hypothesis(h.candidates, start, loosen=False)
        return timed if timed.fit.objective < h.fit.objective else h

    def _proposals(self, best: Hypothesis) -> list[Trial]:
        """Return untried sets of candidates with large predicted gains, and start values."""
        test = ScoreTest(self.problem, best.fit, best.candidates)
        chosen = {c.name: c for c in self.candidates if c.name in best.key}
        every = [chosen.get(c.name, c) for c in self.usual]  # other candidates begin with usual periods again
        self.candidates, periods = with_likely_periods(test, every, best.names)
        if periods:
            self._pose(values={**self.problem.values, **periods})
        self.progress("predicting the gain of every candidate", 0.0)
        terms: list[Terms] = in_parallel(test.terms, list(self.candidates))
        for t in terms:
            name = t.candidate.name
            self.identifiable[name] = max(t.identifiable, self.identifiable.get(name, 0.0))
        switched = [t for t in terms if t.switched and t.candidate.name not in best.key]
        choice = Choice(test, [t for t in terms if t not in switched], best.candidates, self.problem.values)
        named = {c.name: c for c in self.candidates}
        ranking: list[tuple[float, Trial]] = []
        for names in self._sets(choice, best):
            if frozenset(names) in self.tried:
                continue
            promise, parts = choice.promise(names), tuple(named[n] for n in names)
            dearer = self.cost(parts) - self.cost(best.candidates)
            if promise.within and (HOPE * promise.gain > dearer if dearer > 0.0 else promise.gain > dearer - self.near):
                ranking.append((dearer - promise.gain, (parts, promise.values)))
        ranking.sort(key=lambda entry: entry[0])
        whole = [] if best.candidates else [*self._complete_errors()]
        known = {key_of(parts) for parts, _ in whole}
        likely = [trial for _, trial in ranking[:FITTED] if key_of(trial[0]) not in known]
        return [*likely, *(((*best.candidates, t.candidate), None) for t in switched), *whole]

    def _complete_errors(self) -> Iterator[Trial]:
        """Yield complete sensor errors with the given parameters; near the base fit, they may have no predicted gain.

        For example, if a sensor shows only the magnitude, the base fit may follow one direction of motion.
        """
        problem = self.problem
        untried = [c for c in self.candidates if c.complete and key_of((c,)) not in self.tried]
        plain = problem.score(problem.values, problem.plain).nll if untried else 0.0
        for c in untried:
            if problem.score({**problem.values, **c.complete}, problem.plain).nll != plain:  # it has an effect
                given = {f.name: problem.values[f.name] for f in self.free((c,))}
                yield (c,), {**given, **c.complete}

    def _sets(self, choice: Choice, best: Hypothesis) -> Iterator[tuple[str, ...]]:
        """Yield sets of candidates near a hypothesis: some added, one removed, one replaced by up to two."""
        others = [name for name in choice.terms if name not in best.key]
        promises = choice.extensions(best.names)
        likely = [*promises][:FITTED]
        yield from ((*best.names, name) for name in promises if promises[name].within)
        for count in range(2, len(likely) + 1):
            yield from ((*best.names, *more) for more in combinations(likely, count))
        for part in best.names:
            if choice.terms[part].candidate.kind != "parameter":
                rest = [name for name in best.names if name != part]
                replacements = chain([()], combinations(others, 1), combinations(likely, 2))
                yield from ((*rest, *more) for more in replacements)

    def _finish(self, base: Hypothesis, best: Hypothesis) -> None:
        """Fit the best hypotheses and their neighbours to convergence, with all substeps."""
        self.progress("finishing the best fits", 0.0)
        enough = zip(self.problem.logs, coarsen(self.fine, best.fit.values).logs, self.fine.logs, strict=True)
        logs = [replace(log, substeps=max(base.substeps, other.substeps)) for base, other, log in enough]
        self.problem = replace(self.fine, logs=logs, sensing=best.fit.noise, scatter=self.problem.scatter)
        self.tried = {n: replace(h, ended=False) for n, h in self.tried.items()}
        best = self.fit_to_the_end([(h.candidates, h.fit) for h in {base.key: base, best.key: best}.values()])[-1]
        best = self._with_enough_substeps(best)
        self.tried[best.key] = best
        self._rescore()
        best = self.tried[best.key]
        # The base model may have ended in a local optimum, which candidates can leave without an effect of their own.
        from_best: list[Start] = [((), best.fit)] if best.candidates else []
        self.fit_to_the_end([*from_best, *self._beyond_special_cases(best)])
        while True:
            self._fit_neighbours()
            ended = [h for h in self.tried.values() if h.ended]
            self.best = best = best_hypothesis(ended)
            posed = with_finer_steps(self.problem, best.fit.values, best.fit.noise)
            if posed is self.problem:
                break
            self.problem = posed
            self.tried = {n: replace(h, ended=False) for n, h in self.tried.items()}
            self.fit_to_the_end([(h.candidates, h.fit) for h in ended])
        absent = [c.name for c in self.candidates if c.kind == "effect" and c.name not in best.key]
        self.hidden = tuple(n for n in absent if self.identifiable.get(n, np.inf) < float(ndtri(MISFIT)) ** 2)

    def _beyond_special_cases(self, best: Hypothesis) -> list[Start]:
        """Return sets in which a general effect replaces its special case, started from values of the latter."""
        starts = dict[Names, Start]()
        near = sorted((h for h in self.tried.values() if h.score - best.score < self.near), key=lambda h: h.score)
        for h, simple, rich in [(of, c, other) for of in near for c in of.candidates for other in self.candidates]:
            values = values_of_special_case(rich, simple, h.fit.values)
            if values and rich.name not in h.key:
                parts = (*(c for c in h.candidates if c is not simple), rich)
                free = (*h.fit.free, *rich.free)
                starts.setdefault(key_of(parts), (parts, replace(h.fit, values={**h.fit.values, **values}, free=free)))
        return [*starts.values()]

    def _fit_neighbours(self) -> None:
        """Fit sets that may be as probable as the most probable ones: without a part, with another, with one replaced.

        The posterior needs all probable sets. A score test predicts the gain; sets that would be probable are fitted to
        convergence, until no probable set is untried.
        """
        asked = set[Names]()
        for _ in range(EXPANSIONS):
            ended = {h.key: h for h in optima(self)}
            sets, kappa = posterior([evidence(self, h) for h in ended.values()], len(self.candidates))
            classes = folded(sets, ())
            ranked = [*classes]
            starts: dict[Names, Start] = {}
            mass = np.cumsum([*classes.values()])
            leading = ranked[: min(BREADTH, 1 + int(np.searchsorted(mass, CERTAIN)))]  # sets that a verdict would name
            probable = [parts for parts in leading if parts not in asked]
            asked.update(probable)
            stage = "repeating the most probable fits from other start values"
            for h in self.fit_each(stage, self.from_the_prior, [ended[parts] for parts in probable]):
                for start in self._neighbours(h, kappa):
                    starts.setdefault(key_of(start[0]), start)
            best = ended[ranked[0]]
            near = [h for h in self.tried.values() if not h.ended and h.score - best.score < FITTED_WITHIN_NATS * kappa]
            for h in sorted(near, key=lambda h: h.score)[:BREADTH]:
                starts[h.key] = h.candidates, h.fit
            untried = [s for key, s in starts.items() if not (key in self.tried and self.tried[key].ended)]
            untried += self._without_idle_parts(best.score + FITTED_WITHIN_NATS * kappa)
            untried += self._worse_than_their_parts(best.score + FITTED_WITHIN_NATS * kappa)
            if not untried:
                return
            self.fit_to_the_end(untried)

    def _without_idle_parts(self, limit: float) -> list[Start]:
        """Return sets without parts that a fit has moved to neutral, unless they have an equally good fit.

        Args:
            limit: Score above which a set is too improbable.
        """
        starts, given = dict[Names, Start](), self.problem.values
        for h in self.tried.values():
            moved = {f.name for c in h.candidates for f in c.free if f.neutral is not None or c.kind == "parameter"}
            moved = {name for name in moved if h.fit.values[name] != given[name]}
            acting = tuple(c for c in h.candidates if moved.intersection(c.parameters))
            known = self.tried.get(key_of(acting))
            least = h.fit.objective + CONVERGED_GAIN * self.problem.scatter
            if h.ended and least + self.cost(acting) < limit and not (known and known.fit.objective <= least):
                starts[key_of(acting)] = acting, h.fit
        return [*starts.values()]

    def _worse_than_their_parts(self, limit: float) -> Iterator[Start]:
        """Yield the sets whose fit is worse than a later fit of a subset.

        Args:
            limit: Score above which a set is too improbable.
        """
        reached = {h.key for h in optima(self)}
        for h in self.tried.values():
            if h.ended and h.key not in reached:
                within = [o.fit.objective for o in self.tried.values() if o.ended and o.key < h.key]
                if min(within) + self.cost(h.candidates) < limit:
                    yield h.candidates, h.fit

    def _neighbours(self, h: Hypothesis, kappa: float) -> Iterator[Start]:
        """Yield sets near a hypothesis with starts of their fits."""
        for part in h.candidates:
            rest = tuple(c for c in h.candidates if c is not part)
            yield rest, h.fit
            without = self.tried.get(key_of(rest)) or self.hypothesis(rest, h.fit, screen=True)
            others = [c for c in self.candidates if c.name not in h.key and c.kind != "parameter"]
            for c, promise in self._promises(without, others)[:BREADTH]:
                yield (*rest, c), replace(without.fit, values={**without.fit.values, **promise.values})
        others = [c for c in self.candidates if c.name not in h.key]
        if not others:
            return
        count, size = len(self.candidates), len(h.candidates)
        odds = log_prior(size + 1, count) - log_prior(size, count)
        for c, promise in self._promises(h, others)[:BREADTH]:
            if HOPE * promise.gain / kappa + odds > math.log(POSSIBLE):
                yield (*h.candidates, c), replace(h.fit, values={**h.fit.values, **promise.values})

    def _promises(self, h: Hypothesis, others: Sequence[Candidate]) -> list[tuple[Candidate, Promise]]:
        """Return the predicted result of adding each of some candidates to a hypothesis, best first."""
        test = ScoreTest(self.problem, h.fit, h.candidates)
        terms = [t for t in in_parallel(test.terms, others) if not t.switched]
        promises = Choice(test, terms, (), self.problem.values).extensions(())
        named = {c.name: c for c in others}
        return [(named[name], promise) for name, promise in promises.items()]


# Comparison of fits with free unknown inputs and fits with trusted equations (without unknown inputs).
#
# A free unknown input absorbs every one-step prediction error, for example due to an input that is not held between
# rows or to an unmodelled fast mode. The parameters then fit the next row, and slow effects, which are visible over the
# model's own horizon, have little weight. If the best hypothesis or the base model predicts clearly better without
# unknown inputs, the search is repeated without them. Parts that only the repeated search finds were chosen on all
# logs, so they do not count in this comparison. The residuals are then not white: the cost of every candidate is scaled
# by the dispersion of the likelihood. Likelihoods of both kinds of fits are not comparable; predictions of held-out
# logs are, and decide.


def attribute(subject: Subject, problem: Problem, candidates: Sequence[Candidate], progress: Progress) -> Attributor:
    """Return the search with or without unknown inputs.

    Equations are trusted if this makes open-loop predictions of held-out logs clearly better.
    """

    def error(search: Search, h: Hypothesis) -> float:
        return float(np.mean(held_out_errors(search, h, h.fit)))

    free = Attributor(subject, problem, candidates, progress).run()
    if not any(gain > problem.price for gain in noise_gains(free.problem, free.best.fit)):
        return free
    progress("predicting without process noise", 0.0)
    given = {h.key: (h, error(free, h)) for h in (free.tried[frozenset()], free.best)}
    trusted = with_equations_trusted(subject, problem)
    search = Search(subject, coarsen(trusted), len(candidates), progress)
    if all(error(search, search.hypothesis(h.candidates, h.fit)) > least - CLEARLY for h, least in given.values()):
        return free
    other = Attributor(subject, trusted, candidates, progress).run()
    other.free_noise = free.best.fit.noise
    return other if error(other, other.best) < given[free.best.key][1] - CLEARLY else free
