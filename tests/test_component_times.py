"""Wall time of components and calls: sampled, in manifest and report, with a warning if a component gets slower."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.isolation.component_times import RUN, ComponentTimes, Slower
from cosim.isolation.rows import ADVANCE, CALLS, GET, NOTHING, OTHER, PUT, WAITING
from cosim.simulation.report.time_rows import time_sentence
from cosim.simulation.workflow import run
from tests.walker import walker_scenario

ROWS = 1001


class Clock:
    """A clock that is set."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def sampled(
    lengths: Callable[[int], list[tuple[int, float]]],
    seed: int = 1,
    warn: Callable[[Slower], None] = lambda s: None,
    *,
    controlled: bool = False,
    given: int = 0,
) -> ComponentTimes:
    """Sample a run of which each row consists of calls with their lengths [s].

    Args:
        controlled: Whether each call is one of several steps of a row.
    """
    clock, rng = Clock(), np.random.default_rng(seed)
    times = ComponentTimes(["wheel", "road"], ROWS, lambda rows: 0.02 * max(0, rows - 1), warn, clock, given)
    end = due = 0.0
    steps = 0
    for k in range(1, ROWS):
        for doing, length in lengths(k):
            end += length
            steps += controlled
            while due < end:
                clock.now = due
                times.read(k, doing, steps)
                due += times.pause() * rng.uniform(0.9, 1.1)
    return times


def call(component: int, kind: int) -> int:
    return CALLS * component + kind


def steady(k: int) -> list[tuple[int, float]]:
    return [(call(0, PUT), 0.0004), (call(0, ADVANCE), 0.0086), (call(1, GET), 0.001)]


def slowing(k: int) -> list[tuple[int, float]]:
    return [(call(0, ADVANCE), 0.002 if k <= 950 else 0.028), (call(1, ADVANCE), 0.001)]


def test_shares_and_calls_are_those_of_the_run() -> None:
    record = sampled(steady).record()
    assert [*record["components"]] == ["wheel", "road"]
    # 10 s of 5 ms: 2000 readings, so a share of 90 % has a standard error of 0.7 %
    assert record["components"]["wheel"]["share"] == pytest.approx(0.9, abs=0.02)
    assert record["components"]["wheel"]["step"] == pytest.approx(8.6, abs=0.3)
    assert record["components"]["wheel"]["set"] == pytest.approx(0.4, abs=0.2)
    assert record["components"]["road"]["get"] == pytest.approx(1.0, abs=0.25)
    assert record["slower"] == []


@pytest.mark.parametrize("seed", range(5))
def test_a_component_that_gets_slower_is_named_with_factor_and_time(seed: int) -> None:
    (slower,) = sampled(slowing, seed).slower()
    assert slower.component == "wheel"
    assert slower.factor == pytest.approx(14.0, rel=0.15)
    assert slower.since == pytest.approx(19.0, abs=0.4)


@pytest.mark.parametrize("controlled", [False, True])
def test_the_quick_repetition_of_given_rows_is_no_earlier_speed(controlled: bool) -> None:
    told: list[Slower] = []

    def resumed(k: int) -> list[tuple[int, float]]:
        return [(call(0, ADVANCE), 0.0001 if k < 400 else 0.02), (call(1, ADVANCE), 0.001)]

    times = sampled(resumed, warn=told.append, given=400, controlled=controlled)
    assert (told, times.slower()) == ([], [])
    assert times.record()["components"]["wheel"]["share"] == pytest.approx(20 / 21, abs=0.02)


@pytest.mark.parametrize("seed", range(20))
def test_interruptions_of_a_steady_run_are_no_change(seed: int) -> None:
    rng = np.random.default_rng(seed)
    interrupted = {*rng.choice(ROWS, 5).tolist()}

    def lengths(k: int) -> list[tuple[int, float]]:
        return [(call(0, ADVANCE), 0.8 if k in interrupted else 0.003), (call(1, ADVANCE), rng.exponential(0.002))]

    assert sampled(lengths, seed).slower() == []


def test_a_call_that_does_not_return_is_no_slow_step() -> None:
    warnings: list[Slower] = []
    clock = [0.0]
    times = ComponentTimes(["wheel", "road"], ROWS, lambda rows: 0.02 * rows, warnings.append, lambda: clock[0])
    for k in range(1, 4601):
        clock[0] += 0.005
        times.read(min(k, 600), call(0, ADVANCE))  # from row 600 on, a server no longer answers
    assert warnings == []


def test_a_warning_comes_while_the_run_is_slow_and_only_once() -> None:
    warnings: list[Slower] = []
    sampled(lambda k: [(call(0, ADVANCE), 0.002 if k <= 500 else 0.03)], warn=warnings.append)
    (slower,) = warnings
    assert slower.component == "wheel"
    assert 5.0 <= slower.factor <= 20.0
    assert 9.0 <= slower.since <= 11.0
    warnings.clear()
    sampled(steady, warn=warnings.append)
    assert warnings == []


def busy(k: int, at: int = 500) -> list[tuple[int, float]]:
    factor = 1.0 if k <= at else 8.0
    return [(call(0, ADVANCE), 0.003 * factor), (call(1, ADVANCE), 0.001 * factor), (NOTHING, 0.0005 * factor)]


@pytest.mark.parametrize("seed", range(5))
def test_a_machine_that_gets_busy_blames_no_component(seed: int) -> None:
    warnings: list[Slower] = []
    (slower,) = sampled(busy, seed, warnings.append).slower()
    assert slower.component == RUN
    assert slower.factor == pytest.approx(8.0, rel=0.15)
    assert slower.since == pytest.approx(10.0, abs=0.4)
    assert [warning.component for warning in warnings] == [RUN]
    assert 5.0 <= warnings[0].factor <= 9.0


@pytest.mark.parametrize("seed", range(5))
def test_a_component_that_gets_slower_on_a_busier_machine_is_named_by_its_own_factor(seed: int) -> None:
    def lengths(k: int) -> list[tuple[int, float]]:
        own = 1.0 if k <= 500 else 10.0
        return [(doing, length * (own if doing == call(0, ADVANCE) else 1.0) / 3.0) for doing, length in busy(k)]

    warnings: list[Slower] = []
    (slower,) = sampled(lengths, seed, warnings.append).slower()
    assert slower.component == "wheel"
    assert slower.factor == pytest.approx(10.0, rel=0.3)  # 80 times, of which 8 are the machine
    assert {warning.component for warning in warnings} == {"wheel"}


@pytest.mark.parametrize("length", [0.002, 0.02])
def test_controlled_steps_are_compared_by_their_own_number(length: float) -> None:
    """More steps for a row are no slower component; longer ones are."""

    def lengths(k: int) -> list[tuple[int, float]]:
        return [(call(0, ADVANCE), 0.002)] if k <= 500 else [(call(0, ADVANCE), length)] * 8

    warnings: list[Slower] = []
    times = sampled(lengths, warn=warnings.append, controlled=True)
    if length > 0.002:
        assert times.slower()[0].factor == pytest.approx(10.0, rel=0.15)
        assert [slower.component for slower in warnings] == ["wheel"]
    else:
        assert (times.slower(), warnings) == ([], [])


def test_time_outside_of_components_and_of_loading_is_told_apart() -> None:
    record = sampled(lambda k: [(NOTHING, 0.002), (call(1, OTHER), 0.002)]).record()
    assert record["rest"] == pytest.approx(2.0, abs=0.2)
    assert record["components"]["road"]["other"] == pytest.approx(2.0, abs=0.2)
    assert record["slower"] == []


def test_waiting_for_the_clock_is_told_apart_and_takes_no_share() -> None:
    times = sampled(lambda k: [(call(0, ADVANCE), 0.002), (NOTHING, 0.001), (WAITING, 0.007)])
    record = times.record()
    assert record["waiting"] == pytest.approx(7.0, abs=0.3)
    assert record["rest"] == pytest.approx(1.0, abs=0.2)
    assert record["components"]["wheel"]["share"] == pytest.approx(2 / 3, abs=0.05)
    assert record["readings"] == pytest.approx(600, abs=60)
    assert "7.0 s of waiting" in time_sentence(record) or "6.9 s of waiting" in time_sentence(record)
    assert "waiting" not in sampled(steady).record()


def test_a_reading_counts_where_its_time_does() -> None:
    clock = Clock()
    times = ComponentTimes(["wheel", "road"], 2, float, clock=clock)
    for made, doing in [(0, NOTHING)] * 600 + [(0, call(0, OTHER))] * 12 + [(1, call(1, ADVANCE))] * 5:
        clock.now += 0.005
        times.read(made, doing)
    clock.now += 0.005
    times.read(1, NOTHING)
    record = times.record()
    assert record["readings"] == 12 + 5 + 1  # not those of the worker's start
    spent = record["rest"] + sum(record["components"][n][c] for n, c in (("wheel", "other"), ("road", "step")))
    assert spent == pytest.approx(0.005 * record["readings"])
    assert time_sentence(record) == ""


def test_the_sentence_names_the_slow_component() -> None:
    components = {"wheel": {"share": 0.96, "step": 9.0, "set": 0.3, "get": 0.3, "other": 0.1}, "road": {"share": 0.04}}
    timings = {"readings": 2000, "components": components}
    slower = [{"component": "wheel", "factor": 14.1, "since": 19.0}]
    share = "wheel takes 96% of the time, loading included (9.6 s in steps, 0.10 s in loading)"
    words = f"{share}, and 14 times longer for a step after 19 s."
    assert time_sentence({**timings, "slower": slower}) == words
    assert time_sentence({**timings, "slower": []}) == f"{share}."
    whole = [{"component": "", "factor": 6.0, "since": 9.0}]
    every = "every component takes 6.0 times longer for a step after 9 s."
    assert time_sentence({**timings, "slower": whole}) == f"{share}; {every}"
    assert time_sentence({**timings, "readings": 20, "slower": slower}) == ""


def test_a_run_tells_its_slow_component_in_manifest_and_report(tmp_path: Path) -> None:
    # 1 ms of each step, and 25 ms from t = 0.5 s on
    scenario = walker_scenario(tmp_path, pause=1000.0)
    slow = ["events=[{at: 0.5, set: {saving.pause: 25000}}]"]
    outcome = run(scenario, tmp_path / "out", slow)
    timings = json.loads((tmp_path / "out" / "manifest.json").read_text())["timings"]
    assert next(iter(timings["components"])) == "saving"
    assert timings["components"]["saving"]["step"] > 1.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Where the time went" in page
    assert "saving takes" in page
    quiet = run(scenario, tmp_path / "quiet", [*slow, "components.saving.start.pause=0"], report=False, in_process=True)
    assert "components" not in quiet.manifest["timings"]
    assert outcome.file.read_bytes() == quiet.file.read_bytes()


def test_a_resumed_run_that_ends_in_its_replay_has_no_slower_component() -> None:
    times = ComponentTimes(["wheel", "road"], ROWS, float, given=400)
    times.read(10, -1)
    assert times.slower() == []
