"""Effects that contain a claimed one as their special case, and that the logs do not exclude."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Candidate, Free
from cosim.refinement.decision.claims import Claims, NotExcluded
from cosim.refinement.decision.special_cases import not_excluded
from cosim.refinement.search.hypotheses import Hypothesis

LEVEL = Free("coulomb_at_w.level", 0.0, 9.0, 0.1, neutral=0.0)
RICH = (
    Free("stribeck_at_w.level", 0.0, 9.0, 0.1, neutral=0.0),
    Free("stribeck_at_w.breakaway", 0.0, 9.0, 0.1, neutral=0.0, above="stribeck_at_w.level"),
)
COULOMB = Candidate("coulomb_at_w", "effect", (LEVEL,), ({},))
STRIBECK = Candidate("stribeck_at_w", "effect", RICH, ({},))
DRAG = Candidate("drag_at_w", "effect", (Free("drag_at_w.coefficient", 0.0, 9.0, 0.1, neutral=0.0),), ({},))


def fitted(c: Candidate, values: dict[str, float], covariance: Any) -> Hypothesis:
    noise: Any = None
    information = np.linalg.inv(np.atleast_2d(covariance))
    return Hypothesis((c,), Fit(values, noise, c.free, (0.0,), 0.0, information, 1, True), 0.0)


def found(breakaway: float, sigma: float, *, tried: bool = True, behind: float = 0.0) -> tuple[NotExcluded, ...]:
    """Return the result for a claimed level of 2; the other friction has level and breakaway that vary together."""
    simple = fitted(COULOMB, {LEVEL.name: 2.0}, 0.01)
    together = 0.3**2  # both are uncertain, their difference is not
    covariance = [[together, together], [together, together + sigma**2]]
    rich = fitted(STRIBECK, {RICH[0].name: 2.0, RICH[1].name: breakaway}, covariance)
    rich = replace(rich, fit=replace(rich.fit, penalty=behind))
    declared = {f.name: SimpleNamespace(unit="N.m") for f in (*RICH, LEVEL)}
    known = {rich.names: rich} if tried else {}
    search: Any = SimpleNamespace(tried=known, subject=SimpleNamespace(declared=declared))
    return not_excluded(search, Claims("effect_found", simple), [COULOMB, STRIBECK, DRAG])


@pytest.mark.parametrize(
    ("breakaway", "sigma", "largest"), [(2.0, 0.05, None), (2.0, 0.5, 2.98), (3.0, 0.1, 3.196), (2.0, 50.0, 9.0)]
)
def test_a_friction_that_decreases_with_speed_is_excluded_only_by_logs_that_show_its_breakaway(
    breakaway: float, sigma: float, largest: float | None
) -> None:
    told = found(breakaway, sigma)
    assert [(x.name, x.in_place_of, x.parameter) for x in told] == (
        [("stribeck_at_w", "coulomb_at_w", "breakaway")] if largest else []
    )
    assert [x.up_to for x in told] == pytest.approx([largest] if largest else [])
