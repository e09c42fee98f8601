"""Estimators held against what they believe: NEES and NIS over Monte Carlo runs."""

from __future__ import annotations

import html
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from controller.consistency import (
    Consistency,
    ConsistencyRow,
    by_case,
    consistency,
    consistency_of,
    headline,
    independent_times,
)
from controller.consistency_page import page
from controller.extended import STATES
from controller.monte_carlo import CASES, MANOEUVRE, FlightCase, references, squares_of
from cosim.base.errors import InputError
from cosim.model import Stepper
from cosim.verbs.cli import app
from plant.hovercraft import Hovercraft


def test_chi_squares_are_consistent_and_scaled_ones_are_told_by_how_much() -> None:
    squares = np.random.default_rng(1).chisquare(4, (50, 400))
    assert consistency_of(squares, 4, white=True).verdict == "consistent"
    assert consistency_of(squares, 4).share == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 400))
    twice, half = consistency_of(2.0 * squares, 4), consistency_of(0.5 * squares, 4)
    assert (twice.verdict, half.verdict) == ("optimistic", "pessimistic")
    assert twice.factor == pytest.approx(2.0, rel=0.03)  # the mean of 20 000 χ² with 4 is 4 ± 0.02
    assert twice.sentence == f"optimistic: square errors are {twice.factor:.3g} times larger than it believes"
    assert "smaller than it believes" in half.sentence


def test_a_verdict_of_95_percent_is_wrong_for_about_5_percent() -> None:
    draws = np.random.default_rng(2).chisquare(3, (400, 20, 10))
    wrong = np.mean([consistency_of(d, 3, white=True).verdict != "consistent" for d in draws])
    assert wrong == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / 400))


def correlated(rng: np.random.Generator, runs: int, times: int, degrees: int) -> NDArray[np.float64]:
    """χ² numbers of which one time resembles the next, as errors of an estimator do: z⁺ = 0.95·z + w."""
    z = [rng.normal(size=(runs, degrees))]
    for _ in range(times - 1):
        z.append(0.95 * z[-1] + math.sqrt(1.0 - 0.95**2) * rng.normal(size=(runs, degrees)))
    return np.asarray(np.square(z).sum(axis=2).T)


def test_correlation_in_time_makes_a_verdict_on_a_consistent_one_wrong_no_more_often() -> None:
    rng = np.random.default_rng(4)
    found = [consistency_of(correlated(rng, 15, 100, 4), 4) for _ in range(150)]
    wrong = np.mean([c.verdict != "consistent" for c in found])
    assert wrong < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 150)
    assert np.mean([c.times for c in found]) < 30  # of 100; a time resembles the 20 about it


@pytest.mark.parametrize("white", [False, True])
def test_one_that_is_optimistic_first_and_pessimistic_later_is_not_consistent_though_its_mean_is(white: bool) -> None:
    rng = np.random.default_rng(6)
    squares = rng.chisquare(4, (50, 450)) if white else correlated(rng, 50, 450, 4)
    squares[:, :50] *= 3.0
    squares[:, 50:] *= 0.75
    squares *= 4.0 / squares.mean()
    found = consistency_of(squares, 4, white=white)
    assert found.region[0] < found.mean < found.region[1]
    assert found.verdict == "optimistic and pessimistic"
    assert f"optimistic at {100 * found.above:.3g} % and pessimistic at {100 * found.below:.3g} % of" in found.sentence
    assert "larger" not in found.sentence
    assert found.share == pytest.approx(1.0 - found.above - found.below)


def test_one_that_is_optimistic_at_times_only_is_told_with_their_share() -> None:
    found = Consistency(
        4, 50, 4.01, (3.9, 4.1), above=0.08, below=0.02, most=0.044, times=450.0, at_times=np.ones(2), at_time=(3, 5)
    )
    told = "at 8 % of the times, where 2.5 % are chance and 4.4 % the most"
    assert found.sentence == f"optimistic: {told}"
    assert replace(found, above=0.02, below=0.08).sentence == f"pessimistic: {told}"


def test_independent_times_are_counted_as_they_are_and_one_that_stays_as_one() -> None:
    rng = np.random.default_rng(9)
    assert independent_times(rng.chisquare(3, (2000, 40))) == pytest.approx(40, rel=0.1)
    assert independent_times(np.repeat(rng.chisquare(3, (20, 1)), 40, axis=1)) == pytest.approx(1.0)
    blocks = np.repeat(rng.chisquare(3, (2000, 8)), 5, axis=1)
    assert independent_times(blocks) == pytest.approx(8, rel=0.1)


def test_squares_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        consistency_of(np.array([[1.0, math.nan]]), 1)
    with pytest.raises(ValueError, match="one at least"):
        consistency_of(np.zeros((0, 3)), 1)
    with pytest.raises(ValueError, match="two at least"):
        consistency_of(np.ones((1, 3)), 1)


def level(q_told: float, r_told: float) -> tuple[Consistency, Consistency]:
    """A tank's level that wanders by N(0, 0.04), read with N(0, 1): NEES and NIS of a filter told other variances."""
    rng, runs, times = np.random.default_rng(3), 60, 200
    x, x_hat, P = np.zeros(runs), np.zeros(runs), 0.0
    nees, nis = [], []
    for _ in range(times):
        x = x + rng.normal(0.0, 0.2, runs)
        P += q_told
        innovation, S = x + rng.normal(0.0, 1.0, runs) - x_hat, P + r_told
        x_hat, P = x_hat + P / S * innovation, P - P * P / S
        nees.append((x_hat - x) ** 2 / P)
        nis.append(innovation**2 / S)

    def settled(squares: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.array(squares[50:]).T

    return consistency_of(settled(nees), 1), consistency_of(settled(nis), 1, white=True)


@pytest.mark.parametrize(
    ("q_told", "r_told", "verdict"),
    [(0.04, 1.0, "consistent"), (0.004, 1.0, "optimistic"), (0.04, 4.0, "pessimistic"), (0.4, 1.0, "pessimistic")],
)
def test_a_filter_of_another_system_is_judged_by_what_it_is_told(q_told: float, r_told: float, verdict: str) -> None:
    assert [c.verdict for c in level(q_told, r_told)] == [verdict, verdict]


def judged(case: FlightCase, runs: int, steps: int) -> dict[str, Consistency]:
    found = squares_of(case, runs, steps, np.random.default_rng(5))
    return {name: consistency_of(v, n, white=name != "NEES") for name, (v, n, _) in found.items()}


@pytest.mark.parametrize("fixes", [False, True])
def test_consistent_on_the_linear_model_disturbed_with_v_is_within_the_95_percent_region(fixes: bool) -> None:
    found = judged(FlightCase("", "linear", "consistent", fixes), 30, 200)
    assert {name: c.verdict for name, c in found.items()} == dict.fromkeys(found, "consistent")
    assert len(found) == 2 + fixes


@pytest.mark.thorough
@pytest.mark.parametrize("fixes", [False, True])
def test_the_extended_filter_on_the_plant_disturbed_with_its_q_is_within_the_95_percent_region(fixes: bool) -> None:
    found = judged(FlightCase("", "disturbed", "extended", fixes), 15, 120)
    assert {name: c.verdict for name, c in found.items()} == dict.fromkeys(found, "consistent")
    assert found["NEES"].degrees == 12


def test_elsewhere_it_is_said_which_way_an_estimator_is_wrong() -> None:
    memoryless = judged(FlightCase("", "linear", "appendix_f"), 15, 200)
    assert memoryless["NEES"].verdict == memoryless["NIS"].verdict == "optimistic"
    # the plant has no disturbances at all, so with V of eq 5.47 errors are smaller than what is believed
    undisturbed = judged(FlightCase("", "plant", "consistent"), 15, 200)
    assert undisturbed["NEES"].verdict == undisturbed["NIS"].verdict == "pessimistic"


@pytest.mark.thorough
def test_the_command_prints_every_case_with_its_verdict_and_leaves_a_page(tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder"
    done = CliRunner().invoke(app, ["consistency", "--runs", "2", "--steps", "100", "--json", "--out", str(out)])
    assert done.exit_code == 0, done.output
    rows = json.loads(done.output)
    assert json.loads((out / "consistency.json").read_text()) == {"runs": 2, "steps": 100, "seed": 1, "rows": rows}
    text = html.unescape((out / "report.html").read_text())
    assert text.count("data-chart") >= len(rows)  # a chart each
    assert all(r["case"] in text and r["flight"] in text and r["motion"] in text for r in rows)
    assert [*dict.fromkeys(r["case"] for r in rows)] == [*dict.fromkeys(c.title for c in CASES)]
    assert {r["verdict"] for r in rows} <= {"consistent", "optimistic", "pessimistic", "optimistic and pessimistic"}


def test_every_estimator_is_judged_on_a_named_flight_and_on_the_manoeuvre_of_app_g() -> None:
    flights = {
        c.flight.name: {(d.title, d.truth, d.estimator, d.fixes) for d in CASES if d.flight is c.flight} for c in CASES
    }
    assert set(flights) == {"sines of the tilts", "manoeuvre of App. G"}
    assert len({frozenset(cases) for cases in flights.values()}) == 1  # the same on both


def test_the_flown_manoeuvre_follows_app_g_within_its_10_percent() -> None:
    stepper, u = Stepper(Hovercraft()), MANOEUVRE.commands(1300)
    moment = stepper.start()
    for k, command in enumerate(u, 1):
        moment = stepper.step(moment, tuple(command.tolist()), 0.02)
        if k * 0.02 in (5.0, 10.0, 17.0, 22.0, 26.0):
            x, psi = references(k * 0.02 - 0.01)
            assert moment.state[STATES.index("x")] == pytest.approx(x, abs=0.15)
            assert moment.state[STATES.index("psi")] == pytest.approx(psi, abs=math.radians(15))
    assert references(26.0) == pytest.approx((3.0, 0.0))
    assert references(15.0) == pytest.approx((1.5, 0.5 * math.pi))


@pytest.mark.thorough
def test_the_filter_of_appendix_f_is_off_by_far_more_in_the_manoeuvre_than_on_the_sines() -> None:
    """A step asks for large tilts at once, and this filter knows no lag: 98 over 10 whole manoeuvres, 9.0 on sines."""
    sines, manoeuvre = (
        consistency_of(squares_of(case, 4, 500, np.random.default_rng(2))["NEES"][0], 5)
        for case in CASES
        if (case.truth, case.estimator) == ("plant", "appendix_f")
    )
    assert sines.mean < 15 < 60 < manoeuvre.mean
    assert manoeuvre.verdict.startswith("optimistic")


def row(case: str, flight: str, of: str, scale: float) -> ConsistencyRow:
    squares = scale * np.random.default_rng(1).chisquare(3, (50, 400))
    return ConsistencyRow(case, flight, "up and down", of, consistency_of(squares, 3, white=True), np.arange(400.0))


def test_the_headline_counts_cases_and_names_the_worst_with_its_flight() -> None:
    rows = [row("level", "slow", "NEES", 1.0), row("level", "slow", "NIS", 1.0), row("level", "fast", "NEES", 4.0)]
    first, second = headline(rows).split(". ", 1)
    assert first.startswith("1 of 2 cases are consistent")
    assert "level, fast: " in second
    assert f" {rows[2].result.factor:.3g} times the claimed variance" in second
    assert headline(rows[:2]).startswith("1 of 1 cases are consistent")
    assert headline(rows[:2]).count(". ") == 0
    assert [(j.verdict, j.consistent) for j in by_case(rows)] == [("consistent", True), ("optimistic", False)]


def test_the_page_opens_with_the_headline_and_a_row_for_each_estimator() -> None:
    rows = [row("level", "slow", "NEES", 1.0), row("level", "slow", "NIS", 1.0), row("level", "fast", "NEES", 4.0)]
    text = html.unescape(page(rows, 400, 1))
    verdicts = text[text.index('<section id="verdicts">') : text.index('<section id="tests">')]
    assert text.index(headline(rows)) < text.index("<figure") < text.index("<table")
    assert verdicts.count('<th scope="row">') == 1
    assert re.findall(r'class="verdict (\w+)"', verdicts) == ["good", "bad"]
    assert "<em>fast</em>, up and down" in verdicts


def test_the_same_random_numbers_give_the_same_squares() -> None:
    once, again = (squares_of(CASES[1], 3, 100, np.random.default_rng(8)) for _ in range(2))
    assert {n: v.tolist() for n, (v, _, _) in once.items()} == {n: v.tolist() for n, (v, _, _) in again.items()}


def test_too_few_runs_are_refused() -> None:
    assert CliRunner().invoke(app, ["consistency", "--runs", "1"]).exit_code == 2
    with pytest.raises(InputError, match="runs: is 1; give 2 or more\nsteps: is 50; give 100 or more"):
        consistency(1, 50)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (
            ["--runs", "1000000000"],
            "--runs: 1,000,000,000 runs of 500 steps are more than the 20,000,000 samples that fit",
        ),
        (["--steps", "1000000000"], "--steps: 50 runs of 1,000,000,000 steps are more than"),
    ],
)
def test_more_runs_than_memory_holds_are_refused_before_a_folder_is_made(
    asked: list[str], told: str, tmp_path: Path
) -> None:
    done = CliRunner().invoke(app, ["consistency", *asked, "--out", str(tmp_path / "new")])
    assert isinstance(done.exception, InputError)
    assert done.exception.exit_code == 2
    assert str(done.exception).startswith(told)
    assert "at most" in str(done.exception)
    assert not (tmp_path / "new").exists()


def test_runs_for_which_memory_does_not_last_are_told_with_what_to_give_less_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def too_large(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("controller.monte_carlo.squares_of", too_large)
    with pytest.raises(InputError, match="--runs: there is not enough memory for 4 runs of 100 steps; give") as caught:
        consistency(4, 100)
    assert caught.value.exit_code == 4
