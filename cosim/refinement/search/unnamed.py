"""Is something left that no effect of the catalogue is? Terms without a name, of one signal each.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state promises a gain of ½·g²/F, with F the
information of c after the other free parameters are accounted for. Those that promise most are fitted beside the
hypothesis before anything is said of them: which equation they are of, on what they depend, and whether the
hypothesis stands beside them. Of terms that these logs do not distinguish the simplest stands for all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.fit import Fit, fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import ScoreTest
from cosim.kernel.nameless import PREFIX, SLOTS
from cosim.refinement.search.fits import ENTRY, SCREEN_ITERATIONS
from cosim.refinement.search.missing import Filter, at_best, claimed, smoothed
from cosim.refinement.search.shapes import Shape, promising
from cosim.subject.candidates import Free

SMALL = 0.1  # of a disturbance that is plainly detected within a second, for the difference of a term
FITTED = 3  # terms, at most, fitted beside a hypothesis
DETECTABLE = 3.0  # standard deviations, that the difference of a term makes
STRAIGHT = 1e-4  # of that, from which a smaller difference says the same: the filter is run once
ALIKE = 0.95  # correlation of what two terms change, from which one stands for both


@dataclass(frozen=True)
class Unnamed:
    """A term without a name.

    equation:    the forced state; signal: the basis, such as `1` or `|velocity|`; of a local shape what it is over
    gain:        log-likelihood it promises; coefficient: at which it does, the first step of a fit and no estimate
    most:        the most that it or a term it stands for promises
    share:       of the mean square of what is missing from the equation, what the term at its best size takes away;
                 None: not asked for, or the filter diverged
    shape:       of a local shape; sizes: coefficients of its bumps; slot: of the kernel, that holds it
    """

    equation: str
    signal: str
    gain: float
    coefficient: float
    most: float
    share: float | None = None
    shape: Shape | None = None
    sizes: tuple[float, ...] = ()
    slot: int = 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of its coefficients among the parameters."""
        return self.shape.coefficients(self.slot) if self.shape else (f"{PREFIX}.{self.equation}.{self.signal}",)

    @property
    def known(self) -> dict[str, float]:
        """What sets the kernel to its shape."""
        return self.shape.settings(self.slot) if self.shape else {}

    @property
    def values(self) -> dict[str, float]:
        """The parameters at which it is there."""
        return self.known | dict(zip(self.names, self.sizes or (self.coefficient,), strict=True))

    @property
    def entry(self) -> dict[str, Any]:
        """As refine.json tells it."""
        told = {"equation": self.equation, "signal": self.signal, "gain": self.gain, "coefficient": self.coefficient}
        if self.shape is None:
            return told
        local = {**self.shape.entry, "sizes": list(self.sizes)}
        return told | {"place": self.shape.place, "width": self.shape.width, "local": local}


@dataclass(frozen=True)
class Leftover:
    """What is left beside a hypothesis.

    terms: the most promising first; where they were fitted, those that gain more than they cost, as fitted
    fit:   the hypothesis with these terms; None where none counts
    gain:  of log-likelihood, by all of them together
    cost:  what a term must gain to count
    among: how many terms were tried
    """

    terms: tuple[Unnamed, ...]
    fit: Fit | None
    gain: float
    cost: float
    among: int = 1

    @property
    def first(self) -> Unnamed | None:
        """The most promising term."""
        return self.terms[0] if self.terms else None


def left_beside(problem: Problem, at: Fit, price: float, units: Mapping[str, str] = MappingProxyType({})) -> Leftover:
    """Return the terms beside a fit; `problem` is built with them, `at` is a fit of the same logs without.

    price: score that a parameter costs where what is left is white
    units: of time, states and commands; of two states of one unit shapes may be local over the difference
    """
    looked = _Terms(problem, at, price)
    simple, local = looked.simple(), looked.local(units)
    terms = sorted(looked.beside(simple, local), key=looked.net, reverse=True)
    chosen = _placed([u for u in terms if looked.net(u) > 0.0][:FITTED])
    if not chosen:
        return Leftover((), None, 0.0, looked.cost)
    without = fit(problem, at.free, at.values, at.noise, iterations=SCREEN_ITERATIONS)
    while chosen:
        fitted = _fitted(problem, at, chosen)
        gains = {u: _alone(fitted, u) for u in chosen}
        if all(gain > looked.costs(u) for u, gain in gains.items()):
            named = sorted((_as_fitted(u, fitted, gains[u]) for u in chosen), key=looked.net, reverse=True)
            named[0] = replace(named[0], share=_share(problem, at, named[0]))
            gain = without.objective - fitted.objective
            return Leftover(tuple(named), fitted, gain, looked.cost, looked.number_tried(named))
        weakest = min(chosen, key=lambda u: gains[u] - looked.costs(u))
        chosen = [u for u in chosen if u is not weakest]
    return Leftover((), None, 0.0, looked.cost)


class _Terms:
    """What terms promise about a fit, and what each must gain to count.

    Simple ones are tried first: local shapes, each of their coefficients counted, cost the logarithm of all together.
    """

    def __init__(self, problem: Problem, at: Fit, price: float) -> None:
        self.problem, self.at, self.price = problem, at, price
        self.names = [name for name in problem.layout.parameters if name.startswith(f"{PREFIX}.")]
        self.tried = 0
        self.test = ScoreTest(problem, at)
        self.steps = dict(zip(problem.layout.forced, SMALL * np.sqrt(problem.plain.density), strict=True))

    @property
    def cost(self) -> float:
        """What a simple term must gain to count."""
        return self.problem.scatter * (self.price + ENTRY + math.log(max(1, len(self.names))))

    def costs(self, u: Unnamed) -> float:
        """What a term must gain to count."""
        if u.shape is None:
            return self.cost
        count, tried = len(u.names), max(1, len(self.names) + self.tried)
        return self.problem.scatter * (self.price * count + ENTRY + math.log(tried))

    def number_tried(self, terms: Sequence[Unnamed]) -> int:
        """Return how many terms were tried beside these; local ones count where one of these is local."""
        return len(self.names) + (self.tried if any(u.shape for u in terms) else 0)

    def simple(self) -> list[Unnamed]:
        """Return terms of one basis each, of those that change the same in an equation one."""

        def term(name: str) -> tuple[Unnamed, Array]:
            _, equation, signal = name.split(".", 2)
            step, row = self._sized(equation, {}, name)
            gain, (taken,) = self.test.gain([row])
            return Unnamed(equation, signal, gain, float(taken * step), gain), row

        terms = [(u, row) for u, row in in_parallel(term, self.names) if u.gain > 0.0]
        forced = self.problem.layout.forced
        return [u for e in forced for u in _distinct([(u, row) for u, row in terms if u.equation == e])]

    def local(self, units: Mapping[str, str]) -> list[tuple[Unnamed, list[Array]]]:
        """Local shapes, and what each of their coefficients changes."""
        shapes, self.tried = promising(self.problem, self.at, units, self.cost)

        def term(shape: Shape) -> tuple[Unnamed, list[Array]]:
            sized = [self._sized(shape.equation, shape.settings(1), name) for name in shape.coefficients(1)]
            rows = [row for _, row in sized]
            gain, taken = self.test.gain(rows)
            sizes = tuple(float(t * step) for t, (step, _) in zip(taken, sized, strict=True))
            largest = max(sizes, key=abs)
            return Unnamed(shape.equation, shape.signal, gain, largest, gain, shape=shape, sizes=sizes), rows

        return in_parallel(term, shapes)

    def beside(self, simple: Sequence[Unnamed], local: Sequence[tuple[Unnamed, list[Array]]]) -> list[Unnamed]:
        """Simple terms, and local ones that promise plainly more than any simple one of their equation.

        Of local ones of an equation each must be worth its cost beside those that promise more.
        """
        most = {u.equation: 0.0 for u, _ in local}
        for s in simple:
            most[s.equation] = max(most.get(s.equation, 0.0), s.most)
        kept: dict[str, list[Array]] = {}
        found = list(simple)
        for u, rows in sorted(local, key=lambda term: -self.net(term[0])):
            before = kept.get(u.equation, [])
            plainly = ALIKE**2 * u.gain - (self.costs(u) - self.cost) > most[u.equation]
            more = self.test.gain([*before, *rows])[0] - (self.test.gain(before)[0] if before else 0.0)
            if plainly and more > self.costs(u):
                kept[u.equation] = [*before, *rows]
                found.append(u)
        return found

    def net(self, u: Unnamed) -> float:
        """What a term promises more than it costs."""
        return u.most - self.costs(u)

    def _sized(self, equation: str, known: Mapping[str, float], name: str) -> tuple[float, Array]:
        """A step of a coefficient that makes a plain difference, and the difference."""
        first = self.steps[equation]
        row = self.test.row({**known, name: first})
        with np.errstate(over="ignore"):  # of a term that runs away: then its step is none
            size = float(np.sqrt(row @ row))
        step = first * (DETECTABLE / size if size > 0.0 else 1.0)  # whatever the size of its basis
        if STRAIGHT * DETECTABLE < size < DETECTABLE:
            return step, row * (step / first)
        return step, self.test.row({**known, name: step})


def _placed(terms: Sequence[Unnamed]) -> list[Unnamed]:
    """Terms, each local shape among them in a slot of its own."""
    placed: list[Unnamed] = []
    for u in terms:
        slot = 1 + sum(p.shape is not None for p in placed)
        if slot <= SLOTS:
            placed.append(replace(u, slot=slot) if u.shape else u)
    return placed


def _fitted(problem: Problem, at: Fit, terms: Sequence[Unnamed]) -> Fit:
    """The fit with some terms free beside what is."""
    sizes = {name: abs(value) or 1.0 for u in terms for name, value in u.values.items() if name in u.names}
    known = {name: value for u in terms for name, value in u.known.items()}
    free = [*at.free, *(Free(name, -math.inf, math.inf, size) for name, size in sizes.items())]
    # from none: it can only come nearer
    return fit(problem, free, {**at.values, **known}, at.noise, iterations=SCREEN_ITERATIONS)


def _alone(fitted: Fit, u: Unnamed) -> float:
    """What one of the fitted terms gains beside the others."""
    sizes = np.array([fitted.values[name] for name in u.names])
    return 0.5 * float(sizes @ fitted.marginal(u.names) @ sizes)


def _as_fitted(u: Unnamed, fitted: Fit, gain: float) -> Unnamed:
    """The term as a fit has it."""
    sizes = tuple(fitted.values[name] for name in u.names)
    return replace(u, gain=gain, most=gain, coefficient=max(sizes, key=abs), sizes=sizes if u.shape else ())


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
    without, with_it = Filter(at.values, at.noise), Filter({**at.values, **u.values}, at.noise)
    with np.errstate(invalid="ignore", over="ignore"):
        parts, value, _ = smoothed(problem, without)
        column = parts[0][1].equations.index(u.equation)
        lacking = value[:, column]
        term = np.concatenate([claimed(problem, without, with_it, k)[:, column] for k, _ in parts])
        left = float(np.mean((lacking - at_best(problem, at, column, term, lacking)) ** 2))
        power = float(np.mean(lacking**2))
    return 1.0 - left / power if np.isfinite(left) and 0.0 < power < np.inf else None
