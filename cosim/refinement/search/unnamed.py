"""Unnamed terms for a residual that no effect of the catalogue explains.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state has a predicted gain of ½·g²/F, with g
the score and F the information of c after projection on the further free parameters. The most promising terms are
fitted in addition to the hypothesis before any conclusion about the equation, its signals, and the hypothesis itself.
Of several terms that these logs do not distinguish, the simplest is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.fit import Fit, fit
from cosim.estimation.kernel.nameless import PREFIX, SLOTS
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import ScoreTest
from cosim.estimation.subject.candidates import Free
from cosim.refinement.search.fits import ENTRY, SCREEN_ITERATIONS
from cosim.refinement.search.missing import contributions, scale_to_missing, smooth_logs, smooth_unknown_inputs
from cosim.refinement.search.resemblance import law_of
from cosim.refinement.search.shapes import EVERY, Shape, promising_shapes, signals_of

SMALL = 0.1  # share of a plainly detected disturbance within a second, for the difference step of a term
FITTED = 3  # largest number of terms fitted beside a hypothesis
DETECTABLE = 3.0  # standard deviations of a term's difference
STRAIGHT = 1e-4  # share of that, from which a smaller difference is linear and one filter run suffices
NOISE_FACTORS = (1.0 / 3.0, 3.0)  # on the standard deviation of sensor noise, under which a stable term must lead
ALIKE = 0.95  # correlation of two terms' differences from which one represents both


@dataclass(frozen=True)
class UnnamedTerm:
    """A term outside the catalogue in the equation of a forced state.

    Attributes:
        equation: Forced state.
        signal: Basis such as `1` or `|velocity|`; for a local shape its signal.
        gain: Predicted log-likelihood gain.
        coefficient: First step of a fit, no estimate.
        most: Largest predicted gain of all equivalent terms.
        share: Share of the missing input's mean square that the scaled term removes; None if not computed or the filter
            diverged.
        shape: Local shape.
        sizes: Coefficients of the shape's bumps.
        slot: Number of the local shape in the kernel's parameters.
        like: Law that the local shape resembles, in words; "" for none.
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
    like: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the parameter names of the coefficients."""
        return self.shape.coefficients(self.slot) if self.shape else (f"{PREFIX}.{self.equation}.{self.signal}",)

    @property
    def coefficients(self) -> dict[str, float]:
        """Return the values of the coefficients by name."""
        return dict(zip(self.names, self.sizes or (self.coefficient,), strict=True))

    @property
    def entry(self) -> dict[str, Any]:
        """Return the term as an entry of refine.json."""
        entry = {name: getattr(self, name) for name in ("equation", "signal", "gain", "coefficient")}
        if self.shape is None:
            return entry
        local = {**self.shape.entry, "sizes": list(self.sizes)}
        like = {"like": self.like} if self.like else {}
        return entry | {"place": self.shape.place, "width": self.shape.width, "local": local} | like


Key = tuple[str, str, Shape | None]  # equation, signal and shape of a term
Effects = dict[Key, list[Array]]  # effect of each coefficient of a term
LocalTerm = tuple[UnnamedTerm, list[Array]]  # a term with a local shape, and the effect of each coefficient


@dataclass(frozen=True)
class Leftover:
    """Terms beside a hypothesis.

    Attributes:
        terms: Most promising first; after a fit, terms whose gain exceeds their cost, with fitted values.
        fit: Hypothesis with these terms; None without terms.
        gain: Log-likelihood gain of all terms together.
        cost: Required gain of a simple term.
        among: Number of terms tried.
        is_stable: Whether a term of the same signal leads without any one log, and with other sensor noise.
        is_placed: Whether this term is always one of the same equation.
    """

    terms: tuple[UnnamedTerm, ...]
    fit: Fit | None
    gain: float
    cost: float
    among: int = 1
    is_stable: bool = True
    is_placed: bool = True

    @property
    def first(self) -> UnnamedTerm | None:
        """Return the most promising term."""
        return self.terms[0] if self.terms else None


def find_unnamed_terms(
    problem: Problem, at: Fit, price: float, units: Mapping[str, str] = MappingProxyType({})
) -> Leftover:
    """Return promising unnamed terms in addition to a fit.

    Args:
        problem: Problem with unnamed terms in the kernel.
        at: Fit of the same logs without these terms.
        price: Score cost of a parameter for a white residual.
        units: Units of time, states and commands; local shapes use differences of states with equal units.
    """
    test = _Terms(problem, at, price)
    terms = sorted(test.select(test.simple(), test.local(units)), key=test.net, reverse=True)
    chosen: list[UnnamedTerm] = []
    for u in [u for u in terms if test.net(u) > 0.0][:FITTED]:  # each local shape has a slot of the kernel
        slot = 1 + sum(other.shape is not None for other in chosen)
        if slot <= SLOTS:
            chosen.append(replace(u, slot=slot) if u.shape else u)
    if not chosen:
        return Leftover((), None, 0.0, test.cost)
    without = fit(problem, at.free, at.values, at.noise, iterations=SCREEN_ITERATIONS)
    while chosen:
        sizes = {name: abs(value) or 1.0 for u in chosen for name, value in u.coefficients.items()}
        settings = {name: value for u in chosen if u.shape for name, value in u.shape.settings(u.slot).items()}
        free = [*at.free, *(Free(name, -math.inf, math.inf, size) for name, size in sizes.items())]
        # Terms start at zero, so the objective can only decrease.
        fitted = fit(problem, free, {**at.values, **settings}, at.noise, iterations=SCREEN_ITERATIONS)
        refitted = []
        for u in chosen:
            found = tuple(fitted.values[name] for name in u.names)
            gain = 0.5 * float(np.array(found) @ fitted.marginal(u.names) @ np.array(found))  # beside all other terms
            most = max(found, key=abs)
            refitted.append(replace(u, gain=gain, most=gain, coefficient=most, sizes=found if u.shape else ()))
        if all(test.net(u) > 0.0 for u in refitted):
            refitted.sort(key=test.net, reverse=True)
            refitted[0] = replace(refitted[0], share=_share(problem, at, refitted[0], fitted))
            gain = without.objective - fitted.objective
            tried = len(test.names) + (test.tried if any(u.shape for u in refitted) else 0)
            first, leaders = refitted[0], test.leaders(refitted[0])
            if first.shape is not None:
                place = first.equation, first.signal
                shapes = [(u.shape, u.sizes) for u in refitted if u.shape and (u.equation, u.signal) == place]
                parts, *_ = smooth_unknown_inputs(problem, at, EVERY)
                is_rate = {*problem.layout.rates.values()}.issuperset(first.shape.of)
                refitted[0] = replace(first, like=law_of(shapes, signals_of(problem, parts), is_rate=is_rate))
            steady = all(signal == first.signal for _, signal, _ in leaders)
            placed = all(equation == first.equation for equation, _, _ in leaders)
            return Leftover(tuple(refitted), fitted, gain, test.cost, tried, steady, placed)
        del chosen[min(range(len(chosen)), key=lambda k: test.net(refitted[k]))]
    return Leftover((), None, 0.0, test.cost)


class _Terms:
    """Predicted and required gain of unnamed terms at a fit.

    The required gain of a local shape grows with the logarithm of the number of coefficients tried.
    """

    def __init__(self, problem: Problem, at: Fit, price: float) -> None:
        self.problem, self.at, self.price = problem, at, price
        self.names = [name for name in problem.layout.parameters if name.startswith(f"{PREFIX}.")]
        self.tried = 0
        self.moves: dict[Key, list[Mapping[str, float]]] = {}  # parameter steps of each term
        self.rows: Effects = {}
        self.test = ScoreTest(problem, at)
        self.steps = dict(zip(problem.layout.forced, SMALL * np.sqrt(problem.plain.density), strict=True))

    @property
    def cost(self) -> float:
        """Return the gain required of a simple term."""
        return self.problem.scatter * (self.price + ENTRY + math.log(max(1, len(self.names))))

    def costs(self, u: UnnamedTerm) -> float:
        """Return the gain required of a term."""
        return self.cost if u.shape is None else self._cost_of_shape(len(u.names))

    def _cost_of_shape(self, count: int) -> float:
        """Return the gain required of a local shape with this number of coefficients."""
        tried = max(1, len(self.names) + self.tried)
        return self.problem.scatter * (self.price * count + ENTRY + math.log(tried))

    def simple(self) -> list[UnnamedTerm]:
        """Return the distinct simple terms of each equation."""

        def term(name: str) -> tuple[UnnamedTerm, Array]:
            _, equation, signal = name.split(".", 2)
            step, row = self._size_step(equation, {}, name)
            gain, (size,) = self.test.gain([row])
            self.moves[equation, signal, None], self.rows[equation, signal, None] = [{name: step}], [row]
            return UnnamedTerm(equation, signal, gain, float(size * step), gain), row

        terms = [(u, row) for u, row in in_parallel(term, self.names) if u.gain > 0.0]
        forced = self.problem.layout.forced
        return [u for e in forced for u in _without_equivalents([(u, row) for u, row in terms if u.equation == e])]

    def local(self, units: Mapping[str, str]) -> list[LocalTerm]:
        """Return promising local shapes as terms, with the effect of their coefficients on the innovations."""
        shapes, self.tried = promising_shapes(self.test, units, self.cost)

        def term(shape: Shape) -> LocalTerm:
            names, settings = shape.coefficients(1), shape.settings(1)
            sized = [self._size_step(shape.equation, settings, name) for name in names]
            rows = [row for _, row in sized]
            gain, steps = self.test.gain(rows)
            sizes = tuple(float(t * step) for t, (step, _) in zip(steps, sized, strict=True))
            largest = max(sizes, key=abs)
            key = shape.equation, shape.signal, shape
            self.moves[key] = [{**settings, name: step} for name, (step, _) in zip(names, sized, strict=True)]
            self.rows[key] = rows
            return UnnamedTerm(shape.equation, shape.signal, gain, largest, gain, shape=shape, sizes=sizes), rows

        return in_parallel(term, shapes)

    def select(self, simple: Sequence[UnnamedTerm], local: Sequence[LocalTerm]) -> list[UnnamedTerm]:
        """Return simple terms and clearly better local shapes.

        Each local shape must gain more than its cost in addition to more promising shapes of the same equation.
        """
        most = {u.equation: 0.0 for u, _ in local}
        for s in simple:
            most[s.equation] = max(most.get(s.equation, 0.0), s.most)
        effects: dict[str, list[Array]] = {}
        selected = list(simple)
        for u, rows in sorted(local, key=lambda term: -self.net(term[0])):
            before = effects.get(u.equation, [])
            is_better = ALIKE**2 * u.gain - (self.costs(u) - self.cost) > most[u.equation]
            more = self.test.gain([*before, *rows])[0] - (self.test.gain(before)[0] if before else 0.0)
            if is_better and more > self.costs(u):
                effects[u.equation] = [*before, *rows]
                selected.append(u)
        return selected

    def leaders(self, first: UnnamedTerm) -> list[Key]:
        """Return the best terms without each log, and with other sensor noise.

        The best term is the one whose gain exceeds its cost by most; `first` counts in place of an equivalent one of
        the same equation.
        """
        costs = {key: self._cost_of_shape(len(rows)) if key[2] else self.cost for key, rows in self.rows.items()}

        def without(part: int) -> Key:
            return _leader(first, self.rows, costs, lambda rows: self.test.gain_without(rows, part))

        def with_noise(factor: float) -> Key:
            noise = replace(self.at.noise, sensors=self.at.noise.sensors + 2.0 * math.log(factor))
            test = ScoreTest(self.problem, replace(self.at, noise=noise))
            rows = in_parallel(lambda item: (item[0], [*map(test.row, item[1])]), list(self.moves.items()))
            return _leader(first, dict(rows), costs, lambda of_term: test.gain(of_term)[0])

        parts = range(max(2, len(self.problem.logs)))
        return [*in_parallel(without, list(parts)), *map(with_noise, NOISE_FACTORS)]

    def net(self, u: UnnamedTerm) -> float:
        """Return a term's predicted gain minus its cost."""
        return u.most - self.costs(u)

    def _size_step(self, equation: str, settings: Mapping[str, float], name: str) -> tuple[float, Array]:
        """Return a step of a coefficient with a detectable effect, and its effect on the innovations."""
        first = self.steps[equation]
        row = self.test.row({**settings, name: first})
        with np.errstate(over="ignore"):  # A term that makes the model diverge has a zero step.
            size = float(np.sqrt(row @ row))
        step = first * (DETECTABLE / size if size > 0.0 else 1.0)  # The step is independent of the size of the basis.
        if STRAIGHT * DETECTABLE < size < DETECTABLE:
            return step, row * (step / first)
        return step, self.test.row({**settings, name: step})


def _leader(
    first: UnnamedTerm, effects: Effects, costs: Mapping[Key, float], gain: Callable[[Sequence[Array]], float]
) -> Key:
    """Return the term with the largest net gain, or the first one in place of an equivalent one."""
    net = {key: gain(rows) - costs[key] for key, rows in effects.items()}
    leader, own = max(net, key=lambda key: net[key]), (first.equation, first.signal, first.shape)
    one, other = effects[own][0], effects[leader][0]
    is_alike = abs(one @ other) > ALIKE * np.linalg.norm(one) * np.linalg.norm(other)
    return own if leader[0] == first.equation and is_alike else leader


def _without_equivalents(terms: Sequence[tuple[UnnamedTerm, Array]]) -> list[UnnamedTerm]:
    """Return the simplest of each group of equivalent terms."""
    rest = [(u, row / np.linalg.norm(row)) for u, row in terms]
    distinct = []
    while rest:
        best, direction = max(rest, key=lambda term: term[0].gain)
        alike = [(u, d) for u, d in rest if abs(d @ direction) > ALIKE or u is best]
        # A term with correlation ρ to the true term promises ρ² of its gain.
        first, other = next((u, d) for u, d in alike if u.gain >= ALIKE**2 * best.gain)
        distinct.append(replace(first, most=best.gain))
        rest = [(u, d) for u, d in rest if max(abs(d @ direction), abs(d @ other)) <= ALIKE and u is not best]
    return distinct


def _share(problem: Problem, at: Fit, u: UnnamedTerm, fitted: Fit) -> float | None:
    """Return 1 − Σ(d − t)²/Σd² on the first logs; None if a filter diverges.

    Here d is the smoothed missing input of the equation, t the term scaled by regression. In a free run, the fitted
    variance of the unknown input takes the place of both.

    Args:
        fitted: Fit with the term.
    """
    if problem.layout.is_free_run:
        column = problem.layout.forced.index(u.equation)
        return 1.0 - math.exp(float(fitted.noise.power[column] - at.noise.power[column]))
    settings = u.shape.settings(u.slot) if u.shape else {}
    with_term = replace(at, values={**at.values, **settings, **u.coefficients})
    with np.errstate(invalid="ignore", over="ignore"):
        parts, value, _ = smooth_logs(problem, at)
        column = parts[0][1].equations.index(u.equation)
        lacking = value[:, column]
        term = np.concatenate([contributions(problem, at, with_term, k)[:, column] for k, _ in parts])
        rest = float(np.mean((lacking - scale_to_missing(problem, at, column, term, lacking)) ** 2))
        power = float(np.mean(lacking**2))
    return 1.0 - rest / power if np.isfinite(rest) and 0.0 < power < np.inf else None
