"""How far apart an input drives rival hypotheses: T-optimality, by the filter that will judge the log.

After Atkinson and Fedorov (1975): an input is as good as what it leaves between two models when the parameters of the
one are adapted to the other. What is compared are innovations, as `refine` will see them, so that a disturbance
that is plainly seen hides here what it hides there. With e the innovations, s their variances and θ what may adapt:
    D² = min over δ of Σ (e_a − e_b − ∂e_b/∂θ·δ)²/s + Σ (δ/σ)²,  σ the prior of a base parameter
D counts standard deviations; the log-likelihood to be expected is ½·D².
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import least_squares
from cosim.estimation.data import as_data, unscored
from cosim.estimation.fit import DIFFERENCE
from cosim.estimation.noise_model import Noise
from cosim.estimation.posing import coarsened, start_state
from cosim.estimation.problem import Problem
from cosim.estimation.readings import readings_of
from cosim.logs.log import Log
from cosim.model.quantities import Parameter
from cosim.subject.base_parameters import base_parameters
from cosim.subject.candidates import Candidate, Free
from cosim.subject.interface import Subject

WRONG_BY = 0.2  # of its value: a base parameter that is wrong; suspect ones by the size of their fits
Pair = tuple[str, str]


@dataclass(frozen=True)
class Rival:
    """A hypothesis: where its parameters stand if it is true, and what its fit may move."""

    name: str
    values: Mapping[str, float]
    free: tuple[Free, ...]


def at_typical(subject: Subject, candidate: Candidate) -> Rival:
    """A candidate at a size that is plainly detected: `typical` away from neutral; a base parameter 20 % wrong."""
    if candidate.kind == "parameter":
        (free,) = candidate.free
        value = subject.values[free.name]
        wrong = WRONG_BY * abs(value) if free.name in subject.calibrated else free.size
        return Rival(candidate.name, {free.name: value + wrong}, candidate.free)
    values = {name: _plainly_seen(subject.declared[name]) for name in candidate.parameters}
    return Rival(candidate.name, values, candidate.free)


def _plainly_seen(p: Parameter) -> float:
    return float(p.default) if p.neutral is None or p.typical is None else p.neutral + p.typical


def all_pairs(names: Iterable[str]) -> list[Pair]:
    """Every two of them."""
    return list(combinations(names, 2))


class Separation:
    """Measures inputs: `problem` has the kernel, `rivals` the hypotheses, `pairs` those that are to be separated."""

    def __init__(self, subject: Subject, problem: Problem, rivals: Sequence[Rival], pairs: Sequence[Pair]) -> None:
        self.subject, self.problem, self.pairs = subject, problem, tuple(pairs)
        self.rivals = {r.name: r for r in rivals}
        self.base = base_parameters(subject, problem.values, problem.settings.tolerance)
        self.noise, self.substeps = problem.plain, coarsened(problem).logs[0].substeps

    def of(self, log: Log) -> dict[Pair, float]:
        """Distance [standard deviations] of each pair on a log of the model without noise."""
        layout = self.problem.layout
        data = replace(as_data(self.subject, log, layout, self.problem.settle), substeps=self.substeps)
        start = start_state(self.subject, data, layout.outputs, layout.states)
        readings = [readings_of(data.y, unscored(data))]
        seen = _Innovations(replace(self.problem, logs=[data], readings=readings, x0=[start]), self.noise)
        shift = {name: seen.at(r.values) for name, r in self.rivals.items()}
        own = {name: seen.slopes(r.free, r.values, shift[name]) for name, r in self.rivals.items()}
        base = seen.slopes(self.base, {}, np.zeros(seen.count))
        return {
            pair: min(self._adapted(shift[a] - shift[b], own[b], base, self.rivals[b]) for a, b in self._ways(pair))
            for pair in self.pairs
        }

    def _ways(self, pair: Pair) -> list[Pair]:
        """(truth, adapted): the simpler hypothesis is adapted to the richer one, which could always mimic it."""
        a, b = pair
        more = len(self.rivals[a].free) - len(self.rivals[b].free)
        return [*([(a, b)] if more >= 0 else []), *([(b, a)] if more <= 0 else [])]

    def _adapted(self, apart: Array, own: Array, base: Array, adapted: Rival) -> float:
        """What is left between two hypotheses after one has moved its parameters and the base's."""
        loose = {f.name for f in adapted.free}
        kept = [k for k, f in enumerate(self.base) if f.name not in loose]
        slopes = np.vstack([own, base[kept]]).T
        # one row a prior: δ in units of the parameter's size
        priors = np.zeros((len(kept), slopes.shape[1]))
        for row, k in enumerate(kept):
            if prior := self.base[k].prior:
                priors[row, len(own) + row] = self.base[k].size / prior[1]
        A, b = np.vstack([slopes, priors]), np.concatenate([apart, np.zeros(len(kept))])
        return float(np.linalg.norm(b - A @ least_squares(A, b)))


class _Innovations:
    """Innovations [standard deviations] against those of the base values."""

    def __init__(self, problem: Problem, noise: Noise) -> None:
        self.problem, self.noise = problem, noise
        scored = problem.scored(problem.values, noise)
        self.errors, self.sigma = scored.errors, np.sqrt(scored.variances)
        self.count = len(self.errors)

    def at(self, values: Mapping[str, float]) -> Array:
        """By how much they differ at other values; not at all where the filter diverges."""
        errors = self.problem.scored({**self.problem.values, **values}, self.noise).errors
        return np.asarray(np.nan_to_num((errors - self.errors) / self.sigma, nan=0.0, posinf=0.0, neginf=0.0))

    def slopes(self, free: Sequence[Free], values: Mapping[str, float], there: Array) -> Array:
        """Their derivatives by parameters, per size, shape (parameters, measurements); `there` they are at `values`."""
        rows = np.empty((len(free), self.count))
        for row, f in zip(rows, free, strict=True):
            here = values.get(f.name, self.problem.values[f.name])
            h = DIFFERENCE * f.size if here + DIFFERENCE * f.size <= f.high else -DIFFERENCE * f.size
            row[:] = (self.at({**values, f.name: here + h}) - there) * (f.size / h)
        return rows
