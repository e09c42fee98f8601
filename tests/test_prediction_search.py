"""The nearest model by predictions: windows, Cauchy's loss, and a search beside an unknown input."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.logs.log import read_log
from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, Values, parameter
from cosim.refinement.decision.claims import Claims, Nearest
from cosim.refinement.decision.evidence import fit_given_model
from cosim.refinement.proof import prediction_search
from cosim.refinement.proof.nearest import nearest
from cosim.refinement.proof.prediction_search import ladder_by_predictions, search_nearest
from cosim.refinement.proof.prediction_windows import CAUCHY, OVERLAP, Windows, limited, median_errors
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.refinement.study import Study
from cosim.subject.model_subject import ModelSubject

STEP, ROWS, NOISE = 0.05, 800, 1e-3
DAMPING, OFFSET = 0.4, 0.05


@dataclass(frozen=True, kw_only=True)
class Damping(Effect):
    """−d·v."""

    name = "damping"
    coefficient: float = parameter(0.0, unit="1/s", bounds=(0, 5), neutral=0.0, typical=0.2, doc="d")


@dataclass(frozen=True, kw_only=True)
class Offset(Effect):
    """A constant acceleration."""

    name = "offset"
    value: float = parameter(0.0, unit="m/s2", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="o")


@dataclass(frozen=True, kw_only=True)
class Stiffness(Effect):
    """−c·x."""

    name = "stiffness"
    coefficient: float = parameter(0.0, unit="1/s2", bounds=(-5, 5), neutral=0.0, typical=0.2, doc="c")


@dataclass(frozen=True, kw_only=True)
class Sled(Model):
    """ẍ = k·u − d·ẋ − c·x + o, measured: x."""

    base_states = (Quantity("position", "m", "x"), Quantity("speed", "m/s", "ẋ"))
    inputs = (Quantity("push", "m/s2", "u"),)
    outputs = base_states[:1]
    catalogue = (Damping, Offset, Stiffness)
    sensor_variance, start_variance = {"position": NOISE**2}, {"speed": 0.01}
    forced, calibrated = ("speed",), ("gain",)
    rate, substep, horizon = STEP, STEP, 2.0
    gain: float = parameter(1.0, unit="", bounds=(0.1, 10), tolerance=0.1, doc="k")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            total = self.gain * command[0]
            for effect in self.awake:
                if isinstance(effect, Damping):
                    total = total - effect.coefficient * state[1]
                elif isinstance(effect, Stiffness):
                    total = total - effect.coefficient * state[0]
                elif isinstance(effect, Offset):
                    total = total + effect.value
            return state[1], total

        return Equations(derivative, lambda t, state, command: (state[0],))


SLED = ModelSubject.of(Sled())


def write_logs(folder: Path, damping: float, offset: float) -> list[Path]:
    """Logs of a sled under feedback that is kicked twice; the kicks are in no catalogue."""
    paths = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        x, v, target, kicks = 0.0, 0.0, 0.0, rng.integers(100, ROWS, 2)
        lines = ["time,push,position"]
        for k in range(ROWS):
            target = float(rng.uniform(-0.3, 0.3)) if k % 40 == 0 else target
            u = 2.0 * (target - x) - 1.5 * v
            lines.append(f"{k * STEP:.2f},{u:.9g},{x + NOISE * rng.standard_normal():.9g}")
            v += 0.15 * (k in kicks)
            for _ in range(10):
                x, v = x + 0.1 * STEP * v, v + 0.1 * STEP * (u - damping * v + offset)
        paths.append(folder / f"log{seed}.csv")
        paths[-1].write_text("\n".join(lines) + "\n", encoding="utf-8")
    return paths


def posed(folder: Path, damping: float = DAMPING, offset: float = OFFSET) -> Problem:
    """The fitting problem of two logs."""
    return build_problem(
        SLED, [read_log(path, SLED.inputs, SLED.outputs) for path in write_logs(folder, damping, offset)]
    )


def based(problem: Problem) -> tuple[Search, Attribution]:
    """The search with its base fit alone."""
    search = Search(SLED, problem, 3, lambda stage, share: None)
    base = search.hypothesis((), None)
    facts = SimpleNamespace(base=base, unfitted=fit_given_model(problem, base.fit))
    return search, cast(Attribution, facts)


def test_no_prediction_extends_over_two_parts_and_each_log_has_several(tmp_path: Path) -> None:
    problem = posed(tmp_path)
    windows, length = Windows.of(problem, 2.0), round(2.0 / STEP)
    assert windows.groups.tolist() == [0, 0, 0, 1, 1, 1]
    for log, rows in enumerate(windows.rows):
        own = windows.parts[np.isin(windows.parts, np.flatnonzero(windows.groups == log))]
        assert len(own) == len(rows)
        spans = [(min(s), max(s) + length) for p in set(own.tolist()) if (s := np.array(rows)[own == p]).size]
        ordered = sorted(spans)
        assert all(a[1] <= b[0] for a, b in pairwise(ordered))
        assert ordered[-1][1] < ROWS
    one = replace(problem, logs=problem.logs[:1], readings=problem.readings[:1], x0=problem.x0[:1])
    assert Windows.of(one, 2.0).groups.tolist() == [0, 0, 0, 1, 1, 1]


def test_a_prediction_that_an_event_spoils_has_a_limited_weight() -> None:
    errors = np.ones((4, 5, 1))
    errors[3] = 1000.0
    scale = median_errors(errors)
    assert scale.tolist() == [1.0]

    def loss(e: Array) -> list[float]:
        return [OVERLAP * float(row @ row) for row in limited(e, scale).reshape(len(e), -1)]

    each = loss(errors)
    assert each[0] == pytest.approx(CAUCHY**2 * np.log1p(1 / CAUCHY**2))
    assert each[3] == pytest.approx(CAUCHY**2 * np.log1p(1e6 / CAUCHY**2))
    errors[3] = np.inf
    assert np.isfinite(limited(errors, scale)).all()
    missing = np.where(np.arange(5)[None, :, None] < 2, errors, np.nan)
    assert loss(missing)[:3] == pytest.approx(each[:3])


def test_effects_that_predictions_need_are_in_the_nearest_model(tmp_path: Path) -> None:
    problem = posed(tmp_path)
    search, a = based(problem)
    candidates = SLED.candidates(["push"])
    rungs = ladder_by_predictions(search, Windows.of(problem, 2.0), a, candidates)
    h = nearest(rungs)
    assert h is not None
    assert h.names == ("damping", "offset")
    assert h.fit.values["damping.coefficient"] == pytest.approx(DAMPING, rel=0.15)
    assert h.fit.values["offset.value"] == pytest.approx(OFFSET, rel=0.15)
    assert [rung.hypothesis is None for rung in rungs] == [True] + [False] * (len(rungs) - 1)
    sizes = [len(rung.hypothesis.names) for rung in rungs if rung.hypothesis]
    assert sizes == sorted(sizes)


def test_without_an_effect_there_is_no_larger_model(tmp_path: Path) -> None:
    problem = posed(tmp_path, damping=0.0, offset=0.0)
    search, a = based(problem)
    rungs = ladder_by_predictions(search, Windows.of(problem, 2.0), a, SLED.candidates(["push"]))
    h = nearest(rungs) if rungs else None
    assert h is None or not h.names


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("claims", "is_far", "expected"),
    [
        (Claims("unexplained", nearest=Nearest(None)), True, ("damping", "offset")),
        (Claims("unexplained", nearest=Nearest(None)), False, ()),
        (Claims("no_effect", nearest=Nearest(None)), True, ()),
        (Claims("unexplained", claimed=cast(Hypothesis, SimpleNamespace(names=())), nearest=Nearest(None)), True, ()),
    ],
)
def test_the_search_runs_only_if_nothing_is_claimed_and_the_error_is_far_above_the_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, claims: Claims, is_far: bool, expected: tuple[str, ...]
) -> None:
    problem = posed(tmp_path)
    search, a = based(problem)
    monkeypatch.setattr(prediction_search, "_is_far_from_noise", lambda *arguments: is_far)
    study: Any = cast(Study, SimpleNamespace(subject=SLED))
    after = search_nearest(study, claims, a, problem, search, SLED.candidates(["push"]))
    assert after.nearest is not None
    assert after.nearest.names == expected
    assert replace(after, ladder=(), nearest=None) == replace(claims, ladder=(), nearest=None)
    assert bool(after.ladder) == bool(expected)
