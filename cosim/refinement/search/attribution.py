"""Which effects are missing: what any set of candidates promises, the most promising fitted, the best of all kept.

The base fit first. About the best hypothesis so far, a score test says for one filter run a parameter what every set of
candidates would gain: one more, two more, one in place of another, one less. The most promising sets are fitted; what a
fit brings to neutral is left out, and the rest fitted again; about the best, all begins anew, until nothing promises
more. So one of several missing effects that alone fits with a wrong sign, or in place of another, is put right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cosim.estimation.parallel import in_parallel
from cosim.estimation.posing import coarsened
from cosim.estimation.problem import Problem
from cosim.estimation.screen import Choice, ScoreTest, Terms
from cosim.estimation.sensor_noise import stamps_err
from cosim.refinement.decision.evidence import scatter
from cosim.refinement.decision.judgement import SIGNIFICANT, loss_without
from cosim.refinement.search.fits import SCREEN_ITERATIONS, Found, Progress, Search, Trial, key_of
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

FITTED = 6  # sets a round
AMONG = 10  # candidates, the most promising, of which pairs and more are put together
TOGETHER = 4  # at most at once, about the base model
NEAR = 12.0  # of score within which a set is worth a fit, and a hypothesis is fitted to the end
DONE = 1.0  # of score, below which a round has found nothing better
ROUNDS = 10
HOPE = 2.0  # times what a score test promises, that a fit may bring
SETTLING = 15  # iterations
MOST_REPLACED, REPLACING = 6, 2  # parts of a hypothesis that are replaced in turn, and candidates in place of each
SILENT = 0.1  # of ln of a variance above the least that a sensor's can be
USUAL_STAMP = 0.05  # of a row, by which stamps err where they do: from there a fit goes on
MOST_ENLARGED = 2
FINALISTS = 4  # hypotheses beside the best that are fitted to the end


class Attributor:
    """The order of the steps: base, rounds of promising sets, the best to the end."""

    def __init__(
        self,
        subject: Subject,
        problem: Problem,
        candidates: Sequence[Candidate],
        progress: Progress = lambda stage, share: None,
    ) -> None:
        self.candidates, self.progress = candidates, progress
        self.fine = problem
        self.search = Search(subject, coarsened(problem), len(candidates), progress)
        self.identifiable: dict[str, float] = {}

    def run(self) -> Found:
        """Base fit, rounds, finalists."""
        search = self.search
        self.progress("recalibrating the base model", 0.0)
        base = self._timed(self._heard(search.hypothesis((), None)))
        search.tried[()] = base
        search.reached = base.fit.objective
        search.problem = replace(search.problem, sensing=base.fit.noise)
        best, idle = self._scattered(base), 0
        for number in range(ROUNDS):
            proposed = self._proposed(best)
            if not proposed:
                break
            stage = "trying every effect, sensor and parameter" if number == 0 else "looking for what is missing beside"
            fitted = search.fit_all(proposed, best, stage, NEAR)
            reduced = search.fit_all(self._reduced(fitted), best, "leaving out what does nothing", NEAR)
            before, best = best.score, min((best, *fitted, *reduced), key=lambda h: h.score)
            if best.score > before - DONE:
                idle += 1
                if idle > 1:
                    break
            else:
                idle = 0
                best = self._leading(self._settled(best))
        return self._decided(base, best)

    def _settled(self, h: Hypothesis) -> Hypothesis:
        """The best with noise of its own; what was fitted beside it with that of the last is taken to gain as much."""
        search = self.search
        (settled,) = search.fit_again([h], SETTLING)
        settled = self._timed(settled)
        further = h.score - settled.score
        search.tried = {n: replace(o, score=o.score - further) for n, o in search.tried.items()}
        search.tried[settled.names] = settled
        return self._scattered(settled)

    def _scattered(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis, and what candidates cost beside it where equations are trusted: what is left is not white."""
        search = self.search
        if not search.problem.trusted:
            return h
        search.problem = replace(search.problem, scatter=scatter(search.problem, h.fit))
        search.tried = {
            n: replace(o, score=o.fit.objective + search.cost(o.candidates)) for n, o in search.tried.items()
        }
        return replace(h, score=h.fit.objective + search.cost(h.candidates))

    def _leading(self, best: Hypothesis) -> Hypothesis:
        """The best, or what has been tried and leads now that candidates cost otherwise."""
        return min((best, *self.search.tried.values()), key=lambda h: h.score) if self.search.problem.trusted else best

    def _heard(self, base: Hypothesis) -> Hypothesis:
        """The base fit; with the stated noise of sensors in which the logs show next to none: it may stand for more."""
        search, problem = self.search, self.search.problem
        low = base.fit.noise.like(problem.limits.low).sensors
        silent = problem.stated & problem.adjusted & (base.fit.noise.sensors <= low + SILENT)
        if not silent.any():
            return base
        sensors = np.where(silent, np.log(problem.r), base.fit.noise.sensors)
        adjusted = problem.adjusted & ~silent
        self.fine, search.problem = (replace(p, adjusted=adjusted) for p in (self.fine, problem))
        start = replace(base.fit, noise=replace(base.fit.noise, sensors=sensors))
        return search.hypothesis((), start)

    def _timed(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis, fitted with stamps that err where innovations are larger the faster readings change."""
        search = self.search
        problem, noise = search.problem, h.fit.noise
        late = stamps_err(problem, h.fit)
        if not late.any():
            return h
        usual = 2.0 * np.log(USUAL_STAMP * max(d.step for d in problem.logs))
        noise = replace(noise, timing=np.where(late, usual, noise.timing))
        self.fine, search.problem = (replace(p, sensing=noise) for p in (self.fine, problem))
        start = replace(h.fit, noise=noise)
        timed = search.hypothesis(h.candidates, start, loosen=False)
        return timed if timed.fit.objective < h.fit.objective else h

    def _proposed(self, best: Hypothesis) -> list[Trial]:
        """The sets that promise most about a hypothesis, not tried yet, each with where its fit should start."""
        search, parts = self.search, {c.name: c for c in self.candidates}
        test = ScoreTest(search.problem, best.fit, best.candidates)
        self.progress("asking what every candidate promises", 0.0)
        terms: list[Terms] = in_parallel(test.terms, list(self.candidates))
        for t in terms:
            name = t.candidate.name
            self.identifiable[name] = max(t.identifiable, self.identifiable.get(name, 0.0))
        grown = [t for t in terms if not t.switched or t.candidate.name in best.names]
        choice = Choice(test, grown, best.candidates, search.problem.values)
        ranked: list[tuple[float, tuple[str, ...], Mapping[str, float]]] = []
        for names in self._sets(choice, best):
            if tuple(sorted(names)) in search.tried:
                continue
            promise = choice.promise(names)
            dearer = search.cost([parts[n] for n in names]) - search.cost(best.candidates)
            worth = HOPE * promise.gain > dearer if dearer > 0.0 else promise.gain > dearer - NEAR
            if promise.within and worth:
                ranked.append((best.score - promise.gain + dearer, names, promise.values))
        ranked.sort(key=lambda one: one[0])
        chosen = ranked[:FITTED]
        proposed: list[Trial] = [(tuple(parts[n] for n in names), values) for _, names, values in chosen]
        switched = [t.candidate for t in terms if t.switched and t.candidate.name not in best.names]
        proposed += [((*best.candidates, c), None) for c in switched]
        return proposed

    def _sets(self, choice: Choice, best: Hypothesis) -> Iterator[tuple[str, ...]]:
        """Sets near a hypothesis: with one or two more, with one in place of another, with one less."""
        standing = list(best.names)
        others = [name for name in choice.terms if name not in standing]
        gains = {name: choice.promise([*standing, name]) for name in others}
        first = sorted((n for n in others if gains[n].within), key=lambda n: -gains[n].gain)
        alone = sorted(others, key=lambda n: -gains[n].gain)[:AMONG]
        yield from ((*standing, name) for name in first)
        for count in range(2, TOGETHER + 1 if not standing else 3):
            yield from ((*standing, *more) for more in combinations(alone, count))
        for gone in standing:
            if choice.terms[gone].candidate.kind == "parameter":
                continue
            left = [name for name in standing if name != gone]
            yield tuple(left)
            yield from ((*left, name) for name in others)
            yield from ((*left, *more) for more in combinations(alone[: AMONG // 2], 2))

    def _reduced(self, fitted: Sequence[Hypothesis]) -> list[Trial]:
        """Of each fit, what is left without the parts that gain less than they cost."""
        sets: dict[tuple[str, ...], Trial] = {}
        for h in fitted:
            neutral = self.search.problem.values
            kept = tuple(c for c in h.candidates if loss_without(h, c, neutral) > self.search.cost([c]))
            if kept and len(kept) < len(h.candidates):
                sets[key_of(kept)] = kept, {n: h.fit.values[n] for c in kept for n in c.parameters}
        return list(sets.values())

    def _decided(self, base: Hypothesis, best: Hypothesis) -> Found:
        """Base, best and what comes near it, fitted to the end at the model's own substeps; base and best of these."""
        search = self.search
        self.progress("fitting the best to the end", 0.0)
        search.problem = replace(self._fine_enough(best), sensing=best.fit.noise, scatter=search.problem.scatter)
        (again,) = search.fit_again([base], only=True) if best.candidates else [base]
        (best,) = search.fit_again([best])
        again, best = again if best.candidates else best, self._scattered(best)
        if (leading := self._leading(best)) is not best:
            best = min((best, *search.fit_again([leading])), key=lambda h: h.score)
        best = self._replaced(self._enlarged(best))
        search.reached = again.fit.objective
        for _ in range(2):  # one that comes out best has rivals of its own
            beside = [h for h in self._beside(best) if not h.ended]
            fitted = search.fit_alike([h for h in beside if h.names], best)
            before, best = best, min((again, best, *fitted), key=lambda h: h.score)
            if best is before:
                break
        shown = self.identifiable
        effects = [c.name for c in self.candidates if c.kind == "effect"]
        hidden = [n for n in effects if n not in best.names and shown.get(n, np.inf) < SIGNIFICANT**2]
        return Found(search, best, tuple(hidden), tuple(self.candidates))

    def _enlarged(self, best: Hypothesis) -> Hypothesis:
        """The best, or one that has more.

        Beside unknown inputs that last as those of the best do, another effect that lasts gains little.
        """
        tried = sorted(self.search.tried.values(), key=lambda h: h.score)
        larger = [h for h in tried if set(h.names) > set(best.names) and h.score - best.score < NEAR]
        return min((best, *self.search.fit_again(larger[:MOST_ENLARGED])), key=lambda h: h.score)

    def _fine_enough(self, best: Hypothesis) -> Problem:
        """The problem with substeps that are fine enough for the base model and for the best."""
        enough = zip(self.search.problem.logs, coarsened(self.fine, best.fit.values).logs, strict=True)
        substeps = [max(base.substeps, other.substeps) for base, other in enough]
        logs = [replace(log, substeps=n) for log, n in zip(self.fine.logs, substeps, strict=True)]
        return replace(self.fine, logs=logs)

    def _replaced(self, best: Hypothesis) -> Hypothesis:
        """The best, or one with another candidate in place of one of its parts, asked for where the part is left out.

        From far away a score test misjudges what a simpler candidate would do in place of a richer one.
        """
        search, sets = self.search, dict[tuple[str, ...], Trial]()
        for gone in best.candidates if len(best.candidates) <= MOST_REPLACED else ():
            left = tuple(c for c in best.candidates if c is not gone)
            without = search.hypothesis(left, best.fit, SCREEN_ITERATIONS, sensing=False)
            test = ScoreTest(search.problem, without.fit)
            others = [c for c in self.candidates if c.name not in best.names and c.kind != "parameter"]
            terms = [t for t in in_parallel(test.terms, others) if not t.switched]
            choice = Choice(test, terms, (), search.problem.values)
            promises = {t.candidate.name: choice.promise([t.candidate.name]) for t in terms if len(t.rows)}
            likely = sorted((n for n, p in promises.items() if p.within), key=lambda n: -promises[n].gain)[:REPLACING]
            for c in (c for c in others if c.name in likely):
                sets[key_of((*left, c))] = (*left, c), {**without.fit.values, **promises[c.name].values}
        ended: list[Hypothesis] = []
        if any(c.kind == "parameter" for c in best.candidates):
            # along what it shares with a base parameter a fit is slow: one that was left halfway goes on
            base = search.tried[()].score
            halfway = [h for k in sets if (h := search.tried.get(k)) and not h.ended]
            ended = search.fit_again([h for h in halfway if h.score - best.score < base - h.score])
        fitted = search.fit_all(
            [s for k, s in sets.items() if k not in search.tried], best, "replacing each part", NEAR
        )
        if not (nearer := [h for h in (*ended, *fitted) if h.score < best.score]):
            return best
        return min((best, *search.fit_again([min(nearer, key=lambda h: h.score)])), key=lambda h: h.score)

    def _beside(self, best: Hypothesis) -> list[Hypothesis]:
        """What comes near the best and is not more, or less, of the same."""
        names = set(best.names)
        near = [h for h in self.search.tried.values() if h.score - best.score < NEAR]
        other = [h for h in near if not (set(h.names) >= names or set(h.names) <= names)]
        return sorted(other, key=lambda h: h.score)[:FINALISTS]
