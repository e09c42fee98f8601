"""Choice of the nearest model for an incomplete claim, by cross-validation over the estimation logs.

The nearest model is a hypothesis close to a claim, the recalibrated model, or the given model. Sealed logs are not
used. Errors are kernel replays over the model's own horizon from the filtered state.
"""

from __future__ import annotations

from collections.abc import Sequence

from cosim.estimation.fit import Fit
from cosim.estimation.posing import halve_log
from cosim.refinement.decision.evidence import as_given, learnt_without, open_loop
from cosim.refinement.decision.trust import size
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis

SIMPLER = 0.01  # difference of log error within which the simpler model is chosen


def nearest(search: Search, a: Attribution, best: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the best predictor of held-out logs, None for the given model.

    Args:
        best: Hypotheses close to a claim, simplest first.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)
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
