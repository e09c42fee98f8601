"""Rao's score test at a fit: predicted likelihood gain of further terms, by one filter run per parameter.

Let r be the normalised innovations, variances and priors, [e/√s; (1 − e²/s)/√2; (θ − μ)/σ], and X the sensitivities of
r to the free parameters. For terms with sensitivities R, the predicted gain is ½·‖P·r‖², where P projects on the part
of R orthogonal to X. Removing a part of the hypothesis is predicted likewise: r becomes r − R·(steps from neutral).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from cosim.core.arrays import Array, NamedValues
from cosim.core.linear_algebra import least_squares, orthonormal, pseudo_inverse
from cosim.estimation.fit import DIFFERENCE, NOISE_DIFFERENCE, Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Noise, Problem
from cosim.estimation.subject.candidates import Candidate

DIFFERENCE_SHARE = 0.3  # share of an effect's usual size for its difference, since kinks may be away from neutral
RANK = float(np.sqrt(np.finfo(float).eps))  # share of the residual, or of a singular value, that counts as none


@dataclass(frozen=True, eq=False)
class Terms:
    """Effect of a candidate on the innovations at a fit.

    Attributes:
        rows: Change of the innovations by the step of each term, without the part that free parameters can reproduce.
        steps: Step of each parameter (column) for each term (row).
        identifiable: Largest χ² of a term at its usual size.
        switched: True if even a tiny step has a large effect, so that small steps are not informative.
    """

    candidate: Candidate
    rows: Array
    steps: Array
    identifiable: float
    switched: bool = False


@dataclass(frozen=True)
class Promise:
    """Predicted result of adding candidates.

    Attributes:
        gain: Predicted log-likelihood gain.
        values: Linear estimates of the parameters.
        within: True if the estimates respect their limits.
    """

    gain: float
    values: NamedValues
    within: bool


class ScoreTest:
    """Score test with one filter run for each free parameter of a fit.

    Args:
        parts: Candidates in the fitted hypothesis, which the test may remove.
    """

    def __init__(self, problem: Problem, at: Fit, parts: Sequence[Candidate] = ()) -> None:
        self.problem, self.at = problem, at
        self.values = {**problem.values, **at.values}
        self.noise = at.noise
        self.scored = problem.score(self.values, self.noise)
        priors = {f.name: f.prior for f in at.free if f.prior}
        self.priors = {name: k for k, name in enumerate(priors)}
        self.sigma = np.array([sigma for _, sigma in priors.values()]) / np.sqrt(problem.scatter)
        e, s = self.scored.errors, self.scored.variances
        offsets = np.array([self.values[name] - mean for name, (mean, _) in priors.items()])
        residual = np.concatenate([e / np.sqrt(s), (1.0 - e * e / s) / np.sqrt(2), offsets / self.sigma])
        on_trial = {name for c in parts for name in c.parameters}
        moves = [({f.name: DIFFERENCE * f.size}, self.noise) for f in at.free if f.name not in on_trial]
        for k in problem.limits.free:
            vector = self.noise.vector
            vector[k] += NOISE_DIFFERENCE
            moves.append(({}, self.noise.like(vector)))
        rows = in_parallel(lambda move: self._row(*move), moves)
        self.basis = orthonormal(np.array(rows).reshape(len(moves), residual.size).T)  # for steps of any size
        self.residual = self._project(residual)

    def _project(self, row: Array) -> Array:
        """Return the part of a row that is orthogonal to the effects of the free parameters."""
        return row - self.basis @ (self.basis.T @ row)

    def row(self, steps: NamedValues) -> Array:
        """Return the projected change of the innovations by parameter steps; zero if the model diverges."""
        with np.errstate(over="ignore", invalid="ignore"):
            row = self._project(self._row(steps, self.noise))
            return row if np.isfinite(row @ row) else np.zeros_like(row)

    def gain_without(self, rows: Sequence[Array], part: int) -> float:
        """Return the predicted joint gain of terms on all logs but one, or on half of a single log."""
        counts = self.scored.counts
        counts = counts if len(counts) > 1 else (counts[0] // 2, counts[0] - counts[0] // 2)
        of_part = np.repeat(np.arange(len(counts)), counts) == part
        others = ~np.concatenate([of_part, of_part, np.zeros(len(self.residual) - 2 * of_part.size, bool)])
        kept, matrix = self.residual[others], np.array(rows).T[others]
        return 0.5 * float(np.sum((matrix @ least_squares(matrix, kept, rcond=RANK)) ** 2))

    def gain(self, rows: Sequence[Array]) -> tuple[float, Array]:
        """Return the predicted joint gain of terms, and the optimal multiple of each term's step."""
        detected = np.array([r if r @ r > RANK**2 * (self.residual @ self.residual) else 0.0 * r for r in rows])
        multiples = -least_squares(detected.T, self.residual, rcond=RANK)
        fitted = detected.T @ multiples
        return 0.5 * float(fitted @ fitted), multiples

    def terms(self, c: Candidate) -> Terms:
        """Return a candidate's terms: steps from neutral to its usual size if inactive, else around fitted values."""
        if c.kind == "parameter" and c.parameters[0] in self.priors:  # a parameter that is tested loses its prior
            row = np.zeros(self.residual.size)
            row[len(row) - len(self.priors) + self.priors[c.parameters[0]]] = 1.0
            return Terms(c, self._project(row)[None, :], np.zeros((1, 1)), np.inf)
        at_neutral = all(f.neutral is None or self.values[f.name] == f.neutral for f in c.free)
        distances = np.array([c.starts[0][n] - self.values[n] for n in c.parameters])
        switched, scale = False, 1.0 if at_neutral else DIFFERENCE_SHARE / DIFFERENCE
        is_absent = at_neutral and c.kind != "parameter" and bool(distances.any())
        if is_absent:
            steps = np.diag(DIFFERENCE_SHARE * distances)[distances != 0.0]
            if len(steps) > 1:  # joint and single
                steps = np.vstack([DIFFERENCE_SHARE * distances, steps])
        else:  # linear, each from a finite step of one parameter
            sizes = [DIFFERENCE_SHARE / scale * f.size for f in c.free]
            over = [self.values[f.name] + size > f.high for f, size in zip(c.free, sizes, strict=True)]
            steps = np.diag(np.where(over, -1.0, 1.0) * sizes)
        rows = [scale * self.row(dict(zip(c.parameters, step, strict=True))) for step in steps]
        if is_absent:
            jump = self.row(dict(zip(c.parameters, DIFFERENCE * distances, strict=True)))
            # detectable, and more than half of the effect of the large step
            switched = float(jump @ jump) > max(1.0, 0.5 * float(rows[0] @ rows[0]))
        innovations = [r[: len(self.scored.errors)] for r in rows]
        identifiable = max((float(r @ r) for r in innovations), default=0.0) / DIFFERENCE_SHARE**2
        return Terms(c, np.array(rows), scale * steps, identifiable, switched)

    def _row(self, steps: NamedValues, noise: Noise) -> Array:
        moved = {**self.values, **{name: self.values[name] + d for name, d in steps.items()}}
        other = self.problem.score(moved, noise)
        e, s = self.scored.errors, self.scored.variances
        offsets = np.array([steps.get(name, 0.0) for name in self.priors]) / self.sigma
        with np.errstate(invalid="ignore", over="ignore"):
            row = np.concatenate([(other.errors - e) / np.sqrt(s), np.log(other.variances / s) / np.sqrt(2), offsets])
        return np.asarray(np.nan_to_num(row, posinf=0.0, neginf=0.0))


class Choice:
    """Predictions for any set of candidates at a fit, from inner products of their terms.

    Attributes:
        parts: Names of the candidates in the fitted hypothesis.
        neutral: Parameter values without any candidate.
    """

    def __init__(
        self, test: ScoreTest, every: Iterable[Terms], parts: Sequence[Candidate], neutral: NamedValues
    ) -> None:
        self.test, self.neutral = test, neutral
        self.terms = {t.candidate.name: t for t in every if len(t.rows)}
        self.parts = {c.name for c in parts}
        edges = accumulate((len(t.rows) for t in self.terms.values()), initial=0)
        self.places = {name: range(*ends) for name, ends in zip(self.terms, pairwise(edges), strict=True)}
        rows = np.vstack([np.zeros((0, test.residual.size)), *(t.rows for t in self.terms.values())])
        self.products, self.against = rows @ rows.T, rows @ test.residual
        self.square = float(test.residual @ test.residual)

    def promise(self, names: Sequence[str]) -> Promise:
        """Return the predicted result for a set of candidates.

        The gain may be negative for a set without some candidate of the fitted hypothesis.
        """
        back = np.zeros(len(self.against))  # steps of the removed parts from fitted values to neutral
        for name in self.parts - {*names}:
            t = self.terms[name]
            away = [self.neutral[n] - self.test.values[n] for n in t.candidate.parameters]
            back[self.places[name]] = np.divide(away, t.steps, out=0.0 * t.steps, where=t.steps != 0.0).sum(axis=1)
        places = [k for name in names for k in self.places[name]]
        # r without the removed parts is r + R·back
        against = self.against + self.products @ back
        square = self.square + 2.0 * float(self.against @ back) + float(back @ self.products @ back)
        G, b = self.products[np.ix_(places, places)], against[places]
        scale = np.sqrt(np.diag(G).clip(min=np.finfo(float).tiny))
        scaled = least_squares(G / np.outer(scale, scale), -b / scale, rcond=RANK) / scale
        remaining = square + 2.0 * float(b @ scaled) + float(scaled @ G @ scaled)
        sigma = np.sqrt(np.diag(pseudo_inverse(G / np.outer(scale, scale))).clip(min=0.0)) / scale
        multiples, spread = np.zeros((2, len(against)))
        multiples[places], spread[places] = scaled, sigma
        values: dict[str, float] = {}
        within = True
        for name in names:
            t, rows = self.terms[name], self.places[name]
            names_of = t.candidate.parameters
            own = np.array([self.test.values[n] for n in names_of])
            estimates = dict(zip(names_of, own + multiples[rows] @ t.steps, strict=True))
            slacks = spread[rows] @ np.abs(t.steps)  # estimates may exceed a limit by a standard deviation
            for f, slack in zip(t.candidate.free, slacks.tolist(), strict=True):
                low = max(f.low, estimates.get(f.above, f.low))
                is_valid = f.neutral is None or low - slack <= estimates[f.name] <= f.high + slack
                # An effect of the model may be removed completely; a larger removal stops at zero.
                within = within and (is_valid or self.neutral[f.name] != f.neutral)
                values[f.name] = float(np.clip(estimates[f.name], low, f.high))
        return Promise(0.5 * (self.square - remaining), values, within)

    def extensions(self, names: Sequence[str]) -> dict[str, Promise]:
        """Return further candidate → prediction for the set extended by this candidate, best first."""
        promises = {n: self.promise([*names, n]) for n in self.terms if n not in names}
        return dict(sorted(promises.items(), key=lambda item: -item[1].gain))
