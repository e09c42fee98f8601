"""Is something left that no effect of the catalogue is? Terms without a name, of one signal each.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state promises a gain of ½·g²/F, with F the
information of c after the other free parameters are accounted for. Those that promise most are fitted beside the
hypothesis before anything is said of them: which equation they are of, on what they depend, and whether the
hypothesis stands beside them. Of terms that these logs do not distinguish the simplest stands for all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Array
from cosim.estimation.candidates import Free
from cosim.estimation.fit import Fit, fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import ScoreTest
from cosim.kernel.nameless import PREFIX
from cosim.refinement.missing import LOGS, Filter, at_best, claimed, missing
from cosim.refinement.search import ENTRY, SCREEN_ITERATIONS

SMALL = 0.1  # of a disturbance that is plainly detected within a second, for the difference of a term
FITTED = 3  # terms, at most, fitted beside a hypothesis
DETECTABLE = 3.0  # standard deviations, that the difference of a term makes
ALIKE = 0.95  # correlation of what two terms change, from which one stands for both


@dataclass(frozen=True)
class Unnamed:
    """A term without a name.

    equation:    the forced state; signal: the basis, such as `1` or `|velocity|`
    gain:        log-likelihood it promises; coefficient: at which it does, the first step of a fit and no estimate
    most:        the most that it or a term it stands for promises
    share:       of the mean square of what is missing from the equation, what the term at its best size takes away;
                 None: not asked for, or the filter diverged
    """

    equation: str
    signal: str
    gain: float
    coefficient: float
    most: float
    share: float | None = None

    @property
    def name(self) -> str:
        """Of its coefficient among the parameters."""
        return f"{PREFIX}.{self.equation}.{self.signal}"


@dataclass(frozen=True)
class Leftover:
    """What is left beside a hypothesis.

    terms: the most promising first; where they were fitted, those that gain more than they cost, as fitted
    fit:   the hypothesis with these terms; None where none counts
    gain:  of log-likelihood, by all of them together
    cost:  what a term must gain to count
    """

    terms: tuple[Unnamed, ...]
    fit: Fit | None
    gain: float
    cost: float


def left_beside(problem: Problem, at: Fit, price: float) -> Leftover:
    """Terms beside a fit; `problem` is built with them, `at` is a fit of the same logs without.

    price: score that a parameter costs where what is left is white
    """
    names = [name for name in problem.layout.parameters if name.startswith(f"{PREFIX}.")]
    cost = problem.scatter * (price + ENTRY + math.log(max(1, len(names))))
    test = ScoreTest(problem, at)
    steps = dict(zip(problem.layout.forced, SMALL * np.sqrt(problem.plain.density), strict=True))

    def term(name: str) -> tuple[Unnamed, Array]:
        _, equation, signal = name.split(".", 2)
        row = test.row({name: steps[equation]})
        with np.errstate(over="ignore"):  # of a term that runs away: then its step is none
            size = float(np.sqrt(row @ row))
        step = steps[equation] * (DETECTABLE / size if size > 0.0 else 1.0)  # whatever the size of its basis
        row = test.row({name: step})
        gain, (taken,) = test.gain([row])
        return Unnamed(equation, signal, gain, float(taken * step), gain), row

    promising = [(u, row) for u, row in in_parallel(term, names) if u.gain > 0.0]
    distinct = [u for e in problem.layout.forced for u in _distinct([p for p in promising if p[0].equation == e])]
    terms = sorted(distinct, key=_promise)
    chosen = [u for u in terms if u.most > cost][:FITTED]
    without = fit(problem, at.free, at.values, at.noise, iterations=SCREEN_ITERATIONS) if chosen else at
    while chosen:
        fitted = _fitted(problem, at, chosen)
        gains = {u: _alone(fitted, u) for u in chosen}
        if all(gain > cost for gain in gains.values()):
            named = [replace(u, gain=gains[u], coefficient=fitted.values[u.name], most=gains[u]) for u in chosen]
            named.sort(key=_promise)
            named[0] = replace(named[0], share=_share(problem, at, named[0]))
            return Leftover(tuple(named), fitted, without.objective - fitted.objective, cost)
        weakest = min(chosen, key=lambda u: gains[u])
        chosen = [u for u in chosen if u is not weakest]
    return Leftover((), None, 0.0, cost)


def _fitted(problem: Problem, at: Fit, terms: Sequence[Unnamed]) -> Fit:
    """The fit with some terms free beside what is."""
    free = [*at.free, *(Free(u.name, -math.inf, math.inf, abs(u.coefficient) or 1.0) for u in terms)]
    return fit(problem, free, at.values, at.noise, iterations=SCREEN_ITERATIONS)  # from none: it can only come nearer


def _alone(fitted: Fit, u: Unnamed) -> float:
    """What one of the fitted terms gains beside the others."""
    return 0.5 * float(fitted.marginal([u.name])[0, 0]) * fitted.values[u.name] ** 2


def _promise(u: Unnamed) -> float:
    return -u.most


def _distinct(promising: Sequence[tuple[Unnamed, Array]]) -> list[Unnamed]:
    """Of terms of one equation that change the same, one: the simplest of those that promise about as much."""
    left = [(u, row / np.linalg.norm(row)) for u, row in promising]
    kept = []
    while left:
        best, direction = max(left, key=lambda term: term[0].gain)
        alike = [(u, d) for u, d in left if abs(d @ direction) > ALIKE or u is best]
        # what correlates by ρ with the truth promises ρ² of its gain
        first, other = next((u, d) for u, d in alike if u.gain >= ALIKE**2 * best.gain)
        kept.append(replace(first, most=best.gain))
        left = [(u, d) for u, d in left if max(abs(d @ direction), abs(d @ other)) <= ALIKE and u is not best]
    return kept


def _share(problem: Problem, at: Fit, u: Unnamed) -> float | None:
    """1 − Σ(d − t)²/Σd²: d the input that the equation lacks, as a smoother estimates it, t the term at its best size.

    On the first logs. None where a filter has diverged.
    """
    without = Filter(at.values, at.noise)
    with_it = Filter({**at.values, u.name: u.coefficient}, at.noise)
    logs = range(min(LOGS, len(problem.logs)))
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [missing(problem, without, k) for k in logs]
        column = parts[0].equations.index(u.equation)
        lacking = np.concatenate([m.value[:, column] for m in parts])
        term = np.concatenate([claimed(problem, without, with_it, k)[:, column] for k in logs])
        left = float(np.mean((lacking - at_best(problem, at, logs, column, term, lacking)) ** 2))
        power = float(np.mean(lacking**2))
    return 1.0 - left / power if np.isfinite(left) and 0.0 < power < np.inf else None
