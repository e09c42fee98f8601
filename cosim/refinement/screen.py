"""Rao's score test at a fit: what one more term promises, for one filter run a parameter and without fitting it.

With r the normalised innovations, their spread and priors, [e/√s; (1 − e²/s)/√2; (θ − μ)/σ], and X the sensitivities
of r to what is free already, a term of sensitivities R promises ½·‖P·r‖²: P projects on what of R no X can mend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Array
from cosim.refinement.candidates import Candidate
from cosim.refinement.fit import DIFFERENCE, Q_DIFFERENCE, Fit
from cosim.refinement.problem import Problem

SHARE = 0.3  # of the size at which an effect is usually met, for its difference: its kinks are not at neutral alone
TINY = 1e-3  # of it, at which an effect that is switched on rather than grown differs by more than at SHARE
JUMP, DETECTED = 0.5, 1.0  # of that difference's square, and of one that can be detected
NOTHING = 1e-12  # of the residual's square, below which a term cannot be detected at all


@dataclass(frozen=True)
class Promise:
    """gain: of log-likelihood; identifiable: largest χ² of a usual size; values: estimates, linear in the sizes."""

    gain: float
    identifiable: float
    values: Mapping[str, float]


class ScoreTest:
    """Filters once more for each parameter that is free at a fit; then computes what a term promises beside them."""

    def __init__(self, problem: Problem, at: Fit) -> None:
        self.problem = problem
        self.values = {**problem.values, **at.values}
        self.log_q = np.maximum(at.log_q, problem.noise.smallest)
        self.scored = problem.scored(self.values, self.log_q)
        priors = [f for f in at.free if f.prior]
        self.held = {f.name: k for k, f in enumerate(priors)}
        self.sigma = np.array([f.prior[1] for f in priors if f.prior])
        e, s = self.scored.errors, self.scored.variances
        off = [(self.values[f.name] - f.prior[0]) / f.prior[1] for f in priors if f.prior]
        residual = np.concatenate([e / np.sqrt(s), (1.0 - e * e / s) / np.sqrt(2), off])
        known = [self._row({f.name: DIFFERENCE * f.size}) / DIFFERENCE for f in at.free]
        for k in range(len(self.log_q)):
            moved = self.log_q.copy()
            moved[k] += Q_DIFFERENCE
            known.append(self._row({}, moved) / Q_DIFFERENCE)
        self.basis, _ = np.linalg.qr(np.array(known).T)
        self.residual = residual - self.basis @ (self.basis.T @ residual)

    def row(self, steps: Mapping[str, float]) -> Array:
        """What finite steps of parameters change, less what the free ones can mend."""
        row = self._row(steps)
        return row - self.basis @ (self.basis.T @ row)

    def gain(self, rows: Sequence[Array]) -> tuple[float, Array]:
        """Promised gain of terms together, and how many steps of each they would take."""
        detected = np.array([r if r @ r > NOTHING * (self.residual @ self.residual) else 0.0 * r for r in rows])
        taken = -np.linalg.lstsq(detected.T, self.residual, rcond=1e-8)[0]
        fitted = detected.T @ taken
        return 0.5 * float(fitted @ fitted), taken

    def promise(self, c: Candidate) -> Promise | None:
        """What a candidate promises; None for one that is switched on rather than grown: no small step leads there."""
        here = {name: self.values[name] for name in c.parameters}
        away = {n: c.starts[0][n] - here[n] for n in c.parameters if c.starts[0][n] != here[n]}
        if away:
            steps = [{n: SHARE * d for n, d in away.items()}, *({n: SHARE * d} for n, d in away.items())]
            jump = self.row({n: TINY * d for n, d in away.items()})
            rows = [self.row(s) for s in (steps if len(away) > 1 else steps[:1])]
            if float(jump @ jump) > max(DETECTED, JUMP * float(rows[0] @ rows[0])):
                return None
        else:
            steps = [{f.name: SHARE * f.size} for f in c.free]
            rows = [self.row(s) for s in steps]
        gain, taken = self.gain(rows)
        values = dict(here)
        for count, step in zip(taken, steps, strict=False):
            for name, d in step.items():
                values[name] += count * d
        values = {f.name: float(np.clip(values[f.name], f.low, f.high)) for f in c.free}
        shown = [r[: len(self.scored.errors)] for r in rows]  # in what is read, not in how well the filter knows it
        return Promise(gain, max(float(r @ r) for r in shown) / SHARE**2, values)

    def _row(self, steps: Mapping[str, float], log_q: Array | None = None) -> Array:
        moved = {**self.values, **{name: self.values[name] + d for name, d in steps.items()}}
        other = self.problem.scored(moved, self.log_q if log_q is None else log_q)
        e, s = self.scored.errors, self.scored.variances
        held = np.zeros(len(self.held))
        for name in steps.keys() & self.held.keys():
            held[self.held[name]] = steps[name] / self.sigma[self.held[name]]
        with np.errstate(invalid="ignore", over="ignore"):
            row = np.concatenate([(other.errors - e) / np.sqrt(s), np.log(other.variances / s) / np.sqrt(2), held])
        return np.asarray(np.nan_to_num(row, posinf=0.0, neginf=0.0))
