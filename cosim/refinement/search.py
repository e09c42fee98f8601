"""Fits sets of candidates on one problem, side by side, and keeps every hypothesis that was tried.

A set is fitted only where a score test, and then the first steps of its fit, promise enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from cosim.refinement.candidates import Candidate, Free, base_parameters
from cosim.refinement.fit import FAIR, PROMISE, Fit, fit
from cosim.refinement.hypotheses import Hypothesis
from cosim.refinement.parallel import in_parallel
from cosim.refinement.problem import Problem
from cosim.refinement.screen import ScoreTest
from plant.model import Model

SCREEN_ITERATIONS = 12

Parts = tuple[Candidate, ...]
Progress = Callable[[str, float], None]


class Search:
    """Hypotheses on one problem.

    price:        score that each parameter of a candidate costs: ½·ln N
    tried:        names → hypothesis
    identifiable: candidate → largest χ² by which one of its parameters, at its usual size, differs from neutral
    reached:      objective of the base model, recalibrated; below it, every hypothesis comes when it is fitted
    """

    def __init__(self, model: Model, problem: Problem, progress: Progress) -> None:
        self.model, self.problem, self.progress = model, problem, progress
        self.price = 0.5 * np.log(max(2, problem.samples))
        self.tried: dict[tuple[str, ...], Hypothesis] = {}
        self.identifiable: dict[str, float] = {}
        self.reached = np.inf

    def hypothesis(
        self, parts: Parts, start: Fit | None, iterations: int = 30, goal: float = np.inf, *, loosen: bool = True
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
            fits.append(fit(self.problem, free, values, log_q, None, iterations, goal, fair, self._reached(parts)))
        best = min(fits, key=lambda f: f.objective)
        return Hypothesis(parts, best, best.objective + self._price(parts))

    def free(self, parts: Parts) -> list[Free]:
        """What a fit of these candidates may move."""
        own = [f for c in parts for f in c.free]
        on_trial = {f.name for f in own}
        return [b for b in base_parameters(self.model, self.problem.values) if b.name not in on_trial] + own

    def fit_all(self, sets: Iterable[Parts], start: Hypothesis, stage: str, needed: float) -> list[Hypothesis]:
        """Fit sets of candidates that extend `start`, where they promise to gain what is needed."""
        todo = [s for s in sets if tuple(sorted(c.name for c in s)) not in self.tried]
        done: list[Hypothesis] = []
        self.progress(stage, 0.0)
        test = ScoreTest(self.problem, start.fit)

        def one(parts: Parts) -> Hypothesis:
            h = self._screened(parts, start, test, needed)
            if h is None:
                goal = start.score - needed - self._price(parts)
                h = self.hypothesis(parts, start.fit, SCREEN_ITERATIONS, goal)
            done.append(h)
            self.progress(stage, len(done) / len(todo))
            return h

        fitted = in_parallel(one, todo)
        self.tried |= {h.names: h for h in fitted}
        return fitted

    def fit_again(self, hypotheses: Sequence[Hypothesis], iterations: int) -> list[Hypothesis]:
        """Fit hypotheses further, from where they are."""
        fitted = in_parallel(lambda h: self.hypothesis(h.candidates, h.fit, iterations, loosen=False), hypotheses)
        self.tried |= {h.names: h for h in fitted}
        return fitted

    def _price(self, parts: Parts) -> float:
        return float(self.price * sum(len(c.free) for c in parts))

    def _reached(self, parts: Parts) -> float:
        """Objective that some of the parts reach without the others: all together can do no worse when fitted."""
        names = {c.name for c in parts}
        fitted = (h.fit.objective for h in self.tried.values() if h.fit.iterations and names.issuperset(h.names))
        return min(fitted, default=self.reached)

    def _screened(self, parts: Parts, start: Hypothesis, test: ScoreTest, needed: float) -> Hypothesis | None:
        """A hypothesis as its score test has it, where that leaves no hope; None for one that must be fitted."""
        added = [c for c in parts if c.name not in start.names]
        if len(added) != 1 or len(parts) != len(start.candidates) + 1 or added[0].kind == "parameter":
            return None
        (c,) = added
        promise = test.promise(c)
        if promise is None:
            return None
        self.identifiable[c.name] = max(promise.identifiable, self.identifiable.get(c.name, 0.0))
        price = self._price((c,))
        if PROMISE * promise.gain > needed + price:
            return None
        first, *rest = start.fit.nll_by_log
        values = {**start.fit.values, **promise.values}
        promised = replace(start.fit, values=values, nll_by_log=(first - promise.gain, *rest), iterations=0)
        return Hypothesis(parts, promised, start.score - promise.gain + price)
