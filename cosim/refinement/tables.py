"""What a table says beside a verdict: errors on rows left out, and whether what is left goes with an input.

A table has no equation of a state in which something could act. What is left of an output is noise where neighbours
over an input are no more alike than others; else something goes with that input that no hypothesis says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.estimation.problem import Problem
from cosim.refinement.evidence import learnt_without, open_loop
from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.search import Search
from cosim.refinement.verdict import Verdict
from cosim.text import amount
from plant.model import Model

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
        rows.append(open_loop(problem, search.model.horizon, values, fit, k)[:, 0])
    left = np.vstack(rows)
    sizes = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return dict(zip(problem.layout.outputs, sizes, strict=True))
