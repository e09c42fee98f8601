"""What a table says beside a verdict: errors on rows left out, and whether what is left goes with an input.

A table has no equation of a state in which something could act. What is left of an output is noise where neighbours
over an input are no more alike than others; else something goes with that input that no hypothesis says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import percent, size
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import learnt_without, open_loop
from cosim.refinement.decision.sentences import follows, partly, unexplained
from cosim.refinement.decision.verdict import Verdict
from cosim.refinement.proof.replay_check import PART
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.subject.interface import Subject

FEWEST = 8  # rows, below which neighbours tell nothing
PLAIN = 3.0  # standard deviations of their correlation, from which they are alike
Channels = dict[str, float]


def errors_left_out(search: Search, a: Attribution, verdict: Verdict, near: Hypothesis | None) -> dict[str, Channels]:
    """Before, recalibrated, after, nearest → output → root mean square on rows left out, fitted to the others."""
    given = _missed(search, None)
    found = {"before": given, "recalibrated": _missed(search, a.base)}
    found["after"] = _missed(search, verdict.claimed) if verdict.claimed else given
    return found if verdict.grade == "claimed" else {**found, "nearest": _missed(search, near)}


def _missed(search: Search, h: Hypothesis | None) -> Channels:
    """Of one hypothesis; None: the model as it was given, of which nothing is fitted."""
    problem, rows = search.problem, []
    for k in range(len(problem.logs)):
        fit = search.tried[()].fit if h is None else learnt_without(search, problem, h, k)
        values = problem.values if h is None else fit.values
        rows.append(open_loop(problem, search.subject.horizon, values, fit, k)[:, 0])
    left = np.vstack(rows)
    sizes = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return dict(zip(problem.layout.outputs, sizes, strict=True))


def with_leftover(verdict: Verdict, a: Attribution, problem: Problem, subject: Subject) -> Verdict:
    """The verdict, and what of an output goes with an input beside the best hypothesis, where something does."""
    left = _leftover(problem, a.best, subject)
    if left is None:
        return verdict
    output, signal = left
    verdict = replace(verdict, residual={**verdict.residual, "equation": output, "signals": [signal]})
    if verdict.claimed is None:
        if verdict.name == "unexplained":
            return verdict
        sentence = unexplained(verdict.residual, ())
        return replace(verdict, name="unexplained", rivals=(), experiment="", sentence=sentence)
    column = problem.layout.outputs.index(output)
    kept = _sizes(problem, verdict.claimed)[column] ** 2 / _sizes(problem, a.base)[column] ** 2
    if verdict.name != "ambiguous" and kept > PART:
        share = f"{percent(kept)} of the mean square error of {output}, as the model recalibrated has it, is left"
        return replace(verdict, grade="part", sentence=partly(verdict.sentence, verdict.residual, share))
    return replace(verdict, sentence=f"{verdict.sentence} Something is left of {output} that {follows(signal)}.")


def _leftover(problem: Problem, h: Hypothesis, subject: Subject) -> tuple[str, str] | None:
    """Output and input over which what is left goes most, where neighbours are plainly alike.

    By Σ r_k·r_k+1 / Σ r² of the ranks r of what is left, about their mean, in the order of the input: of noise it is
    0 ± 1/√n, be it larger here than there (Bartels 1982). A dozen rows are too few to tell.
    """
    u, left = np.vstack([log.u for log in problem.logs]), _left(problem, h)
    most: float = PLAIN
    found: tuple[str, str] | None = None
    for j, output in enumerate(problem.layout.outputs):
        seen = np.isfinite(left[:, j])
        for i, q in enumerate(subject.inputs):
            if seen.sum() < FEWEST or not np.ptp(u[seen, i]):
                continue
            e = left[seen, j][np.argsort(u[seen, i], kind="stable")]
            ranks = np.argsort(np.argsort(e, kind="stable"), kind="stable") - 0.5 * (e.size - 1)
            if (alike := float(ranks[1:] @ ranks[:-1] / (ranks @ ranks)) * math.sqrt(e.size)) > most:
                most, found = alike, (output, q.name)
    return found


def _left(problem: Problem, h: Hypothesis) -> Array:
    """Measured − model of every row: rows, outputs."""
    return np.vstack([open_loop(problem, 0.0, h.fit.values, h.fit, k)[:, 0] for k in range(len(problem.logs))])


def _sizes(problem: Problem, h: Hypothesis) -> Array:
    """Root mean square of what is left of each output."""
    return np.asarray(np.sqrt(np.nanmean(_left(problem, h) ** 2, axis=0)))


def on_rows_left_out(errors: Mapping[str, Channels], verdict: Verdict, subject: Subject) -> str:
    """The errors on rows left out, in words: of what is claimed, or of the model recalibrated, and without it."""
    units = {q.name: q.unit for q in subject.outputs}
    effect = verdict.claimed is not None and any(c.kind != "parameter" for c in verdict.claimed.candidates)
    best, other = ("after", "recalibrated") if effect else ("recalibrated", "before")
    who, without = ("the model", "without it") if effect else ("the model recalibrated", "as it is")
    missed = " and ".join(f"{size(v, units[n])} in {n}" for n, v in errors[best].items())
    before = " and ".join(size(v, units[n]) for n, v in errors[other].items())
    return f"On rows left out, fitted to the others, {who} is off by {missed}; {without}, by {before}."
