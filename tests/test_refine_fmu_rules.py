"""Rules of decision for FMUs: parts without a certain effect, replays of small effects, experiments for rivals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.estimation.data import data_of
from cosim.estimation.fit import Fit
from cosim.logs.log import read_log
from cosim.model.quantities import Quantity
from cosim.probing.fmu_structure import ProbedParameter
from cosim.refinement import workflow
from cosim.refinement.decision import judgement, trust
from cosim.refinement.decision.claims import Claims, Improvement, MovedParameter
from cosim.refinement.proof import measure, replay_check
from cosim.refinement.proof.measure import Floor
from cosim.refinement.search.fits import Search, SearchResult
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.subject import probed_model
from cosim.subject.base_parameters import spread_of_base
from cosim.subject.candidates import Candidate, Free
from cosim.terms.alike import experiments_for
from tests.logs import write_log


def hypothesis(estimates: Mapping[str, tuple[float, float]]) -> Hypothesis:
    """Return a fit of effects with one parameter each: name → value and standard deviation."""
    free = {name: Free(f"{name}.value", -9.0, 9.0, 0.1, neutral=0.0) for name in estimates}
    values = {free[name].name: value for name, (value, _) in estimates.items()}
    information = np.diag([sigma**-2 for _, sigma in estimates.values()])
    noise: Any = None
    fit = Fit(values, noise, tuple(free.values()), (0.0,), 0.0, information, 1, True)
    return Hypothesis(tuple(Candidate(name, "sensor", (f,), ({},)) for name, f in free.items()), fit, 0.0)


@pytest.mark.parametrize(
    ("is_flat", "halves", "names"),
    [
        (False, False, ("late",)),
        (True, False, ("lag", "late")),
        (False, True, ("lag", "late")),  # it halves the error of held-out logs
    ],
)
def test_a_part_of_a_claim_is_further_from_neutral_than_the_best_of_all_by_chance(
    monkeypatch: pytest.MonkeyPatch, is_flat: bool, halves: bool, names: tuple[str, ...]
) -> None:
    monkeypatch.setattr(judgement, "with_intervals", lambda search, h: h)
    monkeypatch.setattr(judgement, "_halves_error", lambda search, h, c: halves)
    alone = hypothesis({"late": (2.6, 0.1)})
    problem = SimpleNamespace(values={"lag.value": 0.0, "late.value": 0.0})
    search: Any = SimpleNamespace(problem=problem, tried={("late",): alone}, on_trial=50)
    dropped: dict[str, judgement.Refusal] = {}
    both = hypothesis({"lag": (1.0, np.inf if is_flat else 0.3), "late": (2.4, 0.3)})
    best = judgement._with_certain_parts(search, both, dropped)
    assert best.names == names
    assert list(dropped) == [name for name in ("lag",) if name not in names]


def test_a_complete_error_is_at_no_limit() -> None:
    """A sensor that shows the magnitude has no direction at all."""
    h = hypothesis({"magnitude": (9.0, 0.1), "scale": (9.0, 0.1)})
    magnitude, scale = h.candidates
    complete = replace(magnitude, complete={"magnitude.value": 9.0})
    neutral = {"magnitude.value": 0.0, "scale.value": 0.0}
    assert judgement._parameters_at_limit(h, [magnitude, scale], neutral) == ["magnitude.value", "scale.value"]
    assert judgement._parameters_at_limit(h, [complete, scale], neutral) == ["scale.value"]


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


@pytest.mark.parametrize(("probed", "answer"), [(True, ("lag",)), (False, ())])
def test_what_refuses_the_best_hypothesis_says_nothing_against_a_simpler_one(
    monkeypatch: pytest.MonkeyPatch, probed: bool, answer: tuple[str, ...]
) -> None:
    rich, simple = (replace(hypothesis({name: (1.0, 0.1)}), ended=True) for name in ("second_order_lag", "lag"))
    tried = {(): replace(rich, candidates=(), score=0.0)}
    tried |= {("second_order_lag",): replace(rich, score=-310.0), ("lag",): replace(simple, score=-308.0)}
    search: Any = SimpleNamespace(subject=SimpleNamespace(probed=probed), tried=tried)

    def remainder(search: Any, h: Hypothesis) -> judgement._Remainder:
        refused = h.names == ("second_order_lag",)
        return judgement._Remainder(
            tried[()] if refused else h,
            dropped={h.names[0]: judgement.Refusal(h.names, "at its limit")} if refused else {},
        )

    monkeypatch.setattr(judgement, "_remainder", remainder)
    found = judgement._supported(search, tried["second_order_lag",], ())
    assert found.best.names == answer
    assert list(found.dropped) == ["second_order_lag"]


def test_what_came_near_beside_a_dropped_part_is_fitted_without_it() -> None:
    """The search had replaced a part of a hypothesis with more parts; the rival of the rest was never fitted."""

    def tried(score: float, *names: str, ended: bool = True) -> Hypothesis:
        return replace(hypothesis(dict.fromkeys(names, (1.0, 0.1))), score=score, ended=ended)

    best = tried(-222.5, "latency", "viscous")
    others = (
        tried(-213.9, "latency", "shaft", "viscous"),
        tried(-213.7, "lag", "shaft", "viscous"),
        tried(-190.0, "scale", "shaft", "viscous"),  # far behind
        tried(-212.8, "drag", "latency", "viscous"),  # beside a part that nobody dropped
        tried(-203.7, "latency", "offset", "shaft", "viscous"),  # contains the best
        tried(-150.0, "lag", "viscous", ended=False),
    )
    search: Any = SimpleNamespace(tried={h.names: h for h in (best, *others)})
    assert [h.names for h in judgement._rivals_without(search, best, {"shaft": "costs more"})] == [("lag", "viscous")]
    search.tried["lag", "viscous"] = replace(others[-1], ended=True)
    assert judgement._rivals_without(search, best, {"shaft": "costs more"}) == []


@pytest.mark.parametrize(("others", "is_worse"), [(0.9, False), (1.1, True)])
def test_one_window_does_not_speak_against_a_small_effect(others: float, is_worse: bool) -> None:
    """The claim is worse in one window, where an unstable motion parts from the log, and better or worse elsewhere."""
    rng = np.random.default_rng(1)
    base = rng.uniform(0.9, 1.1, (9, 2))
    claim = others * base * rng.uniform(0.99, 1.01, (9, 2))
    claim[4] *= 50.0 if others < 1.0 else 1.0
    base[4] *= 40.0 if others < 1.0 else 1.0
    assert replay_check._is_clearly_worse(claim, base) is is_worse


def test_a_sensor_error_of_an_fmu_must_not_make_replays_worse_on_every_channel() -> None:
    claim = hypothesis({"lag": (2.6, 0.1)})
    claims = Claims("sensor_error", claim, grade="claimed")
    error = {"before": {"x": 1.08}, "recalibrated": {"x": 1.02}, "after": {"x": 1.29}}
    answers = {
        than: replay_check.check_claim(claims, error, {"x": 1.2}, alternative=than).name for than in ("", "before")
    }
    assert answers == {"": "sensor_error", "before": "unexplained"}


@pytest.mark.parametrize(
    ("simple", "rich", "gain", "at_usual_shape", "is_rival"),
    [
        ("coulomb_at_v", "stribeck_at_v", 4.1, 0.0, True),  # more than chance, less than the cost of two parameters
        ("coulomb_at_v", "stribeck_at_v", 1.0, 1.0, False),  # contains it
        ("coulomb_at_v", "stribeck_at_w", 4.1, 4.1, False),
        ("coulomb_at_v", "cogging_at_v", 4.1, 4.1, False),
        ("lag_at_u", "second_order_lag_at_u", 0.1, 0.0, True),  # too small to tell the order
        ("lag_at_u", "second_order_lag_at_u", 0.1, -9.0, False),  # imitates the lag by a large damping
    ],
)
def test_a_richer_term_that_looks_alike_is_a_rival_if_it_explains_as_well(
    simple: str, rich: str, gain: float, at_usual_shape: float, is_rival: bool
) -> None:
    best, other = hypothesis({simple: (1.0, 0.1)}), hypothesis({rich: (1.0, 0.1)})
    (candidate,) = other.candidates
    shape = (replace(candidate.free[0], name=n, neutral=None) for n in "ab")
    more = replace(candidate, free=(*candidate.free, *shape))
    other = replace(other, candidates=(more,), fit=replace(other.fit, nll_by_log=(-gain,)))

    def refit(parts: Any, start: Fit, **_: Any) -> Hypothesis:
        assert [f.name for f in parts[0].free] == [f.name for f in start.free] == [f"{rich}.value"]
        return replace(best, fit=replace(best.fit, nll_by_log=(-at_usual_shape,)))

    search: Any = SimpleNamespace(hypothesis=refit)
    assert judgement._is_richer_twin(search, best, other) is is_rival


def test_rivals_that_look_alike_have_an_experiment() -> None:
    names = ["delay", "lag_at_torque", "latency_at_angle", "leak_at_level"]
    rows = experiments_for(names)
    (text,) = [text for row, text in rows.items() if {"delay", "lag_at_torque"} <= row]
    assert "a delay waits" in text


@pytest.mark.parametrize(("count", "nats", "is_repeated"), [(2, 20.0, True), (3, 20.0, False), (2, -20.0, False)])
def test_free_runs_name_two_terms_at_most_with_equations_trusted(
    monkeypatch: pytest.MonkeyPatch, count: int, nats: float, is_repeated: bool
) -> None:
    """If free runs without unknown inputs are better, and likelier, their search counts; many terms imitate others."""
    layout, noise = SimpleNamespace(is_free_run=True), SimpleNamespace(sensors=None)
    free_search, trusted_search = (
        SimpleNamespace(
            problem=SimpleNamespace(layout=layout, limits=SimpleNamespace(free=range(noises)), scatter=scatter),
            price=4.0,
            cost=lambda parts, scatter=scatter: scatter * 10.0 * len(parts),
        )
        for noises, scatter in ((3, 1.0), (1, 2.0))
    )
    none: Any = replace(hypothesis({}), fit=replace(hypothesis({}).fit, noise=noise))  # type: ignore[arg-type]
    many = hypothesis({f"drift_at_{k}": (1.0, 0.1) for k in range(count)})
    many = replace(many, fit=replace(many.fit, nll_by_log=(8.0 - 10.0 * count - nats,)))
    results: Any = [
        SearchResult(search, best, (), ())  # type: ignore[arg-type]
        for search, best in ((free_search, none), (trusted_search, many))
    ]
    runs = iter(results)
    monkeypatch.setattr(trust, "Attributor", lambda *given: SimpleNamespace(run=lambda: next(runs)))
    monkeypatch.setattr(trust, "noise_gain", lambda problem, fit: (100.0,))
    quick = SimpleNamespace(problem=trusted_search.problem, hypothesis=lambda parts, start: none)
    monkeypatch.setattr(trust, "Search", lambda *given: quick)
    monkeypatch.setattr(trust, "coarsen", lambda problem: problem)
    monkeypatch.setattr(trust, "with_equations_trusted", lambda subject, problem: problem)
    monkeypatch.setattr(
        trust, "log_error", lambda problem, horizon, fits: 0.0 if problem is free_search.problem else -1.0
    )
    subject: Any = SimpleNamespace(horizon=np.inf)
    problem: Any = SimpleNamespace(layout=layout)
    result = trust.attribute(subject, problem, (), lambda stage, share: None)
    assert (result.best is many) is is_repeated


def test_a_parameter_of_zero_has_a_size() -> None:
    """An infinite size made every estimate NaN."""
    tried = ProbedParameter(Quantity("tilt", "rad", ""), acts=True, starts=False, tried=0.1)
    p = probed_model._parameter(tried)
    assert spread_of_base(p, 0.0, 0.02) == pytest.approx(0.001)


def test_a_log_of_an_fmu_without_inputs_has_rows(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.csv", {"time": np.arange(20.0), "x": np.sin(np.arange(20.0))})
    log = read_log(path, (), (Quantity("x", "", ""),))
    subject: Any = SimpleNamespace(substeps=lambda step: 1)
    layout: Any = SimpleNamespace(inputs=(), outputs=("x",))
    data = data_of(subject, log, layout, 0.0)
    assert data.u.shape == (20, 0)
    np.testing.assert_array_equal(data.y[:, 0], log.outputs["x"])


def test_a_richer_term_at_a_limit_is_followed_by_its_special_case_and_is_no_rival(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rich, simple = (
        Candidate(name, "effect", (Free(f"{name}.level", 0.0, 9.0, 0.1, neutral=0.0),), ({},))
        for name in ("stribeck_at_v", "coulomb_at_v")
    )
    best = replace(hypothesis({"stribeck_at_v": (9.0, 0.1)}), candidates=(rich,), ended=True)
    best = replace(best, fit=replace(best.fit, values={"stribeck_at_v.level": 9.0}, free=rich.free))
    begun: dict[str, float] = {}

    def fitted(parts: tuple[Candidate, ...], start: Fit, promised: dict[str, float]) -> Hypothesis:
        begun.update(promised)
        return replace(best, candidates=parts, score=-50.0)

    problem = SimpleNamespace(values={"stribeck_at_v.level": 0.0, "coulomb_at_v.level": 0.0})
    search: Any = SimpleNamespace(problem=problem, tried={best.names: best}, hypothesis=fitted)
    judgement._fit_special_cases(search, best, {"stribeck_at_v"}, (rich, simple))
    assert begun == {"coulomb_at_v.level": 9.0}
    special = search.tried["coulomb_at_v",]
    monkeypatch.setattr(judgement, "_refutes", lambda *hypotheses: False)
    assert not judgement._is_rival(search, special, best)


@pytest.mark.parametrize(("level", "grade", "divided"), [({}, "claimed", "phi"), ({"phi": 0.1}, "part", "")])
def test_sealed_logs_do_not_grade_a_claim_by_less_than_its_own_uncertainty(
    monkeypatch: pytest.MonkeyPatch, level: dict[str, float], grade: str, divided: str
) -> None:
    missed = Improvement({"phi": 0.9}, "recalibrated")
    claims = Claims("effect_found", hypothesis({"dry": (1.0, 0.1)}), grade="claimed", improvement=missed)
    monkeypatch.setattr(workflow, "predicted_floor", lambda *given: level)
    monkeypatch.setattr(workflow, "sealed_improvement", lambda claims, errors, floor: missed if floor else None)
    variant: Any = SimpleNamespace(subject=SimpleNamespace(horizon=np.inf))
    problem: Any = None
    log: Any = None
    floors: Any = {"validation": Floor({"phi": 0.1}, {})}
    posed = variant, problem, [log]
    graded = workflow._check_on_sealed_logs(claims, {}, floors, posed, np.random.default_rng(0))
    assert (graded.grade, graded.divided) == (grade, divided)


@pytest.mark.parametrize(("promised", "begun"), [(0.8, 0.8), (2.2, 1.1), (5.0, 1.25), (-8.0, -2.0)])
def test_a_fit_begins_no_further_away_than_the_logs_bear(promised: float, begun: float) -> None:
    """The likelihood is best at a size of 1; the shape keeps its promised value."""
    search = Search.__new__(Search)
    problem: Any = SimpleNamespace(score=lambda values, noise: SimpleNamespace(nll=(values["leak.size"] - 1.0) ** 2))
    search.problem, noise = problem, None
    free = [Free("leak.size", -9.0, 9.0, 0.1, neutral=0.0), Free("leak.level", 0.0, 9.0, 0.1)]
    base = {"leak.size": 0.0, "leak.level": 1.0, "mass": 3.0}
    values = search._toward({"leak.size": promised, "leak.level": 2.0}, base, free, noise, 1.0)  # type: ignore[arg-type]
    assert values == {"leak.size": pytest.approx(begun), "leak.level": 2.0, "mass": 3.0}


def test_the_highest_floor_holds_the_scatter_of_its_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """A position drifts away with noise: one sealed log may miss it by far more than the mean of the draws."""
    monkeypatch.setattr(measure, "_begun", lambda variant, problem, logs: problem)
    monkeypatch.setattr(measure, "_root_mean_squares", lambda problem, changes: {"angle": 0.75, "speed": 0.0})
    monkeypatch.setattr(measure, "_standard_deviation", lambda logs, name: np.inf)
    floor = Floor({"angle": 1.0, "speed": 2.0}, {"angle": 0.3})
    posed: Any = SimpleNamespace()
    fit = hypothesis({"a": (1.0, 0.1)}).fit
    level = measure.predicted_floor(floor, posed, posed, [], fit, np.random.default_rng(0))
    assert level == {"angle": pytest.approx(np.hypot(np.exp(0.9), 0.75)), "speed": 2.0}


@pytest.mark.parametrize(
    ("stated", "grade", "expected"),
    [
        ({"magnet": 0.05}, "claimed", "part"),
        ({"mass": 0.05}, "claimed", "claimed"),  # the tolerance of the magnet is an assumption
        ({"magnet": 0.05}, "nearest", "nearest"),
    ],
)
def test_a_claim_beside_which_a_stated_tolerance_is_left_is_a_part(
    monkeypatch: pytest.MonkeyPatch, stated: dict[str, float], grade: Any, expected: str
) -> None:
    moved = (MovedParameter("magnet", 1.0, 0.9),)
    monkeypatch.setattr(replay_check, "_replay_errors", lambda *given: ({}, Floor({}, {})))
    monkeypatch.setattr(replay_check, "_alternative", lambda *given: "")
    monkeypatch.setattr(replay_check, "check_claim", lambda claims, *given, **options: claims)
    monkeypatch.setattr(replay_check, "beyond_tolerance", lambda fit: moved if fit else ())
    claimed: Any = SimpleNamespace(is_of_sensors=False, fit="fitted")
    study: Any = SimpleNamespace(settings=SimpleNamespace(tolerance=stated))
    a: Any = SimpleNamespace(base=SimpleNamespace(fit=None), support={}, halves_error=False)
    result: Any = SimpleNamespace(free_noise=None)
    claims = replay_check.check_with_replays(study, a, Claims("effect_found", claimed, grade=grade), result, result)
    assert (claims.grade, claims.further) == (expected, moved)
    assert claims.is_doubtful is (expected == "part")
