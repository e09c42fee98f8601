"""Effects that a claim, as their special case, does not exclude.

A simple effect explains the logs as well as one that contains it, such as dry friction and a friction that decreases
with speed, if their difference gains less than its parameters cost. The logs then need not exclude the difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cosim.estimation.subject.candidates import Candidate, Free, values_of_special_case
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.claims import Claims, NotExcluded
from cosim.refinement.decision.constancy import VARIES
from cosim.refinement.search.fits import Search, key_of
from cosim.refinement.search.hypotheses import Hypothesis

ENDED = 1.0  # nats by which an effect may fall behind its special case where fits end


def not_excluded(search: Search, claims: Claims, candidates: Sequence[Candidate]) -> tuple[NotExcluded, ...]:
    """Return effects possible in place of claimed special cases."""
    h = claims.claimed
    if h is None:
        return ()
    pairs = [(simple, rich) for simple in claims.claimed_candidates for rich in candidates if rich.name not in h.names]
    return tuple(found for simple, rich in pairs for found in _differences(search, h, simple, rich))


def _differences(search: Search, h: Hypothesis, simple: Candidate, rich: Candidate) -> Iterator[NotExcluded]:
    equal = values_of_special_case(rich, simple, h.fit.values)
    other = search.tried.get(key_of([*(c for c in h.candidates if c is not simple), rich])) if equal else None
    if other is None or other.fit.objective > h.fit.objective + ENDED:  # an effect of another place explains less
        return
    for f in (f for f in rich.free if f.above):
        value, largest = equal[f.name], _largest(other, f)
        if largest > (1.0 + VARIES) * value:
            name = f.name.rpartition(".")[2]
            yield NotExcluded(rich.name, simple.name, name, largest, search.subject.declared[f.name].unit)


def _largest(h: Hypothesis, f: Free) -> float:
    """Return the upper end of a 95 % interval.

    It is the interval of the parameter's distance from its lower bound.
    """
    values = h.fit.values
    beyond = values[f.name] - values[f.above] + NORMAL_95 * h.fit.sigma_between(f.name, f.above)
    return min(f.high, float(values[f.above] + beyond))
