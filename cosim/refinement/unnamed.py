"""Is something left that no effect of the catalogue is? Terms without a name, one signal each, tried by a score test.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state promises a gain of ½·g²/F, with F the
information of c after the other free parameters are accounted for. No term is fitted; those that promise most say in
which equation the misfit sits and on which signal it depends. Of terms that these logs do not
distinguish the simplest stands for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Array
from cosim.refinement.fit import Fit
from cosim.refinement.missing import LOGS, Filter, at_best, claimed, missing
from cosim.refinement.parallel import in_parallel
from cosim.refinement.problem import Problem
from cosim.refinement.screen import ScoreTest

SMALL = 0.1  # of a disturbance that is plainly detected within a second, for the difference of a term
NOTICED = 12.0  # promised log-likelihood from which a term without a name counts: half of BIC over a hundred terms
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


def unnamed_terms(problem: Problem, at: Fit) -> list[Unnamed]:
    """Terms, the most promising first; `problem` is built with them, `at` is a fit of the same logs without."""
    test = ScoreTest(problem, at)
    layout = problem.layout
    forced = layout.forced
    steps = dict(zip(forced, SMALL * np.sqrt(np.exp(problem.noise.plain)), strict=True))

    def term(name: str) -> tuple[Unnamed, Array]:
        _, equation, signal = name.split(".", 2)
        row = test.row({name: steps[equation]})
        gain, (taken,) = test.gain([row])
        return Unnamed(equation, signal, gain, float(taken * steps[equation]), gain), row

    names = [name for name in layout.parameters if name.startswith("unnamed.")]
    promising = [(u, row) for u, row in in_parallel(term, names) if u.gain > 0.0]
    distinct = (u for name in forced for u in _distinct([p for p in promising if p[0].equation == name]))
    terms = sorted(distinct, key=_promise)
    if terms and terms[0].most > NOTICED:
        terms[0] = replace(terms[0], share=_share(problem, at, terms[0]))
    return terms


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
    without = Filter(at.values, at.log_q)
    with_it = Filter({**at.values, f"unnamed.{u.equation}.{u.signal}": u.coefficient}, at.log_q)
    logs = range(min(LOGS, len(problem.logs)))
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [missing(problem, without, k) for k in logs]
        column = parts[0].equations.index(u.equation)
        lacking = np.concatenate([m.value[:, column] for m in parts])
        term = np.concatenate([claimed(problem, without, with_it, k)[:, column] for k in logs])
        left = float(np.mean((lacking - at_best(problem, at, logs, column, term, lacking)) ** 2))
        power = float(np.mean(lacking**2))
    return 1.0 - left / power if np.isfinite(left) and 0.0 < power < np.inf else None
