"""The verdict as a pure function of fits: evidence in closed form, classes, abstention, grades, what leaves it alone.

The fits are of linear models with Gaussian noise, of which every number has a closed form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.signal import lfilter
from scipy.special import logsumexp, stdtrit
from scipy.stats import multivariate_normal, norm

from cosim.core.arrays import Array
from cosim.estimation.problem import Scored
from cosim.refinement.decision.bundle import gain_per_chance
from cosim.refinement.decision.posterior import (
    CERTAIN,
    MIXTURE,
    Bundle,
    Evidence,
    Kind,
    Misfit,
    Parameter,
    decide,
    log_evidence,
    log_prior,
)

ROWS, BLOCKS, LOGS = 400, 20, 2
TYPICAL = 0.5
EFFECTS = dict.fromkeys("ab", "effect")


class Linear:
    """Readings y = X·θ + noise of variance 1; a column of X is a part."""

    def __init__(self, sizes: Mapping[str, float], seed: int = 0) -> None:
        """Draw columns and readings of parts of these sizes."""
        rng = np.random.default_rng(seed)
        self.columns = {name: rng.normal(size=ROWS) for name in sizes}
        self.y = sum((size * self.columns[name] for name, size in sizes.items()), rng.normal(size=ROWS))

    def fit(self, *parts: str, at: Any = None, width: float = TYPICAL, **limits: Any) -> Evidence:
        """Return the evidence of some parts, expanded about the optimum or about other values."""
        X = np.array([self.columns[n] for n in parts]).reshape(-1, ROWS).T
        theta = np.linalg.lstsq(X, self.y, rcond=None)[0] if at is None else at
        theta = np.clip(theta, limits.get("low", -np.inf), limits.get("high", np.inf))
        e = self.y - X @ theta
        block = np.arange(ROWS) * BLOCKS // ROWS
        logs = np.arange(BLOCKS) * LOGS // BLOCKS
        terms, slopes = -0.5 * (e**2 + math.log(2.0 * math.pi)), -X * e[:, None]
        of = [X[logs[block] == log] for log in range(LOGS)]
        return Evidence(
            frozenset(parts),
            tuple(Parameter(n, n, v, 0.0, width, is_size=True, **limits) for n, v in zip(parts, theta, strict=True)),
            np.array([terms[block == b].sum() for b in range(BLOCKS)]),
            np.array([slopes[block == b].sum(axis=0) for b in range(BLOCKS)]),
            np.array([columns.T @ columns for columns in of]),
            logs,
        )

    def bundle(self, kinds: Mapping[str, Kind], width: float = TYPICAL) -> Bundle:
        """Return the bundle of all sets of parts."""
        sets = [c for k in range(len(kinds) + 1) for c in combinations(kinds, k)]
        return Bundle([self.fit(*parts, width=width) for parts in sets], kinds)


def sets_of(values: Mapping[str, Any]) -> dict[frozenset[str], Any]:
    """Return set of parts → value, of the parts as one text: each letter is one."""
    return {frozenset(parts): value for parts, value in values.items()}


def weighed(log_odds: Mapping[str, float], kinds: Mapping[str, Any] = EFFECTS, **more: Any) -> Bundle:
    """Return hypotheses without parameters whose posterior has these log odds."""
    none = (np.zeros((BLOCKS, 0)), np.zeros((1, 0, 0)), np.zeros(BLOCKS, np.intp))
    each = {parts: (odds - log_prior(len(parts), len(kinds))) / BLOCKS for parts, odds in log_odds.items()}
    return Bundle([Evidence(frozenset(p), (), np.full(BLOCKS, x), *none) for p, x in each.items()], kinds, **more)


# -- evidence ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [1.0, 3.0])
@pytest.mark.parametrize("parts", ["", "a", "ab"])
def test_evidence_is_that_of_the_linear_model_wherever_it_is_expanded(parts: str, kappa: float) -> None:
    """ln of the mean over the mixture of N(y; 0, κI + S), tempered by κ."""
    model, rng = Linear({"a": 0.3, "b": 0.0}, 1), np.random.default_rng(1)
    found = []
    for widths in product(MIXTURE, repeat=len(parts)):
        X = np.array([w * TYPICAL * model.columns[n] for w, n in zip(widths, parts, strict=True)]).reshape(-1, ROWS).T
        found.append(multivariate_normal(np.zeros(ROWS), kappa * np.eye(ROWS) + X @ X.T).logpdf(model.y))
    constant = 0.5 * ROWS * (math.log(2.0 * math.pi * kappa) - math.log(2.0 * math.pi) / kappa)
    wanted = logsumexp(found) - math.log(len(found)) + constant
    for at in (None, rng.normal(size=len(parts))):
        assert log_evidence(model.fit(*parts, at=at), kappa) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("truth", [-0.2, 0.0, 0.05, 0.4])
@pytest.mark.parametrize("limits", [{"low": 0.0}, {"low": -0.1, "high": 0.3}])
def test_limits_cut_the_prior_off(truth: float, limits: dict[str, float]) -> None:
    model = Linear({"a": truth}, 3)
    low, high = limits["low"], limits.get("high", np.inf)
    size = np.linspace(low, min(high, 3.0), 4001)
    likelihood = norm.logpdf(model.y - np.outer(size, model.columns["a"])).sum(axis=1)
    top, areas = likelihood.max(), []
    for width in MIXTURE:
        prior = norm(0.0, width * TYPICAL)
        inside = prior.cdf(high) - prior.cdf(low)
        areas.append(simpson(np.exp(likelihood - top) * prior.pdf(size), x=size) / inside)
    assert log_evidence(model.fit("a", **limits), 1.0) == pytest.approx(math.log(np.mean(areas)) + top, abs=1e-6)


# -- verdicts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("sizes", "kinds", "verdict"),
    [
        ((0.4, 0.0, 0.0), ("effect", "effect", "effect"), "effect_found"),  # beside two useless parts
        ((0.4, 0.4, 0.0), ("parameter", "sensor", "effect"), "sensor_error"),
        ((0.4, 0.0, 0.0), ("parameter", "sensor", "effect"), "parameter_error"),
        ((0.4, 0.4, 0.4), ("parameter", "sensor", "effect"), "effect_found"),
        ((0.0, 0.0, 0.0), ("parameter", "sensor", "effect"), "no_effect"),
    ],
)
def test_what_is_large_is_claimed_whatever_the_constant_the_order_and_the_usual_size(
    seed: int, sizes: tuple[float, ...], kinds: tuple[Kind, ...], verdict: str
) -> None:
    model, of = Linear(dict(zip("abc", sizes, strict=True)), seed), dict(zip("abc", kinds, strict=True))
    bundle = model.bundle(of)
    d = decide(bundle)
    assert (d.verdict, set(d.claimed)) == (verdict, {n for n, size in zip("abc", sizes, strict=True) if size})
    assert d.grade == ("claimed" if d.claimed else "nearest")
    assert (d.rivals, d.reasons) == ({}, ())
    assert all(p >= CERTAIN for p in d.claimed.values())
    assert sum(d.classes.values()) == pytest.approx(1.0)
    more = 1000.0 * d.dispersion / BLOCKS
    far = [replace(h, log_likelihoods=h.log_likelihoods + more) for h in reversed(bundle.hypotheses)]
    again = decide(replace(bundle, hypotheses=far))
    assert (again.verdict, again.nearest) == (verdict, d.nearest)
    assert again.inclusion == pytest.approx(d.inclusion, abs=1e-6)
    for times in (1.0 / 3.0, 3.0):
        other = decide(model.bundle(of, width=times * TYPICAL))
        assert (other.verdict, other.claimed.keys()) == (verdict, d.claimed.keys())


def test_of_parts_that_explain_the_same_neither_is_claimed_unless_they_are_equivalent() -> None:
    model = Linear({"a": 0.4, "b": 0.0, "c": 0.4}, 5)
    model.columns["b"] = model.columns["a"]
    bundle = model.bundle(dict.fromkeys("abc", "effect"))
    bundle = replace(bundle, hypotheses=[h for h in bundle.hypotheses if len(h.parts) < 3])
    apart = decide(bundle)
    assert (apart.verdict, apart.grade, {*apart.claimed}) == ("ambiguous", "part", {"c"})
    assert apart.rivals == sets_of({"ac": pytest.approx(0.5, abs=0.15), "bc": pytest.approx(0.5, abs=0.15)})
    same = decide(replace(bundle, equivalent=[(frozenset("ac"), frozenset("bc"))]))
    assert (same.verdict, len(same.claimed)) == ("effect_found", 2)


def test_a_rich_part_that_is_not_certain_is_its_special_case() -> None:
    told = decide(weighed({"": -50.0, "a": math.log(0.6), "b": math.log(0.4)}, families={"b": "a"}))
    assert (told.verdict, {*told.claimed}) == ("effect_found", {"a"})
    assert told.not_excluded == {("b", "a"): pytest.approx(0.4)}


# -- abstention and grade ------------------------------------------------------------------------------

CLEAR = {"": -50.0, "a": 0.0, "b": -50.0, "ab": -5.0}
BESIDE = {"": -50.0, "a": 0.0, "b": -50.0, "ab": 0.1}
NOTHING = {"": 0.0, "a": -8.0, "b": -8.0, "ab": -16.0}
WRONG = 1e-9  # probability of unnamed terms that improve the fit as much by chance


@pytest.mark.parametrize(
    ("odds", "more", "verdict", "grade", "claimed", "reason"),
    [
        (CLEAR, Misfit(WRONG), "effect_found", "part", "a", None),  # beside which the part stays certain
        (CLEAR, Misfit(WRONG, {"a": 0.9}), "unexplained", "nearest", "", "misfit"),
        (CLEAR, Misfit(0.1, {"a": 0.9}), "effect_found", "claimed", "a", None),
        (BESIDE | {"a": -50.0}, Misfit(WRONG, {"a": 0.99, "b": 0.6}), "effect_found", "part", "a", None),
        (CLEAR, Misfit(WRONG, remaining={"x": 0.6}), "unexplained", "nearest", "", "excess error"),
        (CLEAR, Misfit(WRONG, remaining={"x": 0.4}), "effect_found", "part", "a", None),
        (CLEAR, Misfit(remaining={"x": 0.12, "y": 0.05}), "effect_found", "claimed", "a", None),
        (CLEAR, Misfit(remaining={"x": 0.12, "y": 0.1}), "effect_found", "part", "a", None),
        (CLEAR, Misfit(over_floor={"x": 3.0}), "effect_found", "claimed", "a", None),
        (CLEAR, Misfit(unknown_share=0.5), "unexplained", "nearest", "", "unknown inputs"),
        (CLEAR, Misfit(unknown_share=0.5, remaining={"x": 0.05}), "effect_found", "claimed", "a", None),  # it is seen
        (NOTHING, Misfit(2e-3), "no_effect", "nearest", "", None),
        (NOTHING, Misfit(WRONG), "unexplained", "nearest", "", "misfit"),
        (NOTHING, Misfit(unknown_share=0.2), "unexplained", "nearest", "", "unknown inputs"),
        (NOTHING, Misfit(over_floor={"x": 1.2, "y": 2.5}), "unexplained", "nearest", "", "excess error"),
        # an uncertain base number beside a certain effect leaves the verdict, an effect does not
        (BESIDE, {"kinds": {"a": "effect", "b": "parameter"}}, "effect_found", "claimed", "a", None),
        (BESIDE, {}, "ambiguous", "part", "a", None),
        # without a sign of any effect that could show, the logs are too poor
        (NOTHING, {"hidden": {"a"}}, "no_effect", "nearest", "", None),
        (NOTHING, {"hidden": {"a", "b"}}, "ambiguous", "nearest", "", "nothing would show"),
        (CLEAR, {"unsure": {"a"}}, "ambiguous", "nearest", "", "interval: a"),  # which holds its absence
    ],
)
def test_what_remains_or_is_uncertain_stands_against_a_claim(
    odds: dict[str, float], more: Any, verdict: str, grade: str, claimed: str, reason: str | None
) -> None:
    bundle = weighed(odds, **({"misfit": more} if isinstance(more, Misfit) else more))
    d = decide(bundle)
    assert (d.verdict, d.grade, set(d.claimed)) == (verdict, grade, set(claimed))
    assert d.reasons == ((reason,) if reason else ())
    assert bool(d.rivals) == (verdict == "ambiguous")


def test_a_part_is_not_withdrawn_for_another_that_predicts_as_well() -> None:
    """Two columns are equal; the prior of one is narrower, or no input tells them apart."""
    model = Linear({"a": 0.4}, 7)
    one, other = frozenset("a"), frozenset("b")
    a = model.fit("a")
    b = replace(a, parts=other, parameters=tuple(replace(p, part="b") for p in a.parameters))
    kinds: dict[str, Kind] = {"a": "effect", "b": "effect"}
    alike = decide(Bundle([model.fit(), a, b], kinds, equivalent=[(one, other)]))
    assert (alike.verdict, alike.reasons) == ("effect_found", ())
    narrow = replace(b, parameters=tuple(replace(p, width=1e-3 * p.width) for p in b.parameters))
    d = decide(Bundle([model.fit(), a, narrow], kinds))
    assert (d.verdict, set(d.claimed), d.reasons) == ("effect_found", {"a"}, ())


# -- gain of a part against the scatter of chance, over blocks of time ----------------------------------

SPANS, LENGTH = 30, 100  # blocks, and rows of each
BLOCK = np.repeat(np.arange(SPANS), LENGTH)
BY_CHANCE, COST = 0.01, 10.0
LIMIT = 0.5 * stdtrit(SPANS - 1, 1.0 - 0.5 * BY_CHANCE / 20)  # of the best of twenty candidates


def acting_in(blocks: int, rng: np.random.Generator) -> Array:
    """Return a term of unit size that acts in a few blocks and hardly elsewhere."""
    term = 0.02 * np.sin(0.21 * np.arange(SPANS * LENGTH))
    for k in range(blocks):
        term[k * LENGTH : (k + 1) * LENGTH] = 0.35**k * np.sin(0.3 * np.arange(LENGTH) + rng.uniform(0.0, 6.0))
    return term / np.linalg.norm(term)


def passes(term: Array, y: Array) -> bool:
    """Return whether the gain of a term's regression is beyond its cost and beyond chance."""
    worse, better = (
        Scored(e, np.full(e.size, np.mean(e**2)), (e.size,), np.arange(e.size)) for e in (y, y - term @ y * term)
    )
    return worse.nll - better.nll > COST and gain_per_chance(BLOCK, worse, better) > LIMIT


def test_an_effect_that_acts_in_three_blocks_is_no_chance() -> None:
    rng = np.random.default_rng(1)
    terms = [acting_in(3, rng) for _ in range(200)]
    passed = [passes(term, 9.0 * term + rng.normal(size=term.size)) for term in terms]
    assert np.mean(passed) > 0.5  # Its gain is 40.


@pytest.mark.parametrize("blocks", [1, SPANS])
def test_coloured_noise_passes_for_no_effect(blocks: int) -> None:
    rng = np.random.default_rng(2)
    noise = [lfilter([1.0], [1.0, -0.8], rng.normal(size=SPANS * LENGTH)) for _ in range(400)]
    assert np.mean([passes(acting_in(blocks, rng), y) for y in noise]) < BY_CHANCE


def test_a_single_event_passes_for_no_effect() -> None:
    rng = np.random.default_rng(3)
    term = acting_in(SPANS, rng)
    event = np.where(BLOCK == 7, 40.0 * term, 0.0)
    assert not any(passes(term, event + rng.normal(size=term.size)) for _ in range(100))
