"""Fits around the most probable sets of parts: removals, additions and replacements, until nothing probable is untried.

A posterior needs every set that may be as probable as the best one. Around each probable set a score test predicts the
gain of further parts, and of other parts in the place of each; what would be probable is fitted to the end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cosim.estimation.fit import Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.screen import Choice, Promise, ScoreTest
from cosim.estimation.subject.candidates import Candidate
from cosim.refinement.decision.bundle import evidence, optima
from cosim.refinement.decision.posterior import CERTAIN, POSSIBLE, folded, log_prior, posterior
from cosim.refinement.search.fits import HOPE, NEAR, Hypothesis, Parts, Search, key_of

BREADTH = 4  # most probable sets whose neighbours are tried in a round, additions to one, replacements of its parts
EXPANSIONS = 4  # rounds of neighbours

Start = tuple[Parts, Fit]


def fit_neighbours(search: Search, candidates: Sequence[Candidate]) -> None:
    """Fit the neighbours of the most probable sets to the end, into `search.tried`."""
    asked = set[frozenset[str]]()
    for _ in range(EXPANSIONS):
        ended = {frozenset(h.names): h for h in optima(search)}
        sets, kappa = posterior([evidence(search, h) for h in ended.values()], len(candidates))
        classes = folded(sets, ())
        ranked = [*classes]
        starts: dict[tuple[str, ...], Start] = {}
        mass = np.cumsum([*classes.values()])
        leading = ranked[: min(BREADTH, 1 + int(np.searchsorted(mass, CERTAIN)))]  # what a verdict would name
        probable = [parts for parts in leading if parts not in asked]
        asked.update(probable)
        for h in search.fit_from_the_prior([ended[parts] for parts in probable]):
            for start in _neighbours(search, candidates, h, kappa):
                starts.setdefault(key_of(start[0]), start)
        best = ended[ranked[0]]
        near = [h for h in search.tried.values() if not h.ended and h.score - best.score < NEAR * kappa]
        for h in sorted(near, key=lambda h: h.score)[:BREADTH]:
            starts[h.names] = h.candidates, h.fit
        untried = [s for names, s in starts.items() if not (names in search.tried and search.tried[names].ended)]
        if not untried:
            return
        search.fit_to_the_end(untried)


def _neighbours(search: Search, candidates: Sequence[Candidate], h: Hypothesis, kappa: float) -> Iterator[Start]:
    """Yield sets near a hypothesis with starts of their fits."""
    for part in h.candidates:
        rest = tuple(c for c in h.candidates if c is not part)
        yield rest, h.fit
        without = search.tried.get(key_of(rest)) or search.hypothesis(rest, h.fit, screen=True)
        others = [c for c in candidates if c.name not in h.names and c.kind != "parameter"]
        for c, promise in _promises(search, without, others)[:BREADTH]:
            yield (*rest, c), replace(without.fit, values={**without.fit.values, **promise.values})
    others = [c for c in candidates if c.name not in h.names]
    if not others:
        return
    count, size = len(candidates), len(h.candidates)
    odds = log_prior(size + 1, count) - log_prior(size, count)
    for c, promise in _promises(search, h, others)[:BREADTH]:
        if HOPE * promise.gain / kappa + odds > math.log(POSSIBLE):
            yield (*h.candidates, c), replace(h.fit, values={**h.fit.values, **promise.values})


def _promises(search: Search, h: Hypothesis, others: Sequence[Candidate]) -> list[tuple[Candidate, Promise]]:
    """Return what each of other candidates promises beside a hypothesis, best first."""
    test = ScoreTest(search.problem, h.fit, h.candidates)
    terms = [t for t in in_parallel(test.terms, others) if not t.switched]
    promises = Choice(test, terms, (), search.problem.values).extensions(())
    named = {c.name: c for c in others}
    return [(named[name], promise) for name, promise in promises.items()]
