"""The verdict as a pure function of fits: evidence in closed form, classes, abstention, grades, what leaves it alone.

The fits are of linear models with Gaussian noise, of which every number has a closed form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise, permutations
from typing import Any

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from cosim.refinement.decision import posterior as rules
from cosim.refinement.decision.posterior import (
    CERTAIN,
    MIXTURE,
    Bundle,
    Decision,
    Evidence,
    Kind,
    Misfit,
    Parameter,
    by_family,
    decide,
    dispersion,
    folded,
    held_out_gains,
    log_evidence,
)

ROWS, BLOCKS, LOGS = 400, 20, 2
TYPICAL = 0.5
ALONE = frozenset[str]()
Names = frozenset[str]


class Linear:
    """Readings y = X·θ + noise of variance 1; a column of X is a part."""

    def __init__(self, sizes: Mapping[str, float], seed: int = 0, alike: Mapping[str, str] = {}) -> None:
        """Draw columns and readings.

        Args:
            sizes: Part → true size.
            alike: Part → part with the same column.
        """
        rng = np.random.default_rng(seed)
        self.columns = {name: rng.normal(size=ROWS) for name in sizes}
        self.columns |= {name: self.columns[other] for name, other in alike.items()}
        self.y = sum((size * self.columns[name] for name, size in sizes.items()), rng.normal(size=ROWS))

    def fit(self, *parts: str, at: Sequence[float] | None = None, width: float = TYPICAL, **limits: float) -> Evidence:
        """Return the evidence of some parts, expanded about the optimum or about other values."""
        X = np.stack([self.columns[n] for n in parts], axis=1) if parts else np.zeros((ROWS, 0))
        theta = np.linalg.lstsq(X, self.y, rcond=None)[0] if at is None else np.array(at)
        if limits:
            theta = np.clip(theta, limits.get("low", -np.inf), limits.get("high", np.inf))
        e = self.y - X @ theta
        block = np.arange(ROWS) * BLOCKS // ROWS
        logs = np.arange(BLOCKS) * LOGS // BLOCKS
        terms, slopes = -0.5 * (e**2 + math.log(2.0 * math.pi)), -X * e[:, None]
        of = [np.flatnonzero(logs[block] == log) for log in range(LOGS)]
        return Evidence(
            parts=frozenset(parts),
            parameters=tuple(
                Parameter(f"{n}.size", n, float(v), 0.0, width, is_size=True, **limits)
                for n, v in zip(parts, theta, strict=True)
            ),
            log_likelihoods=np.array([terms[block == b].sum() for b in range(BLOCKS)]),
            gradients=np.array([slopes[block == b].sum(axis=0) for b in range(BLOCKS)]),
            informations=np.array([X[rows].T @ X[rows] for rows in of]),
            logs=logs,
        )

    def bundle(self, kinds: Mapping[str, Kind], most: int = 3, width: float = TYPICAL, **more: Any) -> Bundle:
        """Return the bundle of all sets of parts."""
        sets = [c for k in range(most + 1) for c in combinations(kinds, k)]
        return Bundle([self.fit(*parts, width=width) for parts in sets], kinds, **more)

    def density(self, theta: Sequence[float], parts: Sequence[str]) -> float:
        """Return the log-likelihood."""
        return float(norm.logpdf(self.y - sum(t * self.columns[n] for t, n in zip(theta, parts, strict=True))).sum())


def exact(model: Linear, parts: Sequence[str], kappa: float = 1.0) -> float:
    """Return ln of the mean over the mixture of N(y; 0, κI + S), tempered by κ."""
    found = []
    for widths in np.stack(np.meshgrid(*[MIXTURE] * len(parts)), axis=-1).reshape(-1, len(parts)):
        X = np.stack([w * TYPICAL * model.columns[n] for w, n in zip(widths, parts, strict=True)], axis=1)
        tempered = multivariate_normal(np.zeros(ROWS), kappa * np.eye(ROWS) + X @ X.T).logpdf(model.y)
        constant = 0.5 * ROWS * (math.log(2.0 * math.pi * kappa) - math.log(2.0 * math.pi) / kappa)
        found.append(tempered + constant)
    return float(logsumexp(found)) - math.log(len(found))


def effects(*names: str) -> dict[str, Kind]:
    return dict.fromkeys(names, "effect")


def named(*parts: str) -> Names:
    return frozenset(parts)


# -- evidence ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [1.0, 3.0])
@pytest.mark.parametrize("parts", [(), ("a",), ("a", "b")])
@pytest.mark.parametrize("seed", [1, 2])
def test_evidence_is_that_of_the_linear_model_wherever_it_is_expanded(
    seed: int, parts: tuple[str, ...], kappa: float
) -> None:
    model, rng = Linear({"a": 0.3, "b": 0.0}, seed), np.random.default_rng(seed)
    wanted = exact(model, parts, kappa) if parts else model.density((), ()) / kappa
    assert log_evidence(model.fit(*parts), kappa) == pytest.approx(wanted, abs=1e-8)
    if parts:
        elsewhere = rng.normal(size=len(parts))
        assert log_evidence(model.fit(*parts, at=elsewhere), kappa) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("truth", [-0.2, 0.0, 0.05, 0.4])
@pytest.mark.parametrize("limits", [{"low": 0.0}, {"low": -0.1, "high": 0.3}])
def test_limits_cut_the_prior_off(truth: float, limits: dict[str, float]) -> None:
    model = Linear({"a": truth}, 3)
    low, high = limits["low"], limits.get("high", 3.0)
    top = model.density([float(np.clip(truth, low, high))], ["a"])

    def of(width: float) -> float:
        inside = norm.cdf(high if "high" in limits else np.inf, 0.0, width) - norm.cdf(low, 0.0, width)
        at = np.clip(truth, low, high)
        area = quad(
            lambda x: math.exp(model.density([x], ["a"]) - top) * norm.pdf(x, 0.0, width) / inside,
            low,
            high,
            points=[at, min(high, at + 0.1)],
            limit=200,
        )[0]
        return math.log(area) + top

    wanted = logsumexp([of(w * TYPICAL) for w in MIXTURE]) - math.log(len(MIXTURE))
    assert log_evidence(model.fit("a", **limits), 1.0) == pytest.approx(wanted, abs=1e-6)


def test_evidence_of_two_limited_parts_is_their_integral(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits are cut off one by one, so that this holds for estimates that hardly depend on each other."""
    monkeypatch.setattr(rules, "MIXTURE", (1.0,))
    model = Linear({"a": 0.05, "b": 0.1}, 4)
    top = model.density((0.05, 0.1), ("a", "b"))

    def integrand(b: float, a: float) -> float:
        prior = 4.0 * norm.pdf(a, 0.0, TYPICAL) * norm.pdf(b, 0.0, TYPICAL)
        return float(math.exp(model.density((a, b), ("a", "b")) - top) * prior)

    wanted = math.log(dblquad(integrand, 0.0, 0.5, 0.0, 0.5, epsabs=1e-7)[0]) + top
    assert log_evidence(model.fit("a", "b", low=0.0), 1.0) == pytest.approx(wanted, abs=0.02)


def test_dispersion_is_one_of_white_scores_and_grows_with_their_correlation_in_blocks() -> None:
    def of(share: float, seed: int) -> float:
        model, rng = Linear({"a": 0.0, "b": 0.0}, seed), np.random.default_rng(100 + seed)
        for column in model.columns.values():  # a disturbance that resembles a column, by another factor in each block
            model.y += share * np.repeat(rng.normal(size=BLOCKS), ROWS // BLOCKS) * column
        return dispersion(model.fit("a", "b"))

    means = [float(np.mean([of(share, seed) for seed in range(30)])) for share in (0.0, 0.3, 0.6)]
    assert means[0] == pytest.approx(1.0, abs=0.2)
    assert all(more > 1.5 * less for less, more in pairwise(means))
    assert dispersion(Linear({"a": 0.0}).fit()) == 1.0


# -- verdicts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("sizes", "kinds", "verdict"),
    [
        ((0.4, 0.0, 0.0), ("effect", "effect", "effect"), "effect_found"),  # beside two useless parts
        ((0.4, 0.4, 0.0), ("effect", "sensor", "effect"), "effect_found"),
        ((0.4, 0.4, 0.0), ("parameter", "sensor", "effect"), "sensor_error"),
        ((0.4, 0.0, 0.0), ("parameter", "sensor", "effect"), "parameter_error"),
        ((0.4, 0.4, 0.4), ("parameter", "sensor", "effect"), "effect_found"),
        ((0.0, 0.0, 0.0), ("parameter", "sensor", "effect"), "no_effect"),
    ],
)
def test_what_is_large_is_claimed_and_nothing_else(
    seed: int, sizes: tuple[float, ...], kinds: tuple[Kind, ...], verdict: str
) -> None:
    model = Linear(dict(zip("abc", sizes, strict=True)), seed)
    d = decide(model.bundle(dict(zip("abc", kinds, strict=True))))
    assert (d.verdict, set(d.claimed)) == (verdict, {n for n, size in zip("abc", sizes, strict=True) if size})
    assert d.grade == ("claimed" if d.claimed else "nearest")
    assert (d.rivals, d.reasons) == ({}, ())
    assert all(p >= CERTAIN for p in d.claimed.values())
    assert sum(d.classes.values()) == pytest.approx(1.0)


def test_of_parts_that_explain_the_same_neither_is_claimed_unless_they_are_equivalent() -> None:
    model = Linear({"a": 0.4, "c": 0.0}, 5, alike={"b": "a"})
    bundle = model.bundle(effects("a", "b", "c"), most=2)
    apart = decide(bundle)
    assert (apart.verdict, apart.grade, apart.claimed) == ("ambiguous", "nearest", {})
    assert apart.rivals == {named("a"): pytest.approx(0.5, abs=0.15), named("b"): pytest.approx(0.5, abs=0.15)}
    same = decide(replace(bundle, equivalent=[(named("a"), named("b"))]))
    assert (same.verdict, len(same.claimed)) == ("effect_found", 1)


def test_what_all_rivals_contain_is_claimed_as_a_part() -> None:
    model = Linear({"a": 0.4, "b": 0.4}, 6, alike={"c": "b"})
    d = decide(model.bundle(effects("a", "b", "c"), most=2))
    assert (d.verdict, d.grade, set(d.claimed)) == ("ambiguous", "part", {"a"})
    assert d.rivals.keys() == {named("a", "b"), named("a", "c")}


def test_an_uncertain_base_number_beside_a_certain_effect_leaves_the_verdict() -> None:
    a, b, both = named("a"), named("number"), named("a", "number")
    d = decide(weighed({ALONE: -50.0, a: 0.0, b: -50.0, both: 0.1}, {"a": "effect", "number": "parameter"}))
    assert (d.verdict, set(d.claimed), d.rivals) == ("effect_found", {"a"}, {})
    assert 0.05 < d.uncertain["number"] < CERTAIN
    of_effect = decide(weighed({ALONE: -50.0, a: 0.0, b: -50.0, both: 0.1}, effects("a", "number")))
    assert (of_effect.verdict, of_effect.grade, of_effect.rivals.keys()) == ("ambiguous", "part", {a, both})


def test_without_a_sign_of_any_effect_that_could_show_the_logs_are_too_poor() -> None:
    bundle = weighed({ALONE: 0.0, named("a"): -8.0, named("b"): -8.0}, effects("a", "b"))
    assert decide(replace(bundle, hidden=named("a"))).verdict == "no_effect"
    blind = decide(replace(bundle, hidden=named("a", "b")))
    assert (blind.verdict, blind.reasons) == ("ambiguous", ("nothing would show",))
    assert blind.rivals.keys() == {ALONE, named("a"), named("b")}


def weighed(log_odds: Mapping[Names, float], kinds: Mapping[str, Kind], **more: Any) -> Bundle:
    """Return hypotheses without parameters whose posterior has these log odds."""
    return Bundle([*_weighed(log_odds, len(kinds))], kinds, **more)


def _weighed(log_odds: Mapping[Names, float], count: int) -> Iterator[Evidence]:
    for parts, odds in log_odds.items():
        each = np.full(BLOCKS, (odds - rules.log_prior(len(parts), count)) / BLOCKS)
        yield Evidence(parts, (), each, np.zeros((BLOCKS, 0)), np.zeros((1, 0, 0)), np.zeros(BLOCKS, np.intp))


def test_classes_fold_into_more_probable_subsets_and_families_into_their_special_case() -> None:
    a, ab, b = named("a"), named("a", "b"), named("b")
    assert folded({ALONE: 0.03, a: 0.9, ab: 0.06, b: 0.01}, ()) == pytest.approx({a: 0.96, ALONE: 0.04})
    assert folded({a: 0.3, ab: 0.7}, ()) == {ab: 0.7, a: 0.3}  # a richer set that is more probable stays
    assert folded({a: 0.6, b: 0.4}, [(a, b)]) == {a: 1.0}
    ac, d = named("a", "c"), named("d")
    for order in permutations({a: 0.2, ab: 0.15, ac: 0.3, d: 0.35}.items()):
        assert folded(dict(order), ()) == pytest.approx({a: 0.35, d: 0.35, ac: 0.3})
    assert by_family({a: 0.6, b: 0.4}, {"b": "a"}) == {a: 1.0}
    assert by_family({ALONE: 0.6, b: 0.4}, {"b": "a"}) == {ALONE: 0.6, b: 0.4}  # the special case was not fitted
    assert by_family({a: 0.03, b: 0.97}, {"b": "a"}) == {a: 0.03, b: 0.97}  # the richer one is certain by itself
    told = decide(weighed({ALONE: -50.0, a: math.log(0.6), b: math.log(0.4)}, effects("a", "b"), families={"b": "a"}))
    assert (told.verdict, told.claimed.keys()) == ("effect_found", {"a"})
    assert told.not_excluded == {("b", "a"): pytest.approx(0.4)}


# -- abstention and grade ------------------------------------------------------------------------------

CLEAR = {ALONE: -50.0, named("a"): 0.0, named("b"): -50.0, named("a", "b"): -5.0}
NOTHING = {ALONE: 0.0, named("a"): -8.0, named("b"): -8.0, named("a", "b"): -16.0}


@pytest.mark.parametrize(
    ("odds", "misfit", "verdict", "grade", "reasons"),
    [
        (CLEAR, {}, "effect_found", "claimed", ()),
        (CLEAR, {"probability": 1e-9}, "effect_found", "part", ()),  # beside which the part stays certain
        (CLEAR, {"probability": 1e-9, "beside": {"a": 0.9}}, "unexplained", "nearest", ("misfit",)),
        (CLEAR, {"probability": 0.1, "beside": {"a": 0.9}}, "effect_found", "claimed", ()),
        (CLEAR, {"probability": 1e-9, "beside": {"a": 0.99}}, "effect_found", "part", ()),
        (CLEAR, {"probability": 1e-9, "remaining": {"x": 0.6}}, "unexplained", "nearest", ("excess error",)),
        (CLEAR, {"probability": 1e-9, "remaining": {"x": 0.4}}, "effect_found", "part", ()),
        (CLEAR, {"remaining": {"x": 0.12, "y": 0.05}}, "effect_found", "claimed", ()),
        (CLEAR, {"remaining": {"x": 0.12, "y": 0.1}}, "effect_found", "part", ()),
        (CLEAR, {"over_floor": {"x": 3.0}}, "effect_found", "claimed", ()),
        (CLEAR, {"unknown_share": 0.5}, "unexplained", "nearest", ("unknown inputs",)),
        (CLEAR, {"unknown_share": 0.5, "remaining": {"x": 0.6}}, "unexplained", "nearest", ("unknown inputs",)),
        (CLEAR, {"unknown_share": 0.5, "remaining": {"x": 0.05}}, "effect_found", "claimed", ()),  # replays show it
        (NOTHING, {}, "no_effect", "nearest", ()),
        (NOTHING, {"probability": 1e-9}, "unexplained", "nearest", ("misfit",)),
        (NOTHING, {"probability": 2e-3}, "no_effect", "nearest", ()),
        (NOTHING, {"unknown_share": 0.2}, "unexplained", "nearest", ("unknown inputs",)),
        (NOTHING, {"over_floor": {"x": 1.2, "y": 2.5}}, "unexplained", "nearest", ("excess error",)),
    ],
)
def test_what_remains_stands_against_a_claim(
    odds: Mapping[Names, float], misfit: Mapping[str, Any], verdict: str, grade: str, reasons: tuple[str, ...]
) -> None:
    d = decide(weighed(odds, effects("a", "b"), misfit=Misfit(**misfit)))
    assert (d.verdict, d.grade, d.reasons) == (verdict, grade, reasons)
    assert (not d.claimed) == (verdict in ("unexplained", "no_effect"))
    assert d.nearest == max(odds, key=lambda parts: odds[parts])


def test_a_part_that_a_term_without_a_name_may_replace_is_not_claimed_with_the_others() -> None:
    odds = {named("a", "b"): 0.0, named("a"): -50.0, named("b"): -50.0, ALONE: -50.0}
    misfit = Misfit(probability=1e-9, beside={"a": 0.99, "b": 0.6})
    d = decide(weighed(odds, effects("a", "b"), misfit=misfit))
    assert (d.verdict, d.grade, set(d.claimed), d.disputed) == ("effect_found", "part", {"a"}, named("b"))


@pytest.mark.parametrize("kind", ["effect", "sensor", "parameter"])
def test_a_part_whose_interval_holds_its_absence_is_not_claimed(kind: Kind) -> None:
    d = decide(weighed(CLEAR, {"a": kind, "b": "effect"}, unsure=named("a")))
    assert (d.verdict, d.grade, d.claimed, d.reasons) == ("ambiguous", "nearest", {}, ("interval: a",))


@pytest.mark.parametrize(("kind", "verdict"), [("effect", "ambiguous"), ("parameter", "parameter_error")])
def test_a_loss_on_logs_left_out_withdraws_an_effect_and_no_base_number(kind: Kind, verdict: str) -> None:
    """A column acts in the first log only."""
    model = Linear({"a": 0.0}, 3)
    model.y += 1.2 * model.columns["a"] * (np.arange(ROWS) < ROWS // 2)
    d = decide(bundle := model.bundle({"a": kind}))
    assert held_out_gains(bundle.hypotheses, d.dispersion, {"a": named("a")}, 1)["a"] < 0.0
    assert d.inclusion["a"] >= CERTAIN
    assert (d.verdict, set(d.claimed)) == (verdict, set() if kind == "effect" else {"a"})
    assert d.reasons == (("held out: a",) if kind == "effect" else ())
    steady = Linear({"a": 0.4}, 7).bundle({"a": kind})
    assert held_out_gains(steady.hypotheses, 1.0, {"a": named("a")}, 1)["a"] > 5.0


# -- what changes nothing --------------------------------------------------------------------------------


def verdict_of(d: Decision) -> tuple[Any, ...]:
    numbers = {n: round(p, 6) for n, p in d.inclusion.items()}
    return d.verdict, d.grade, set(d.claimed), set(d.rivals), numbers, d.nearest, d.reasons


@pytest.mark.parametrize("seed", range(4))
def test_neither_a_constant_nor_an_order_nor_the_usual_size_changes_a_verdict(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = dict(zip("abc", rng.choice([0.0, 0.35, 0.5], 3).tolist(), strict=True))
    model, kinds = Linear(sizes, seed), effects("a", "b", "c")
    bundle = model.bundle(kinds)
    wanted = verdict_of(decide(bundle))
    assert wanted[2] == {n for n, size in sizes.items() if size}
    far: list[Evidence] = [
        replace(h, log_likelihoods=h.log_likelihoods + 1000.0 * decide(bundle).dispersion / BLOCKS)
        for h in bundle.hypotheses
    ]
    assert verdict_of(decide(replace(bundle, hypotheses=far))) == wanted
    mixed = [bundle.hypotheses[k] for k in rng.permutation(len(bundle.hypotheses))]
    assert verdict_of(decide(replace(bundle, hypotheses=mixed))) == wanted
    for times in (1.0 / 3.0, 3.0):
        assert verdict_of(decide(model.bundle(kinds, width=times * TYPICAL)))[:4] == wanted[:4]
