"""Choice of the nearest model for an incomplete claim, by cross-validation over the estimation logs.

The nearest model is a hypothesis close to a claim, the recalibrated model, or the given model. Sealed logs are not
used. Errors are kernel replays over the model's own horizon from the filtered state.
"""

from __future__ import annotations

from collections.abc import Sequence

from cosim.estimation.posing import halved
from cosim.refinement.decision.evidence import fit_given_model, fit_without, log_error
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis

SIMPLER = 0.01  # difference of log error within which the simpler model is chosen


def nearest(search: Search, a: Attribution, best: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the best predictor of held-out logs, None for the given model.

    Args:
        best: Hypotheses close to a claim, simplest first.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halved(search.problem)
    hypotheses: list[Hypothesis | None] = [None, a.base, *best]
    errors = []
    for h in hypotheses:
        logs = range(len(problem.logs))
        fits = [fit_without(search, problem, h, k) if h else fit_given_model(problem, a.base.fit, k) for k in logs]
        errors.append(log_error(problem, search.subject.horizon, fits))
    return next(h for h, error in zip(hypotheses, errors, strict=True) if error <= min(errors) + SIMPLER)
