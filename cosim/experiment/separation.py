"""Separation of rival hypotheses by an input: T-optimality with the filter of the later refinement.

After Atkinson and Fedorov (1975): the value of an input is the remaining difference of two models after the parameters
of one model are adapted to the other. Innovations are compared, as in `refine`, so that a visible disturbance hides the
same differences. With e the innovations, s their variances and θ the adaptable parameters:

    D² = min over δ of Σ (e_a − e_b − ∂e_b/∂θ·δ)²/s + Σ (δ/σ)²,  σ the prior of a base parameter

D counts standard deviations; the expected log-likelihood is ½·D².
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import least_squares
from cosim.estimation.data import count_unscored, data_of
from cosim.estimation.fit import DIFFERENCE
from cosim.estimation.noise_model import Noise
from cosim.estimation.posing import coarsen
from cosim.estimation.problem import Problem
from cosim.estimation.readings import readings_of
from cosim.logs.log import Log
from cosim.model.quantities import Parameter
from cosim.subject.base_parameters import base_parameters
from cosim.subject.candidates import Candidate, Free
from cosim.subject.interface import Subject
from cosim.subject.start_state import start_state

PARAMETER_ERROR = 0.2  # relative error of a wrong base parameter; suspect parameters use the size of their fits
Pair = tuple[str, str]


@dataclass(frozen=True)
class Rival:
    """A hypothesis: its true parameter values and its free parameters."""

    name: str
    values: Mapping[str, float]
    free: tuple[Free, ...]


def typical_rival(subject: Subject, candidate: Candidate) -> Rival:
    """Return a rival in which a candidate has a clearly detectable size.

    An effect differs from its neutral value by its `typical` size. A base parameter is wrong by 20 %.
    """
    if candidate.kind == "parameter":
        (free,) = candidate.free
        value = subject.values[free.name]
        wrong = PARAMETER_ERROR * abs(value) if free.name in subject.calibrated else free.size
        return Rival(candidate.name, {free.name: value + wrong}, candidate.free)
    values = {name: _detectable_value(subject.declared[name]) for name in candidate.parameters}
    return Rival(candidate.name, values, candidate.free)


def _detectable_value(p: Parameter) -> float:
    return float(p.default) if p.neutral is None or p.typical is None else p.neutral + p.typical


def all_pairs(names: Iterable[str]) -> list[Pair]:
    """Return every pair of two different names."""
    return list(combinations(names, 2))


class Separation:
    """Measure of how well an input separates pairs of hypotheses.

    Args:
        problem: Fitting problem with the kernel.
        rivals: Hypotheses at a detectable size.
        pairs: Pairs of `rivals` to separate.
    """

    def __init__(self, subject: Subject, problem: Problem, rivals: Sequence[Rival], pairs: Sequence[Pair]) -> None:
        self.subject, self.problem, self.pairs = subject, problem, tuple(pairs)
        self.rivals = {r.name: r for r in rivals}
        self.base = base_parameters(subject, problem.values, problem.settings.tolerance)
        self.noise, self.substeps = problem.plain, coarsen(problem).logs[0].substeps

    def of(self, log: Log) -> dict[Pair, float]:
        """Return the distance of each pair of rivals on a noise-free log [standard deviations]."""
        layout = self.problem.layout
        data = replace(data_of(self.subject, log, layout, self.problem.settle), substeps=self.substeps)
        start = start_state(self.subject, data, layout.outputs, layout.states)
        readings = [readings_of(data.y, count_unscored(data))]
        innovations = _Innovations(replace(self.problem, logs=[data], readings=readings, x0=[start]), self.noise)
        shift = {name: innovations.at(r.values) for name, r in self.rivals.items()}
        own = {name: innovations.slopes(r.free, r.values, shift[name]) for name, r in self.rivals.items()}
        base = innovations.slopes(self.base, {}, np.zeros(innovations.count))

        def distance(truth: str, adapted: str) -> float:
            return self._remaining_distance(shift[truth] - shift[adapted], own[adapted], base, self.rivals[adapted])

        return {pair: min(distance(*way) for way in self._adaptations(*pair)) for pair in self.pairs}

    def _adaptations(self, a: str, b: str) -> list[Pair]:
        """Return the pairs (truth, adapted) to test; only the hypothesis with fewer free parameters is adapted.

        A hypothesis with more parameters could imitate the other.
        """
        counts = {name: len(self.rivals[name].free) for name in (a, b)}
        return [(truth, adapted) for truth, adapted in ((a, b), (b, a)) if counts[truth] >= counts[adapted]]

    def _remaining_distance(self, difference: Array, own: Array, base: Array, adapted: Rival) -> float:
        """Return the distance that remains after fitting the free parameters of one hypothesis and of the base.

        Args:
            difference: Difference of the innovations under both hypotheses.
            own, base: Derivatives of the innovations by the parameters of `adapted` and of the base.
        """
        names = {f.name for f in adapted.free}
        others = [k for k, f in enumerate(self.base) if f.name not in names]
        slopes = np.vstack([own, base[others]]).T
        # one row per prior, δ in units of the parameter's size
        priors = np.zeros((len(others), slopes.shape[1]))
        for row, k in enumerate(others):
            if prior := self.base[k].prior:
                priors[row, len(own) + row] = self.base[k].size / prior[1]
        A, b = np.vstack([slopes, priors]), np.concatenate([difference, np.zeros(len(others))])
        return float(np.linalg.norm(b - A @ least_squares(A, b)))


class _Innovations:
    """Changes of the filter's innovations from their values at the base parameters [standard deviations]."""

    def __init__(self, problem: Problem, noise: Noise) -> None:
        self.problem, self.noise = problem, noise
        scored = problem.score(problem.values, noise)
        self.errors, self.sigma = scored.errors, np.sqrt(scored.variances)
        self.count = len(self.errors)

    def at(self, values: Mapping[str, float]) -> Array:
        """Return the change of the innovations at parameter values, 0 for a diverged filter."""
        errors = self.problem.score({**self.problem.values, **values}, self.noise).errors
        return np.asarray(np.nan_to_num((errors - self.errors) / self.sigma, nan=0.0, posinf=0.0, neginf=0.0))

    def slopes(self, free: Sequence[Free], values: Mapping[str, float], shift: Array) -> Array:
        """Return the derivatives by scaled parameters, shape (parameters, measurements).

        Args:
            shift: Change of the innovations at `values`.
        """
        rows = np.empty((len(free), self.count))
        for row, f in zip(rows, free, strict=True):
            value = values.get(f.name, self.problem.values[f.name])
            h = DIFFERENCE * f.size if value + DIFFERENCE * f.size <= f.high else -DIFFERENCE * f.size
            row[:] = (self.at({**values, f.name: value + h}) - shift) * (f.size / h)
        return rows
