"""Unnamed terms for a residual that no effect of the catalogue explains.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state has a predicted gain of ½·g²/F, with g
the score and F the information of c after projection on the further free parameters. A gain is no chance if the χ² test
of the best of all terms says so (Bonferroni). Such terms are fitted in addition to the hypothesis before any conclusion
about the equation, its signals, and the hypothesis itself. Of terms that these logs hardly distinguish, the simplest is
taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.special import logit
from scipy.stats import chi2

from cosim.core.arrays import Array
from cosim.estimation.fit import DIFFERENCE, Fit, fit
from cosim.estimation.kernel.nameless import PREFIX, READING, SLOTS
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import ScoreTest
from cosim.estimation.subject.candidates import Free
from cosim.refinement.decision.posterior import CERTAIN, MISFIT
from cosim.refinement.search.fits import SCREEN_ITERATIONS
from cosim.refinement.search.shapes import Shape, law_of, promising_shapes


@dataclass(frozen=True)
class UnnamedTerm:
    """A term outside the catalogue in the equation of a forced state.

    Attributes:
        equation: Forced state, or `reading of` an output.
        signal: Basis such as `1` or `|velocity|`; for a local shape its signal.
        gain: Log-likelihood gain, predicted or fitted.
        sizes: Coefficients: one, or those of the bumps of a spline.
        share: Share of the variance of the equation's unknown input that the fitted terms remove.
        shape: Local shape.
        slot: Number of the local shape in the kernel's parameters.
        like: Law that the local shape resembles, in words; "" for none.
    """

    equation: str
    signal: str
    gain: float = 0.0
    sizes: tuple[float, ...] = ()
    share: float | None = None
    shape: Shape | None = None
    slot: int = 1
    like: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the parameter names of the coefficients."""
        return self.shape.coefficients(self.slot) if self.shape else (f"{PREFIX}.{self.equation}.{self.signal}",)

    @property
    def settings(self) -> dict[str, float]:
        """Return the kernel's parameters of the local shape, without its coefficients."""
        return self.shape.settings(self.slot) if self.shape else {}

    @property
    def coefficient(self) -> float:
        """Return the largest coefficient."""
        return max(self.sizes, key=abs)

    @property
    def entry(self) -> dict[str, Any]:
        """Return the term as an entry of refine.json."""
        entry = {name: getattr(self, name) for name in ("equation", "signal", "gain", "coefficient")}
        if self.shape is None:
            return entry
        local = {**self.shape.entry, "sizes": list(self.sizes)}
        like = {"like": self.like} if self.like else {}
        return entry | {"place": self.shape.place, "width": self.shape.width, "local": local} | like


@dataclass(frozen=True)
class Leftover:
    """Terms beside a hypothesis.

    Attributes:
        terms: Likeliest first, with fitted values.
        fit: Hypothesis with these terms; None without terms.
        gain: Log-likelihood gain of all terms together.
        among: Number of coefficients tried.
        is_stable: Whether a term of the same signal is among the likeliest without any one log.
        is_placed: Whether one of the same equation is.
    """

    terms: tuple[UnnamedTerm, ...] = ()
    fit: Fit | None = None
    gain: float = 0.0
    among: int = 1
    is_stable: bool = True
    is_placed: bool = True


def find_unnamed_terms(
    problem: Problem, at: Fit, price: float, units: Mapping[str, str] = MappingProxyType({})
) -> Leftover:
    """Return unnamed terms in addition to a fit whose gain is no chance.

    Args:
        problem: Problem with unnamed terms in the kernel.
        at: Fit of the same logs without these terms.
        price: Score cost of a coefficient.
        units: Units of time, states and commands; local shapes use differences of states with equal units.
    """
    test = ScoreTest(problem, at)
    simple = [n.split(".", 2)[1:] for n in problem.layout.parameters if n.startswith(f"{PREFIX}.")]
    shapes, tried, signals = promising_shapes(test, price, units)
    terms = [UnnamedTerm(equation, signal) for equation, signal in simple]
    terms += [UnnamedTerm(shape.equation, shape.signal, shape=shape) for shape in shapes]
    among = len(simple) + tried
    usual = dict(zip(problem.layout.forced, np.sqrt(problem.plain.density), strict=True))
    usual |= {READING + n: float(np.sqrt(r)) for n, r in zip(problem.layout.outputs, problem.r, strict=True)}

    def effects(u: UnnamedTerm) -> tuple[list[Array], list[float]]:
        """Return the change of the innovations by a detectable step of each coefficient, and the steps."""
        rows, steps = list[Array](), list[float]()
        for name in u.names:
            step = DIFFERENCE * usual[u.equation]
            size = float(np.linalg.norm(test.row({**u.settings, name: step})))
            steps.append(step / size if size > 0.0 else step)
            rows.append(test.row({**u.settings, name: steps[-1]}))
        return rows, steps

    found = in_parallel(effects, terms)
    rows_of = {u: rows for u, (rows, _) in zip(terms, found, strict=True)}
    steps_of = {u: steps for u, (_, steps) in zip(terms, found, strict=True)}

    def is_chance(u: UnnamedTerm, gain: float) -> bool:
        return among * float(chi2.sf(2.0 * gain / problem.scatter, len(u.names))) > MISFIT

    def likeliest(gains: Sequence[float]) -> list[int]:
        """Return the terms that are nearly as likely as the best, simplest first."""
        nets = [gain / problem.scatter - price * len(u.names) for u, gain in zip(terms, gains, strict=True)]
        return [k for k, net in enumerate(nets) if net >= max(nets) - float(logit(CERTAIN))]

    chosen: list[UnnamedTerm] = []
    before, sum_before = list[Array](), 0.0
    while terms and len(chosen) < SLOTS:  # each local shape has a slot of the kernel
        gains = [test.gain([*before, *rows_of[u]])[0] - sum_before for u in terms]
        k = likeliest(gains)[0]
        u = terms[k]
        if is_chance(u, gains[k]):
            break
        multiples = test.gain(rows_of[u])[1]
        sizes = tuple(float(m * step) for m, step in zip(multiples, steps_of[u], strict=True))
        before, sum_before = [*before, *rows_of[u]], sum_before + gains[k]
        chosen.append(replace(u, gain=gains[k], sizes=sizes, slot=len(chosen) + 1))
    if not chosen:
        return Leftover()
    without = fit(problem, at.free, at.values, at.noise, iterations=SCREEN_ITERATIONS)
    while chosen:
        sizes_of = {n: abs(size) or 1.0 for u in chosen for n, size in zip(u.names, u.sizes, strict=True)}
        free = [*at.free, *(Free(name, -math.inf, math.inf, size) for name, size in sizes_of.items())]
        settings = {name: value for u in chosen for name, value in u.settings.items()}
        # Terms start at zero, so the objective can only decrease.
        fitted = fit(problem, free, {**at.values, **settings}, at.noise, iterations=SCREEN_ITERATIONS)
        refitted = []
        for u in chosen:
            sizes = tuple(fitted.values[name] for name in u.names)
            gain = 0.5 * float(np.array(sizes) @ fitted.marginal(u.names) @ np.array(sizes))  # beside all other terms
            refitted.append(replace(u, gain=gain, sizes=sizes))
        refitted.sort(key=lambda u: price * len(u.names) - u.gain / problem.scatter)
        if not is_chance(refitted[-1], refitted[-1].gain):
            break
        chosen = refitted[:-1]
    else:
        return Leftover()
    first = refitted[0]
    share = None
    if first.equation in problem.layout.forced and not problem.trusted:
        place = problem.layout.forced.index(first.equation)
        share = 1.0 - math.exp(float(fitted.noise.power[place] - without.noise.power[place]))
    like = ""
    if first.shape is not None:
        where = first.equation, first.signal
        own = [(u.shape, u.sizes) for u in refitted if u.shape and (u.equation, u.signal) == where]
        like = law_of(own, signals, is_rate={*problem.layout.rates.values()}.issuperset(first.shape.of))
    logs = range(max(2, len(problem.logs)))
    of_logs = [[terms[k] for k in likeliest([test.gain_without(rows_of[u], log) for u in terms])] for log in logs]
    return Leftover(
        (replace(first, share=share, like=like), *refitted[1:]),
        fitted,
        without.objective - fitted.objective,
        among,
        is_stable=all(any(u.signal == first.signal for u in likely) for likely in of_logs),
        is_placed=all(any(u.equation == first.equation for u in likely) for likely in of_logs),
    )
