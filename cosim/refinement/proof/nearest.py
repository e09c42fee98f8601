"""The model that comes nearest, where not all is claimed: by predictions of each log, the others learnt from.

It may be the best hypothesis, claimed or not, the model recalibrated, or the model as it was given; sealed logs have no
say. Errors are those of replays over the model's own horizon, each from the filtered state, as the kernel runs them.
"""

from __future__ import annotations

from collections.abc import Sequence

from cosim.estimation.fit import Fit
from cosim.estimation.posing import halved
from cosim.refinement.decision.evidence import as_given, learnt_without, open_loop
from cosim.refinement.decision.trust import size
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis

SIMPLER = 0.01  # of the error, within which the simpler model is taken


def nearest(search: Search, a: Attribution, best: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the hypothesis that predicts logs left out best; None: the model as given.

    best: hypotheses that were nearly claimed, simplest first
    """
    problem = search.problem if len(search.problem.logs) > 1 else halved(search.problem)
    logs = range(len(problem.logs))
    found: list[tuple[float, Hypothesis | None]] = []

    def error(fits: Sequence[Fit]) -> float:
        missed = [open_loop(problem, search.subject.horizon, f.values, f, k) for k, f in zip(logs, fits, strict=True)]
        return size(missed)

    found.append((error([as_given(problem, a.base.fit, k) for k in logs]), None))
    for h in (a.base, *best):
        found.append((error([learnt_without(search, problem, h, k) for k in logs]), h))
    least = min(size for size, _ in found)
    return next(h for size, h in found if size <= least + SIMPLER)
