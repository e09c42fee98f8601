"""What a claim gains on logs that it was not fitted on."""

from __future__ import annotations

from cosim.refinement.fit import fit
from cosim.refinement.hypotheses import Hypothesis
from cosim.refinement.problem import halved
from cosim.refinement.search import SCREEN_ITERATIONS, Search


def held_out_gain(search: Search, h: Hypothesis, base: Hypothesis) -> float:
    """Objective gained over the base on each log, with what is claimed as the others have it; of one log, halves.

    What is not claimed, base parameters and process noise, settles on the log itself, for both alike: logs that
    excite little leave it open, and from values that the others left open one that excites much would refuse any
    claim. Of the base, parameters that the hypothesis calls wrong stay as the model has them.
    """
    if h is base:
        return 0.0
    problem = search.problem if len(search.problem.logs) > 1 else halved(search.problem)
    names = [f.name for c in h.candidates for f in c.free]
    settling = [f for f in search.free(()) if f.name not in names]
    neutral = {name: problem.values[name] for name in names}
    count = len(problem.logs)
    gained = 0.0
    for left_out in range(count):
        others = [k for k in range(count) if k != left_out]
        learnt = fit(problem, search.free(h.candidates), h.fit.values, h.fit.log_q, others, SCREEN_ITERATIONS)
        claimed = {name: learnt.values[name] for name in names}
        without, with_it = (
            fit(problem, settling, {**f.values, **stays}, f.log_q, [left_out], SCREEN_ITERATIONS).objective
            for f, stays in ((base.fit, neutral), (h.fit, claimed))
        )
        gained += without - with_it
    return gained
