"""Choice of the nearest model for an incomplete claim, by cross-validation over the estimation logs.

The nearest model is a hypothesis close to a claim, a part of it, the recalibrated model, or the given model. Sealed
logs are not used. Errors are kernel replays over the model's own horizon from the filtered state. Of two models that
differ by less than one standard error over the logs, the simpler is chosen (Breiman et al. 1984).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.posing import halve_log
from cosim.refinement.decision.claims import Improvement, Rung, baseline_of
from cosim.refinement.decision.evidence import fit_given_model, fit_without, log_error
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis

SIMPLER = 0.01  # difference of log error within which the simpler model is chosen


def ladder(search: Search, a: Attribution, best: Sequence[Hypothesis]) -> tuple[Rung, ...]:
    """Return the errors of predictions of held-out logs, from the given model to the hypotheses, simplest first.

    Args:
        best: Hypotheses close to a claim.
    """
    problem = search.problem if len(search.problem.logs) > 1 else halve_log(search.problem)

    def errors(h: Hypothesis | None) -> Array:
        """Return the log error on each held-out log."""
        logs = range(len(problem.logs))
        fits = [fit_without(search, problem, h, k) if h else fit_given_model(problem, a.base.fit, k) for k in logs]
        return np.array([log_error(problem, search.subject.horizon, [f], [k]) for k, f in zip(logs, fits, strict=True)])

    hypotheses = sorted({h.names: h for h in (*_parts(search, best), *best)}.values(), key=lambda h: len(h.names))
    return tuple(Rung(h, errors(h)) for h in (None, a.base, *hypotheses))


def nearest(rungs: Sequence[Rung]) -> Hypothesis | None:
    """Return the simplest of the best predictors of held-out logs, None for the given model."""
    least = min(rungs, key=lambda rung: float(np.mean(rung.errors))).errors
    return next(rung.hypothesis for rung in rungs if is_as_good(rung.errors - least))


def held_out_improvement(rungs: Sequence[Rung], h: Hypothesis | None) -> Improvement | None:
    """Return the share of the squared error of predictions of held-out logs that remains with the nearest model.

    If no model is nearer than the given one, it is the share of the best other one. None if predictions diverge.

    Args:
        rungs: Ladder that begins with the given and the recalibrated model.
        h: Nearest model.
    """
    given, recalibrated = rungs[:2]
    others = [rung for rung in rungs[1:] if h is None or rung.hypothesis is h]
    own = min(others, key=lambda rung: float(np.mean(rung.errors))).errors
    baseline = baseline_of(h.candidates if h else ())
    before = given if baseline == "before" else recalibrated
    share = float(np.exp(2.0 * np.mean(own - before.errors)))
    if not np.isfinite(share):
        return None
    return Improvement({"": share}, baseline, logs="held-out", is_excess=False, is_clear=h is not None)


def is_as_good(excess: Array) -> bool:
    """Return True if a simpler model predicts the logs as well as a richer model.

    Args:
        excess: Log error of the simpler model minus log error of the richer model, for each log. The mean may be up to
            a standard error. A single clearly negative value is enough.
    """
    standard_error = float(np.std(excess, ddof=1)) / np.sqrt(excess.size) if excess.size > 1 else 0.0
    return bool(np.mean(excess) <= max(SIMPLER, standard_error) or np.min(excess) < -SIMPLER)


def _parts(search: Search, best: Sequence[Hypothesis]) -> Iterator[Hypothesis]:
    """Yield, for each smaller number of candidates, the best fitted subset of the hypotheses."""
    tried = sorted((h for h in search.tried.values() if h.names), key=lambda h: h.score)
    for h in best:
        for count in range(1, len(h.names)):
            yield from [part for part in tried if len(part.names) == count and set(part.names) < set(h.names)][:1]
