"""Which effect is missing: fit every hypothesis with process noise free, compare, claim or abstain.

The base fit first; then every candidate alone; then the best one with every other, and the best few in pairs, for one
of two missing effects alone can fit with the wrong sign. A hypothesis is scored by its objective + ½·k·ln N (half of
BIC). What is left is then tried against terms of no catalogue (`unnamed`): where one of them is significant, the
catalogue does not hold the answer.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from cosim.refinement.candidates import Candidate, Free, base_parameters
from cosim.refinement.fit import FAIR, PROMISE, Fit, fit
from cosim.refinement.hypotheses import NOISE, Attribution, Hypothesis
from cosim.refinement.problem import Problem, coarsened, halved
from cosim.refinement.screen import ScoreTest
from cosim.refinement.sensor_noise import at_rest
from plant.model import Model

CLAIM = 6.0  # score a hypothesis must gain on the one it extends
CLAIM_IN_NOISE = 15.0  # the same where process noise is at work: it is seldom as white as the filter takes it to be
SHARE = 0.02  # of what the first effects gain, that one more must gain too
RIVAL = 5.0  # score within which another hypothesis explains as well
SIGNIFICANT = 3.0  # standard deviations from neutral
SIGNIFICANT_IN_NOISE = 15.0  # the same where process noise is left: intervals that take it for white are too narrow
NEAR = 15.0  # score within which a hypothesis is fitted to the end before it is decided
SCREEN_ITERATIONS = 12
TO_THE_END = 60  # iterations within which every fit seen has converged
MOST_EFFECTS = 3
PAIRS_AMONG = 4


class Attributor:
    """Fits hypotheses on one problem."""

    def __init__(
        self,
        model: Model,
        problem: Problem,
        candidates: Sequence[Candidate],
        progress: Callable[[str, float], None] | None = None,
    ) -> None:
        self.model, self.candidates = model, candidates
        self.fine, self.problem = problem, coarsened(problem)
        self.progress = progress or (lambda stage, share: None)
        self.price = 0.5 * np.log(max(2, problem.samples))
        self.tried: dict[tuple[str, ...], Hypothesis] = {}
        self.told: dict[str, float] = {}
        self.drowned: set[tuple[str, ...]] = set()
        self.claim = CLAIM
        self.reached = np.inf  # objective of the base model, recalibrated

    def run(self) -> Attribution:
        """Base fit, singles, extensions, rivals."""
        self.progress("recalibrating the base model", 0.0)
        base = self.hypothesis((), None)
        self.reached = base.fit.objective
        self.claim = CLAIM_IN_NOISE if any(self.noisy(base.fit)) else CLAIM
        singles = self._fit_all([(c,) for c in self.candidates], base, "trying every effect, sensor and parameter")
        best = self._better(singles, base, alone=False)
        if best is not base:
            best = self._extend(best, singles, base)
        self.problem = self.fine
        self.progress("fitting the best to the end", 0.0)
        base, best = self._decide(base, best)
        ranking = tuple(sorted(self.tried.values(), key=lambda h: h.score))
        rivals, reasons = self._rivals(best, base), self._reasons(best, base)
        held_out, noise_gain = self.held_out(best, base), self.noise_gain(best.fit)
        return Attribution(base, ranking, best, rivals, held_out, noise_gain, reasons, self.hidden(best is base))

    def hypothesis(
        self,
        parts: tuple[Candidate, ...],
        start: Fit | None,
        only: Sequence[int] | None = None,
        iterations: int = 30,
        goal: float = np.inf,
        loosen: bool = True,
    ) -> Hypothesis:
        """Fit some candidates together, from each of their starts; base parameters on trial lose their prior.

        With `loosen`, the process noise starts no lower than where it is plain enough to move.
        """
        free = self.free(parts)
        # of the start only what this fit may move: the parts of another hypothesis go back to neutral
        moved = {f.name for f in start.free} & {f.name for f in free} if start is not None else set()
        known = {**self.problem.values, **{name: start.values[name] for name in moved if start is not None}}
        log_q = start.log_q if start is not None else self.problem.noise.plain
        if loosen:
            log_q = np.maximum(log_q, self.problem.noise.quiet)
        fits = []
        for k in range(max([1, *(len(c.starts) for c in parts)])):
            values = dict(known)
            for c in parts:
                if not set(c.parameters) <= moved:
                    values |= c.starts[min(k, len(c.starts) - 1)]
            fair = 1 if values == known else FAIR
            fits.append(fit(self.problem, free, values, log_q, only, iterations, goal, fair, self._reached(parts)))
        best = min(fits, key=lambda f: f.objective)
        return Hypothesis(parts, best, best.objective + self.price * sum(len(c.free) for c in parts))

    def _reached(self, parts: tuple[Candidate, ...]) -> float:
        """Objective that some of the parts reach without the others: all together can do no worse when fitted."""
        names = {c.name for c in parts}
        fitted = (h.fit.objective for h in self.tried.values() if h.fit.iterations and names.issuperset(h.names))
        return min(fitted, default=self.reached)

    def free(self, parts: tuple[Candidate, ...]) -> list[Free]:
        """What a fit of these candidates may move."""
        own = [f for c in parts for f in c.free]
        loose = {f.name for f in own}
        return [b for b in base_parameters(self.model, self.problem.values) if b.name not in loose] + own

    def _decide(self, base: Hypothesis, best: Hypothesis) -> tuple[Hypothesis, Hypothesis]:
        """Base, best and what comes near it, fitted to the end at the model's own substeps; base and best of these."""
        again = self.hypothesis((), base.fit, iterations=TO_THE_END, loosen=False)
        if best is base:
            return again, again
        near = [h for h in self.tried.values() if h.score - best.score < NEAR]
        with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
            fitted = list(
                pool.map(lambda h: self.hypothesis(h.candidates, h.fit, iterations=TO_THE_END, loosen=False), near)
            )
        self.tried |= {h.names: h for h in fitted}
        return again, self._better([h for h in fitted if len(h.candidates) == len(best.candidates)], again)

    def noisy(self, f: Fit) -> tuple[bool, ...]:
        """Of each forced equation, whether a fit needs its process noise."""
        return tuple(gain > NOISE for gain in self.noise_gain(f))

    def noise_gain(self, f: Fit) -> tuple[float, ...]:
        """Log-likelihood that the process noise of each forced equation gains in a fit."""
        without = np.diag(self.problem.noise.smallest - f.log_q) + f.log_q
        return tuple(self.problem.scored(f.values, log_q).nll - f.nll for log_q in without)

    def strained(self, f: Fit) -> bool:
        """Some base parameter is pulled from its data sheet by more than its prior can be asked for."""
        return any(0.5 * ((f.values[x.name] - x.prior[0]) / x.prior[1]) ** 2 > self.claim for x in f.free if x.prior)

    def hidden(self, nothing_found: bool) -> tuple[str, ...]:
        """Effects of which no parameter, at its usual size, would be told from neutral; at rest all, if none was."""
        effects = [c.name for c in self.candidates if c.kind == "effect"]
        if nothing_found and at_rest(self.problem):
            return tuple(effects)
        return tuple(name for name in effects if self.told.get(name, np.inf) < SIGNIFICANT**2)

    def held_out(self, h: Hypothesis, base: Hypothesis) -> float:
        """Objective gained over the base on each log, with what is claimed as the others have it; of one log, halves.

        What is not claimed, base parameters and process noise, settles on the log itself, for both alike: logs that
        excite little leave it open, and one that excites much would refuse what they guessed. Of the base, parameters
        that the hypothesis calls wrong stay as the model has them.
        """
        if h is base:
            return 0.0
        problem = self.problem if len(self.problem.logs) > 1 else halved(self.problem)
        names = [f.name for c in h.candidates for f in c.free]
        settling = [f for f in self.free(()) if f.name not in names]
        neutral = {name: self.problem.values[name] for name in names}
        count = len(problem.logs)
        gained = 0.0
        for left_out in range(count):
            others = [k for k in range(count) if k != left_out]
            learnt = fit(problem, self.free(h.candidates), h.fit.values, h.fit.log_q, others, SCREEN_ITERATIONS)
            claimed = {name: learnt.values[name] for name in names}
            without, with_it = (
                fit(problem, settling, {**f.values, **stays}, f.log_q, [left_out], SCREEN_ITERATIONS).objective
                for f, stays in ((base.fit, neutral), (h.fit, claimed))
            )
            gained += without - with_it
        return gained

    # -- within -------------------------------------------------------------------------------

    def _fit_all(
        self, sets: Iterable[tuple[Candidate, ...]], start: Hypothesis, stage: str, gain: float | None = None
    ) -> list[Hypothesis]:
        """Fit sets of candidates side by side; not those of which a score test or the first steps promise nothing."""
        needed = self.claim if gain is None else gain
        todo = [s for s in sets if tuple(sorted(c.name for c in s)) not in self.tried]
        done: list[Hypothesis] = []
        self.progress(stage, 0.0)

        def one(parts: tuple[Candidate, ...]) -> Hypothesis:
            goal = start.score - needed - self.price * sum(len(c.free) for c in parts)
            h = self._screened(parts, start, test, needed)
            if h is None:
                h = self.hypothesis(parts, start.fit, iterations=SCREEN_ITERATIONS, goal=goal)
            done.append(h)
            self.progress(stage, len(done) / len(todo))
            return h

        test = ScoreTest(self.problem, start.fit)
        with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
            found = list(pool.map(one, todo))
        self.tried |= {h.names: h for h in found}
        return found

    def _screened(
        self, parts: tuple[Candidate, ...], start: Hypothesis, test: ScoreTest, needed: float
    ) -> Hypothesis | None:
        """A hypothesis as its score test has it, where that leaves no hope; None for one that must be fitted."""
        added = [c for c in parts if c.name not in start.names]
        if len(added) != 1 or len(parts) != len(start.candidates) + 1 or added[0].kind == "parameter":
            return None
        (c,) = added
        promise = test.promise(c)
        if promise is None:
            return None
        self.told[c.name] = max(promise.told, self.told.get(c.name, 0.0))
        price = self.price * len(c.free)
        if PROMISE * promise.gain > needed + price:
            return None
        first, *rest = start.fit.nll_by_log
        values = {**start.fit.values, **promise.values}
        promised = replace(start.fit, values=values, nll_by_log=(first - promise.gain, *rest), iterations=0)
        return Hypothesis(parts, promised, start.score - promise.gain + price)

    def _better(
        self, options: Sequence[Hypothesis], than: Hypothesis, gain: float | None = None, *, alone: bool = True
    ) -> Hypothesis:
        """The best option that gains enough and is significant in each of its parts; else `than`.

        One that leaves process noise must stand out from it, unless it is not `alone`: what it leaves may be another's.
        """
        for h in sorted(options, key=lambda h: h.score):
            if than.score - h.score < (self.claim if gain is None else gain):
                break
            least = SIGNIFICANT_IN_NOISE if alone and any(self.noisy(h.fit)) else SIGNIFICANT
            if all(self.significant(h, c, least) for c in h.candidates):
                return h
            if all(self.significant(h, c) for c in h.candidates):
                self.drowned.add(h.names)
        return than

    def significant(self, h: Hypothesis, c: Candidate, least: float = SIGNIFICANT) -> bool:
        """Away from neutral by Wald's test of all its parameters together, and none of them at a limit."""
        neutral = self.problem.values
        away = np.array([h.fit.values[f.name] - neutral[f.name] for f in c.free])
        pinned = any(self._at_limit(h, f) for f in c.free)
        return not pinned and bool(away @ h.fit.marginal(c.parameters) @ away > least**2)

    def _extend(self, best: Hypothesis, singles: Sequence[Hypothesis], base: Hypothesis) -> Hypothesis:
        """Add candidates while one gains enough; pairs of the best few singles compete with the first extension."""
        promising = [h for h in sorted(singles, key=lambda h: h.score) if base.score - h.score > self.claim]
        top = [h.candidates[0] for h in promising[:PAIRS_AMONG]]
        while len(best.candidates) < MOST_EFFECTS:
            # what is wrong with a sensor too leaves no process noise: it is looked for where all else is settled
            settled = not (any(self.noisy(best.fit)) or self.strained(best.fit))
            if settled and not best.candidates:
                return best
            beside = [c for c in self.candidates if c.name not in best.names and (c.kind == "sensor" or not settled)]
            sets = [(*best.candidates, c) for c in beside]
            if len(best.candidates) == 1 and not settled:
                sets += [(a, b) for i, a in enumerate(top) for b in top[i + 1 :] if best.candidates[0] not in (a, b)]
            # under a coloured disturbance a small second effect is soon imagined: it must be worth some of the first
            gain = self.claim + SHARE * (base.score - best.score)
            options = self._fit_all(sets, best, f"looking for what is missing beside {' and '.join(best.names)}", gain)
            wider = self._better(options, best, gain)
            if wider is best:
                return best
            best = wider
        return best

    def _rivals(self, best: Hypothesis, base: Hypothesis) -> tuple[Hypothesis, ...]:
        """Other hypotheses of no more candidates that explain as well."""
        if best is base:
            return ()
        return tuple(
            h
            for h in sorted(self.tried.values(), key=lambda h: h.score)
            if h.names != best.names and len(h.candidates) <= len(best.candidates) and h.score - best.score < RIVAL
        )

    def _reasons(self, best: Hypothesis, base: Hypothesis) -> dict[tuple[str, ...], str]:
        """Why each hypothesis but the best is not the answer, in words."""
        return {names: self._reason(h, best, base) for names, h in self.tried.items() if names != best.names}

    def _reason(self, h: Hypothesis, best: Hypothesis, base: Hypothesis) -> str:
        gained, behind = base.score - h.score, h.score - best.score
        than = " and ".join(best.names) or "the base model"
        if best is not base and abs(behind) < RIVAL and len(h.candidates) <= len(best.candidates):
            return f"a rival: explains as well as {than}, within {RIVAL:.0f}"
        if gained < self.claim:
            return (
                f"gains {gained:.1f}, less than the {self.claim:.0f} that a candidate must" if gained > 0 else "no gain"
            )
        if h.fit.iterations == 0:
            return f"explains less than {than} by {behind:.1f}, by its score test"
        if limits := [f.name for c in h.candidates for f in c.free if self._at_limit(h, f)]:
            return f"{limits[0]} is at its limit"
        if not all(self.significant(h, c) for c in h.candidates):
            return "not significantly away from neutral"
        if h.names in self.drowned:
            return f"less than {SIGNIFICANT_IN_NOISE:.0f} standard deviations from neutral, and process noise is left"
        if behind < 0.0:
            return f"gains {-behind:.1f} on {than}, less than an added effect must"
        return f"explains less than {than} by {behind:.1f}"

    def _at_limit(self, h: Hypothesis, f: Free) -> bool:
        """Moved, and as far as it may; to neutral is where an effect that the model has too much of belongs."""
        value = h.fit.values[f.name]
        return value in (f.low, f.high) and value not in (self.problem.values[f.name], f.neutral)
