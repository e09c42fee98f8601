"""Is something left that no effect of the catalogue is? Terms without a name, one signal each, tried by a score test.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state promises a gain of ½·g²/F, with F the
information of c after the other free parameters are accounted for. No term is fitted; those that promise most say in
which equation the misfit sits and on which signal it depends.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from cosim.refine.fit import Fit, Problem
from cosim.refine.screen import ScoreTest

SMALL = 0.1  # of a disturbance that is plainly seen within a second, for the difference of a term


@dataclass(frozen=True)
class Unnamed:
    """A term without a name: equation (the forced state), signal, promised gain in log-likelihood, coefficient."""

    equation: str
    signal: str
    gain: float
    coefficient: float


def unnamed_terms(problem: Problem, at: Fit) -> list[Unnamed]:
    """All terms, the most promising first; `problem` is built with them, `at` is a fit of the same logs without."""
    test = ScoreTest(problem, at)
    generated = problem.kernel.generated
    forced = [generated.states[generated.stochastic[k]] for k in generated.noisy]
    steps = dict(zip(forced, SMALL * np.sqrt(np.exp(problem.noise.plain)), strict=True))

    def term(name: str) -> Unnamed:
        _, equation, signal = name.split(".", 2)
        gain, (taken,) = test.gain([test.row({name: steps[equation]})])
        return Unnamed(equation, signal, gain, float(taken * steps[equation]))

    names = [name for name in generated.parameters if name.startswith("unnamed.")]
    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        found = list(pool.map(term, names))
    return sorted((u for u in found if u.gain > 0.0), key=lambda u: -u.gain)
