"""Separation of rival hypotheses by an input: T-optimality with the filter of the later refinement.

After Atkinson and Fedorov (1975): the value of an input is the remaining difference between two models after the
parameters of one model have been fitted to the other. Innovations are compared, as in `refine`, so that disturbances
hide the same differences. With e the innovations, s their variances and θ the fitted parameters:

    D² = min over δ of Σ (e_a − e_b − ∂e_b/∂θ·δ)²/s + Σ (δ/σ)²,  σ the prior of a base parameter

D is in standard deviations; the expected log-likelihood gain is ½·D².
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares
from cosim.estimation.data import data_of, readings_of, start_state
from cosim.estimation.fit import DIFFERENCE
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate, Free, base_parameters
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import Log

PARAMETER_ERROR = 0.2  # relative error of a wrong base parameter; suspect parameters use the size of their fits
MIN_SEPARATION = 3.0  # standard deviations between rivals that a log needs for a decision
Pair = tuple[str, str]


@dataclass(frozen=True)
class Rival:
    """A hypothesis: its true parameter values and its free parameters."""

    name: str
    values: Mapping[str, float]
    free: tuple[Free, ...]


def typical_rival(subject: Subject, candidate: Candidate) -> Rival:
    """Return a rival in which a candidate has a clearly detectable size.

    An effect differs from its neutral value by its `typical` size. A base parameter has an error of 20 %.
    """
    if candidate.kind == "parameter":
        (free,) = candidate.free
        value = subject.values[free.name]
        wrong = PARAMETER_ERROR * abs(value) if free.name in subject.calibrated else free.size
        return Rival(candidate.name, {free.name: value + wrong}, candidate.free)
    declared = [(name, subject.declared[name]) for name in candidate.parameters]
    values = {
        name: float(p.default) if p.neutral is None or p.typical is None else p.neutral + p.typical
        for name, p in declared
    }
    return Rival(candidate.name, values, candidate.free)


def separation(
    subject: Subject, problem: Problem, substeps: int, rivals: Sequence[Rival], pairs: Sequence[Pair], log: Log
) -> dict[Pair, float]:
    """Return the distance of each pair of rivals on a noise-free log [standard deviations].

    Args:
        problem: Fitting problem with the kernel.
        substeps: Number of integration substeps per row.
        rivals: Hypotheses at a detectable size.
    """
    layout, noise, named = problem.layout, problem.plain, {r.name: r for r in rivals}
    free_base = base_parameters(subject, problem.values, problem.settings.tolerance)
    data = replace(data_of(subject, log, layout), substeps=substeps)
    start = start_state(subject, data, layout.outputs, layout.states)
    problem = replace(problem, logs=[data], readings=[readings_of(data)], x0=[start])
    scored = problem.score(problem.values, noise)
    sigma, count = np.sqrt(scored.variances), len(scored.errors)

    def change(values: Mapping[str, float]) -> Array:
        """Return the change of the filter's innovations at parameter values, 0 for a diverged filter."""
        errors = problem.score({**problem.values, **values}, noise).errors
        return np.asarray(np.nan_to_num((errors - scored.errors) / sigma, nan=0.0, posinf=0.0, neginf=0.0))

    def slopes(free: Sequence[Free], values: Mapping[str, float], shift: Array) -> Array:
        """Return the derivatives by scaled parameters at `values`, shape (parameters, measurements)."""
        rows = np.empty((len(free), count))
        for row, f in zip(rows, free, strict=True):
            value = values.get(f.name, problem.values[f.name])
            h = DIFFERENCE * f.size if value + DIFFERENCE * f.size <= f.high else -DIFFERENCE * f.size
            row[:] = (change({**values, f.name: value + h}) - shift) * (f.size / h)
        return rows

    shift = {r.name: change(r.values) for r in rivals}
    own = {r.name: slopes(r.free, r.values, shift[r.name]) for r in rivals}
    base = slopes(free_base, {}, np.zeros(count))

    def distance(truth: str, adapted: str) -> float:
        """Return the remaining distance after fitting the free parameters of one hypothesis and of the base."""
        names = {f.name for f in named[adapted].free}
        others = [k for k, f in enumerate(free_base) if f.name not in names]
        design = np.vstack([own[adapted], base[others]]).T
        # one row per prior, δ in units of the parameter's size
        priors = np.zeros((len(others), design.shape[1]))
        for row, k in enumerate(others):
            if prior := free_base[k].prior:
                priors[row, len(own[adapted]) + row] = free_base[k].size / prior[1]
        A = np.vstack([design, priors])
        b = np.concatenate([shift[truth] - shift[adapted], np.zeros(len(others))])
        return float(np.linalg.norm(b - A @ least_squares(A, b)))

    # Only the hypothesis with fewer free parameters is fitted: one with more could reproduce the other.
    return {
        (a, b): min(distance(*way) for way in ((a, b), (b, a)) if len(own[way[0]]) >= len(own[way[1]]))
        for a, b in pairs
    }
