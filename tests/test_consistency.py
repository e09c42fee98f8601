"""Consistency of estimators: NEES and NIS over Monte Carlo runs."""

from __future__ import annotations

import html
import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.consistency import CASES, Consistency, FlightCase, consistency, consistency_of, squares_of
from cosim.core.errors import InputError
from tests.test_first_steps import told


def test_chi_squares_are_consistent_and_scaled_ones_are_told_by_how_much() -> None:
    squares = np.random.default_rng(1).chisquare(4, (50, 400))
    assert consistency_of(squares, 4, white=True).verdict == "consistent"
    assert consistency_of(squares, 4).share == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 400))
    twice, half = consistency_of(2.0 * squares, 4), consistency_of(0.5 * squares, 4)
    assert (twice.verdict, half.verdict) == ("optimistic", "pessimistic")
    assert twice.factor == pytest.approx(2.0, rel=0.03)  # the mean of 20 000 χ² with 4 is 4 ± 0.02


def correlated(rng: np.random.Generator, runs: int, times: int, degrees: int) -> NDArray[np.float64]:
    """χ² numbers of which one time resembles the next, as errors of an estimator do: z⁺ = 0.95·z + w."""
    z = [rng.normal(size=(runs, degrees))]
    for _ in range(times - 1):
        z.append(0.95 * z[-1] + math.sqrt(1.0 - 0.95**2) * rng.normal(size=(runs, degrees)))
    return np.asarray(np.square(z).sum(axis=2).T)


def test_a_verdict_of_95_percent_is_wrong_for_about_5_percent_and_no_more_often_under_correlation_in_time() -> None:
    draws = np.random.default_rng(2).chisquare(3, (400, 20, 10))
    wrong = np.mean([consistency_of(d, 3, white=True).verdict != "consistent" for d in draws])
    assert wrong == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / 400))
    rng = np.random.default_rng(4)
    found = [consistency_of(correlated(rng, 15, 100, 4), 4) for _ in range(150)]
    wrong = np.mean([c.verdict != "consistent" for c in found])
    assert wrong < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 150)
    assert np.mean([c.times for c in found]) < 30  # of 100; a time resembles the 20 about it


def test_one_that_is_optimistic_first_and_pessimistic_later_is_not_consistent_though_its_mean_is() -> None:
    squares = correlated(np.random.default_rng(6), 50, 450, 4)
    squares[:, :50] *= 3.0
    squares[:, 50:] *= 0.75
    squares *= 4.0 / squares.mean()
    found = consistency_of(squares, 4)
    assert found.region[0] < found.mean < found.region[1]
    assert found.verdict == "optimistic and pessimistic"
    assert found.share == pytest.approx(1.0 - found.above - found.below)


def judged(plant: str, estimator: str, runs: int, steps: int, *, fixes: bool = False) -> dict[str, Consistency]:
    found = squares_of(FlightCase("", plant, estimator, fixes), runs, steps, np.random.default_rng(5))
    return {name: consistency_of(v, n, white=name != "NEES") for name, (v, n, _) in found.items()}


@pytest.mark.parametrize("fixes", [False, True])
def test_consistent_on_the_linear_model_disturbed_with_v_is_within_the_95_percent_region(fixes: bool) -> None:
    found = judged("linear", "consistent", 30, 200, fixes=fixes)
    assert [c.verdict for c in found.values()] == ["consistent"] * (2 + fixes)


@pytest.mark.thorough
@pytest.mark.parametrize("fixes", [False, True])
def test_the_extended_filter_on_the_plant_disturbed_with_its_q_is_within_the_95_percent_region(fixes: bool) -> None:
    found = judged("disturbed", "extended", 15, 120, fixes=fixes)
    assert {c.verdict for c in found.values()} == {"consistent"}
    assert found["NEES"].degrees == 12


@pytest.mark.parametrize(
    ("plant", "estimator", "verdict"),
    [
        ("linear", "appendix_f", "optimistic"),
        # the plant has no disturbances at all, so with V of eq 5.47 errors are smaller than what is believed
        ("plant", "consistent", "pessimistic"),
    ],
)
def test_elsewhere_it_is_said_which_way_an_estimator_is_wrong(plant: str, estimator: str, verdict: str) -> None:
    assert {c.verdict for c in judged(plant, estimator, 15, 200).values()} == {verdict}


@pytest.mark.thorough
def test_the_command_prints_every_case_with_its_verdict_and_leaves_a_page(tmp_path: Path) -> None:
    asked = ["--runs", "2", "--steps", "100", "--json", "--out", tmp_path / "new" / "folder"]
    rows = json.loads(told("consistency", *asked))
    assert {r["case"] for r in rows} == {c.title for c in CASES}
    text = html.unescape((tmp_path / "new" / "folder" / "report.html").read_text())
    assert text.count("data-chart") >= len(rows)  # a chart each
    assert all(r["case"] in text and r["flight"] in text and r["motion"] in text for r in rows)


def test_too_few_or_too_many_runs_are_refused_before_a_folder_is_made(tmp_path: Path) -> None:
    for asked in ("--runs=1", "--runs=1000000000", "--steps=1000000000"):
        told("consistency", asked, "--out", tmp_path / "new", code=2)
        assert not (tmp_path / "new").exists()
    with pytest.raises(InputError, match=r"runs: is 1; .* 2\b.*\nsteps: is 50; .* 100\b"):
        consistency(1, 50)
