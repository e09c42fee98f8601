"""Parallel fits of candidate sets on one problem, with a record of every hypothesis.

The score of a set, which guides the search, approximates −ln of its posterior: the objective of its fit, plus ½·ln N
for each parameter (half of BIC), minus the logarithm of the prior for this number of parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from operator import attrgetter
from typing import TypeVar

import numpy as np

from cosim.core.arrays import NamedValues
from cosim.estimation.fit import CONVERGED_GAIN, MAX_ITERATIONS, Fit, fit, initial_fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.posing import fit_growing
from cosim.estimation.problem import Noise, Problem
from cosim.estimation.subject.candidates import Candidate, Free, base_parameters
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.posterior import MIXTURE, Evidence, Names, log_prior
from cosim.refinement.stages import report_ranking

SCREEN_ITERATIONS = 12
HOPE = 2.0  # factor by which a fit may exceed the gain that a score test predicts
FITTED_WITHIN_NATS = 10.0  # nats from the best within which a set is worth a fit, and a hypothesis is fitted to the end
PRIOR_DRAWS = 4  # draws of the prior from which a probable hypothesis is fitted again
HALVINGS = 2  # of promised sizes, until the logs are no less likely

TOGETHER = " + "  # separator between the names of a rival with several candidates

Parts = tuple[Candidate, ...]
Trial = tuple[Parts, NamedValues | None]  # candidates and start values of their fit
Progress = Callable[[str, float], None]
Item = TypeVar("Item")


def key_of(parts: Sequence[Candidate]) -> Names:
    """Return the names of candidates as a set."""
    return frozenset(c.name for c in parts)


@dataclass(frozen=True)
class Hypothesis:
    """A set of candidates with its fit.

    Attributes:
        ended: True if the fit used all substeps of the model and all noise was free.
    """

    candidates: tuple[Candidate, ...]
    fit: Fit
    score: float
    ended: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Return the sorted names of the candidates."""
        return tuple(sorted(self.key))

    @property
    def key(self) -> Names:
        """Return the names of the candidates as a set."""
        return key_of(self.candidates)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return the parameters of the candidates."""
        return tuple(n for c in self.candidates for n in c.parameters)

    def loss_without(self, c: Candidate, neutral: NamedValues) -> float:
        """Return the estimated log-likelihood loss if a part is removed."""
        away = np.array([self.fit.values[f.name] - neutral[f.name] for f in c.free])
        return 0.5 * float(away @ self.fit.marginal(c.parameters) @ away)


def best_hypothesis(hypotheses: Iterable[Hypothesis]) -> Hypothesis:
    """Return the hypothesis with the best score."""
    return min(hypotheses, key=lambda h: h.score)


class Search:
    """Fits of hypotheses on a problem.

    Attributes:
        price: Complexity penalty of each parameter in the score, ½·ln N.
        on_trial: Number of candidates.
        tried: Set of names → hypothesis.
        candidates: All candidates.
        hidden: Effects that these logs cannot show at their usual size.
        free_noise: With trusted equations, the noise of the fit with free unknown inputs. A fit with trusted equations
            counts model errors as sensor noise, so its filter hardly follows the readings.
        cross_fits: (set of names, held-out log) → fit to the remaining logs.
        evidences: Set of names → hypothesis and its evidence.
    """

    def __init__(self, subject: Subject, problem: Problem, on_trial: int, progress: Progress) -> None:
        self.subject, self.problem, self.progress = subject, problem, progress
        self.price = problem.price
        self.on_trial, self.candidates, self.hidden = on_trial, list[Candidate](), tuple[str, ...]()
        self.free_noise: Noise | None = None
        self.tried: dict[Names, Hypothesis] = {}
        self.cross_fits: dict[tuple[Names, int], Fit] = {}
        self.evidences: dict[Names, tuple[Hypothesis, Evidence]] = {}

    def hypothesis(
        self,
        parts: Parts,
        start: Fit | None,
        goal: float = np.inf,
        *,
        promised: NamedValues | None = None,
        loosen: bool = True,
        screen: bool = False,
    ) -> Hypothesis:
        """Fit candidates together from each of their start values; base parameters among them lose their prior.

        Args:
            promised: Additional start values from a score test.
            loosen: Start unknown inputs at a level that a fit can change.
            screen: Make only a few iterations with constant sensor noise, to rank the hypothesis.
        """
        problem, free = self.problem, self.free(parts)
        start = start or initial_fit(problem)
        # Only parameters that are free in this fit keep their start values; parts of other hypotheses return to
        # neutral.
        moved = {f.name for f in start.free} & {f.name for f in free}
        base = {**problem.values, **{name: start.values[name] for name in moved}}
        starts = [c.starts for c in parts if not moved.issuperset(c.parameters)]
        begins = []
        for k in range(max([1, *(len(c.starts) for c in parts)])):
            begins.append(base | dict(chain.from_iterable(s[min(k, len(s) - 1)].items() for s in starts)))
        noise = start.noise
        if problem.trusted:
            noise = replace(problem.plain, sensors=noise.sensors, timing=noise.timing)
        elif loosen:
            noise = replace(noise, power=np.maximum(noise.power, problem.noise.quiet))
        if promised:
            begins = [self._toward(promised, base, free, noise, start.nll), *(begins if len(begins) > 1 else ())]
        iterations = SCREEN_ITERATIONS if screen else MAX_ITERATIONS
        fits = [fit(problem, free, b, noise, None, iterations, goal=goal, sensing=not screen) for b in begins]
        best = min(fits, key=attrgetter("objective"))
        return Hypothesis(parts, best, best.objective + self.cost(parts), ended=not screen)

    def from_the_prior(self, h: Hypothesis) -> Hypothesis:
        """Fit a hypothesis from other start values, since a fit may end in a local optimum; return the best fit.

        Sizes of parts and base parameters are drawn from their priors, unknown inputs from the range that logs can
        show. Free runs that have departed from the motion in the logs are also fitted to the first rows, then to more
        rows.
        """
        problem, free, best = self.problem, self.free(h.candidates), h.fit
        rng = np.random.default_rng([*" ".join(h.names).encode()])
        for _ in range(PRIOR_DRAWS):
            values = dict(best.values)
            for f in free:
                if f.group:
                    continue
                given = problem.values[f.name]
                centre, width = f.prior or (given if f.neutral is None else f.neutral, f.size * rng.choice(MIXTURE))
                values[f.name] = float(centre + width * rng.standard_normal())
            noise = best.noise
            if not problem.trusted:
                power = rng.uniform(problem.noise.smallest, problem.noise.largest)
                noise = replace(noise, power=power, memory=problem.plain.memory)
            other = fit(problem, free, values, noise, goal=best.objective - CONVERGED_GAIN * problem.scatter)
            best = min(best, other, key=attrgetter("objective"))
        # Large unknown inputs indicate free runs that have departed from the motion in the logs.
        is_away = problem.layout.is_free_run and np.any(best.noise.power > problem.noise.plain)
        if is_away and not problem.trusted:
            own = {n: best.values[n] for n in h.parameters}
            best = min(best, fit_growing(problem, free, {**problem.values, **own}), key=attrgetter("objective"))
        return replace(h, fit=best, score=best.objective + self.cost(h.candidates))

    def _toward(
        self, promised: NamedValues, base: NamedValues, free: Sequence[Free], noise: Noise, nll: float
    ) -> dict[str, float]:
        """Return values near predicted ones: predicted changes are halved until the logs are no less likely.

        A score test extrapolates linearly, and predicts too large sizes if unknown inputs explain most of an effect.
        """
        sizes, found = {f.name for f in free if f.neutral is not None}, []
        for share in 0.5 ** np.arange(1 + HALVINGS):
            values = {n: base[n] + share * (v - base[n]) if n in sizes else v for n, v in promised.items()}
            found.append(({**base, **values}, self.problem.score({**base, **values}, noise).nll))
            if found[-1][1] <= nll:
                break
        return min(found, key=lambda pair: pair[1])[0]

    def free(self, parts: Parts) -> list[Free]:
        """Return the free parameters for a fit of candidates."""
        own = [*(f for c in parts for f in c.free), *self.problem.own]
        on_trial = {*(f.name for f in own), *self.problem.settings.per_log}
        base = base_parameters(self.subject, self.problem.values, self.problem.settings.tolerance)
        return [b for b in base if b.name not in on_trial] + own

    def fit_all(self, sets: Sequence[Trial], start: Hypothesis, stage: str) -> list[Hypothesis]:
        """Fit sets of candidates; a fit ends early if it cannot approach the score of `start`."""

        def fit_trial(trial: Trial) -> Hypothesis:
            parts, promised = trial
            goal = start.score + self.near - self.cost(parts)
            return self.hypothesis(parts, start.fit, goal, promised=promised, screen=True)

        return self.fit_each(stage, fit_trial, [trial for trial in sets if key_of(trial[0]) not in self.tried])

    def fit_to_the_end(self, starts: Sequence[tuple[Parts, Fit]]) -> list[Hypothesis]:
        """Fit sets of parts, with sensor noise, to convergence from given values; keep the best fit of each set.

        A fit that is worse than the fit of a subset is repeated from the values of that fit, so that it cannot be
        worse.
        """

        def refit(start: tuple[Parts, Fit]) -> Hypothesis:
            fitted = self.hypothesis(*start, loosen=False)
            earlier = self.tried.get(fitted.key)
            enough = CONVERGED_GAIN * self.problem.scatter
            if earlier and earlier.fit is not start[1] and earlier.fit.objective < fitted.fit.objective - enough:
                fitted = self.hypothesis(fitted.candidates, earlier.fit, loosen=False)
            ended = [h for h in self.tried.values() if h.ended and h.key < fitted.key]
            best = min(ended, key=lambda h: h.fit.objective, default=fitted)
            if best.fit.objective < fitted.fit.objective:
                added = [c for c in fitted.candidates if c.name not in best.key and c.kind != "parameter"]
                free = [f for c in added for f in c.free]
                values = dict(chain.from_iterable(c.starts[0].items() for c in added))
                values |= {f.name: f.neutral for f in free if f.neutral is not None}
                begin = replace(best.fit, values={**best.fit.values, **values}, free=(*best.fit.free, *free))
                fitted = self.hypothesis(fitted.candidates, begin, loosen=False)
            return fitted

        return self.fit_each("fitting the rivals of the best", refit, starts)

    def fit_each(self, stage: str, fit_item: Callable[[Item], Hypothesis], todo: Sequence[Item]) -> list[Hypothesis]:
        """Fit items in parallel and report progress."""
        done = count()
        self.progress(stage, 0.0)

        def fit_and_report(item: Item) -> Hypothesis:
            h, number = fit_item(item), 1 + next(done)
            self.progress(f"{stage}: candidate {number} of {len(todo)}", number / len(todo))
            return h

        fitted = in_parallel(fit_and_report, todo)
        self.tried |= {h.key: h for h in fitted}
        report_ranking(self.progress, [*self.tried.values()])
        return fitted

    @property
    def near(self) -> float:
        """Return the score difference that corresponds to FITTED_WITHIN_NATS."""
        return FITTED_WITHIN_NATS * self.problem.scatter

    def cost(self, parts: Sequence[Candidate]) -> float:
        """Return the complexity penalty and prior of candidates in the score."""
        shapes = sum(math.log(c.among) + self.price * len(c.free) for c in parts)
        return float(self.problem.scatter * (shapes - log_prior(len(parts), max(self.on_trial, len(parts)))))
