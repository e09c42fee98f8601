"""Rules of decision for FMUs: parts without a certain effect, replays of small effects, experiments for rivals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Candidate, Free
from cosim.refinement.decision.claims import Claims
from cosim.refinement.proof import replay_check
from cosim.refinement.search.hypotheses import Hypothesis


def hypothesis(estimates: Mapping[str, tuple[float, float]]) -> Hypothesis:
    """Return a fit of effects with one parameter each: name → value and standard deviation."""
    free = {name: Free(f"{name}.value", -9.0, 9.0, 0.1, neutral=0.0) for name in estimates}
    values = {free[name].name: value for name, (value, _) in estimates.items()}
    information = np.diag([sigma**-2 for _, sigma in estimates.values()])
    noise: Any = None
    fit = Fit(values, noise, tuple(free.values()), (0.0,), 0.0, information, 1, True)
    return Hypothesis(tuple(Candidate(name, "sensor", (f,), ({},)) for name, f in free.items()), fit, 0.0)


def test_the_size_of_an_effect_is_certain_at_its_fitted_shape() -> None:
    """Only the product of time and damping is certain of a short lag of second order."""
    free = (
        Free("lag.time", 0.0, 9.0, 0.1, neutral=0.0),
        Free("lag.damping", 0.05, 3.0, 0.1),
    )
    along, across = np.array([1.0, 1.0]) / np.sqrt(2.0), np.array([1.0, -1.0]) / np.sqrt(2.0)
    information = 1e4 * np.outer(along, along) + 1e-2 * np.outer(across, across)
    noise: Any = None
    fit = Fit({"lag.time": 0.6, "lag.damping": 0.6}, noise, free, (0.0,), 0.0, information, 1, True)
    h = Hypothesis((Candidate("lag", "effect", free, ({},)),), fit, 0.0)
    assert fit.sigma("lag.time") > 5.0
    assert h.is_away(h.candidates[0], 3.7)
    given = {"lag.time": 0.6, "lag.damping": 0.6}  # of a model that has the effect already
    assert not h.is_away(h.candidates[0], 3.7, given)
    assert not h.is_away(h.candidates[0], 60.0)


def test_a_sensor_error_of_an_fmu_must_not_make_replays_worse_on_every_channel() -> None:
    claim = hypothesis({"lag": (2.6, 0.1)})
    claims = Claims("sensor_error", claim, grade="claimed")
    error = {"before": {"x": 1.08}, "recalibrated": {"x": 1.02}, "after": {"x": 1.29}}
    answers = {
        than: replay_check.check_claim(claims, error, {"x": 1.2}, alternative=than).name for than in ("", "before")
    }
    assert answers == {"": "sensor_error", "before": "unexplained"}
