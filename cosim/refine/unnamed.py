"""Is something left that no effect of the catalogue is? Terms without a name, one signal each, tried by a score test.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state promises a gain of ½·g²/F, with F the
information of c after the other free parameters are accounted for. No term is fitted; those that promise most say in
which equation the misfit sits and on which signal it depends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.refine.fit import DIFFERENCE, Q_DIFFERENCE, Fit, Problem

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
    values = {**problem.values, **at.values}
    log_q = np.maximum(at.log_q, problem.noise.smallest)
    scored = problem.scored(values, log_q)
    e, s = scored.errors, scored.variances

    def sensitivity(name: str | None, k: int, h: float) -> np.ndarray:
        moved, q = dict(values), log_q.copy()
        if name is None:
            q[k] += h
        else:
            moved[name] += h
        other = problem.scored(moved, q)
        rows = np.vstack([(other.errors - e) / np.sqrt(s), np.log(other.variances / s) / np.sqrt(2)]) / h
        return np.nan_to_num(rows.ravel())

    known = [sensitivity(f.name, 0, DIFFERENCE * f.size) * f.size for f in at.free]
    known += [sensitivity(None, k, Q_DIFFERENCE) for k in range(len(log_q))]
    residual = np.vstack([e / np.sqrt(s), (1.0 - e * e / s) / np.sqrt(2)]).ravel()
    basis, _ = np.linalg.qr(np.array(known).T)
    residual = residual - basis @ (basis.T @ residual)
    generated = problem.kernel.generated
    forced = [generated.states[generated.stochastic[k]] for k in generated.noisy]
    steps = dict(zip(forced, SMALL * np.sqrt(np.exp(problem.noise.plain)), strict=True))
    found = []
    for name in generated.parameters:
        if not name.startswith("unnamed."):
            continue
        _, equation, signal = name.split(".", 2)
        row = sensitivity(name, 0, steps[equation])
        row = row - basis @ (basis.T @ row)
        F = float(row @ row)
        g = float(row @ residual)
        if float(residual @ residual) * 1e-12 < F:
            found.append(Unnamed(equation, signal, 0.5 * g * g / F, -g / F))
    return sorted(found, key=lambda u: -u.gain)
