"""Forces that repeat along a position: where they act in free runs of a machine that was pushed, and their period."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.refinement.search import attribution, periods
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.study import read_study
from cosim.subject.candidates import Candidate, Free
from tests.blind.fmu_build import build
from tests.logs import write_log
from tests.test_refine_fmu_rules import hypothesis

STEP, ROWS, FINE = 0.01, 500, 20
PERIOD, SIZE = 0.9, 0.01  # rad, N·m
NOISE = {"current": 0.01, "angle": 0.02, "speed": 0.3}


def pushed_motor(path: Path) -> Path:
    """Write a log of the blind suite's motor with cogging; an unknown torque moves it by some periods."""
    rng, h = np.random.default_rng(4), STEP / FINE
    voltage = np.repeat(rng.uniform(-1.5, 1.5, ROWS // 50), 50)
    push = np.where((np.arange(ROWS) > 150) & (np.arange(ROWS) < 190), 0.008, 0.0)

    def rates(x: Any, u: float, torque: float) -> Any:
        i, q, w = x
        cogging = SIZE * math.sin(2.0 * math.pi * q / PERIOD)
        return np.array([(u - 1.2 * i - 0.05 * w) / 6e-3, w, (0.05 * i - 1e-4 * w - cogging + torque) / 2e-4])

    x, states = np.zeros(3), []
    for u, torque in zip(voltage, push, strict=True):
        states.append(x)
        for _ in range(FINE):
            half = x + 0.5 * h * rates(x, u, torque)
            x = x + h * rates(half, u, torque)
    readings = np.array(states) + rng.standard_normal((ROWS, 3)) * [*NOISE.values()]
    columns = {"time": STEP * np.arange(ROWS), "voltage": voltage, "load_torque": np.zeros(ROWS)}
    return write_log(path, columns | dict(zip(NOISE, readings.T, strict=True)))


def test_a_force_along_a_position_acts_where_the_filter_sees_the_machine(tmp_path: Path) -> None:
    fmu, log = build(tmp_path / "motor.fmu", "dc_motor", ways=("co_simulation",)), pushed_motor(tmp_path / "e1.csv")
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": {"estimation": [log.name], "validation": []}}))
    study = read_study(path)
    problem = build_problem(study.subject, study.logs, noise=NOISE)
    truth = {"cogging_at_speed.sine": SIZE, "cogging_at_speed.cosine": 0.0, "cogging_at_speed.period": PERIOD}
    plain, right = (problem.score({**problem.values, **values}, problem.plain) for values in ({}, truth))
    assert right.nll < plain.nll - 200.0
    p, start = problem.numbers({**problem.values, **truth}), problem.x0[0]
    run = problem.kernel.simulate(problem.logs[0], p, start, np.zeros(problem.layout.memory))
    away = run.outputs[-1, 1] - problem.logs[0].y[-1, 1]
    assert abs(away) > 0.5 * PERIOD  # a replay knows nothing of the push


@pytest.mark.parametrize("cycles", [37.0, 311.0])
def test_a_period_far_below_the_travel_is_a_line_of_the_innovations(cycles: float) -> None:
    rng, travel = np.random.default_rng(2), 250.0
    positions = [np.cumsum(rng.choice([-1.0, 1.0], 3001).cumsum() * 0.002) % travel for _ in range(2)]
    positions[0][0], positions[1][0] = 0.0, travel
    answers = [
        np.column_stack([0.4 * np.sin(math.pi * cycles * (q[:-1] + q[1:]) / travel + 1.0), np.zeros(3000)])
        + rng.standard_normal((3000, 2))
        for q in positions
    ]
    at_once = np.zeros((periods.LASTING, 2))
    at_once[0, 0] = 1.0
    lines = [*periods._lines(positions, answers, at_once, 1e-3 * travel, 0.5 * travel)]
    assert len(lines) == periods.LINES
    assert min(abs(travel / line - cycles) for line in lines) < 0.5


def test_a_force_that_repeats_within_a_row_tells_nothing_there() -> None:
    """A motor turns by up to 1.2 periods a row; the force shows where it is slow, for a third of the time."""
    rng, rows, cycles, travel = np.random.default_rng(5), 6000, 640.0, 660.0
    speeds = np.repeat(rng.permutation(np.linspace(-1.0, 1.0, rows // 50)), 50)
    position = np.concatenate([[0.0], np.cumsum(1.2 * speeds)])
    position = (position - position.min()) * travel / np.ptp(position)
    fine = np.interp(np.arange(20 * rows) / 20.0, np.arange(rows + 1), position).reshape(rows, 20)
    mean = np.sin(2.0 * math.pi * cycles * fine / travel).mean(axis=1)
    at_once = np.ones((periods.LASTING, 1)) * (np.arange(periods.LASTING)[:, None] == 0)
    answers = [0.35 * mean[:, None] + rng.standard_normal((rows, 1))]
    best = next(periods._lines([position], answers, at_once, 0.3, 0.5 * travel))
    assert abs(travel / best - cycles) < 0.5


def test_a_line_shows_through_slow_answers_of_several_sensors() -> None:
    """A force of 13.5 periods, which the innovations answer over tens of rows, far below their noise in each row."""
    rng, rows, true = np.random.default_rng(7), 1500, 6.0 / 13.5
    position = 3.0 + 3.0 * np.sin(0.011 * np.arange(rows + 1)) * np.cos(0.0037 * np.arange(rows + 1))
    decays = np.exp(-np.arange(rows)[:, None] / np.array([6.0, 15.0])) * [0.2, -0.1]

    def answered(period: float) -> Any:
        force = np.sin(math.pi * (position[:-1] + position[1:]) / period)
        return np.stack([np.convolve(force, decay)[:rows] for decay in decays.T], axis=1)

    probes = [0.05, 0.2, 0.8]
    response = periods._response([position], probes, [[answered(period)] for period in probes])
    np.testing.assert_allclose(response[:20], decays[:20], atol=0.02)
    answers = 0.4 * answered(true) + rng.standard_normal((rows, 2))
    best = next(periods._lines([position], [answers], response, 2e-3, 2.0))
    assert abs(6.0 / best - 13.5) < 0.5


@pytest.mark.parametrize(("amplitude", "varied"), [(0.3, False), (3.0, True)])
def test_a_period_is_varied_only_if_the_term_may_be_fitted(
    monkeypatch: pytest.MonkeyPatch, amplitude: float, varied: bool
) -> None:
    """The truth lies between two usual periods, half a cycle over the travel from one, and no line shows it."""
    q, true, sigma = np.linspace(0.0, 1.0, 2000), 1.0 / 6.5, 1e-3
    monkeypatch.setattr(periods, "_along", lambda test, along: ([q], sigma, [np.zeros((q.size - 1, 1))]))
    monkeypatch.setattr(periods, "_by_row", lambda test, numbers: [numbers[1:, None]])
    names, asked = ("cogging.sine", "cogging.cosine", "cogging.period"), set[float]()
    residual = amplitude * np.sin(2.0 * math.pi * q / true) / math.sqrt(q.size) * 5.0

    def row(steps: Mapping[str, float]) -> Any:
        period = 0.25 + steps[names[2]]
        asked.add(round(1.0 / period, 6))
        angle = 2.0 * math.pi * q / period
        return np.sin(angle) if names[0] in steps else np.cos(angle)

    def gain(rows: Any) -> tuple[float, Any]:
        fitted = np.linalg.lstsq(np.array(rows).T, residual)[0] @ np.array(rows)
        return 0.5 * float(fitted @ fitted), None

    free = (*(Free(n, -2.0, 2.0, 0.05, neutral=0.0) for n in names[:2]), Free(names[2], 5e-4, 0.5, 0.02))
    starts = tuple({names[0]: 0.05, names[2]: 1.0 / cycles} for cycles in (3.0, 6.0, 12.0))
    cogging = Candidate("cogging", "effect", free, starts, repeats=(names[2], "position"))
    test: Any = SimpleNamespace(values={names[2]: 0.25}, row=row, gain=gain)
    (chosen,), found = periods.with_likely_periods(test, [cogging], (), lambda c: 10.0)
    assert (len(asked) > 6) == varied
    assert chosen.among == round(1.0 / (2.0 * math.pi * sigma))  # periods that travel and sensor tell apart
    assert chosen.free[2].low == 2.0 * math.pi * sigma
    assert chosen.starts == ({**starts[0], names[2]: found[names[2]]},)  # the scan has compared the others
    assert (abs(1.0 / found[names[2]] - 6.5) < 0.3) == varied


def test_a_term_that_looks_alike_is_fitted_again_from_the_best_if_it_was_fitted_from_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    latency, lag, scale = (hypothesis({f"{kind}_at_y": (1.0, 0.1)}) for kind in ("latency", "lag", "scale"))
    best = replace(latency, score=-2000.0, ended=True)

    def stuck(other: Hypothesis, score: float, *, ended: bool = False) -> bool:
        search = SimpleNamespace(
            tried={other.names: replace(other, score=score, ended=ended)}, subject=SimpleNamespace(probed=True)
        )
        attributor: Any = SimpleNamespace(search=search)
        attributor._is_twin = lambda one, two: attribution.Attributor._is_twin(attributor, one, two)
        return attribution.Attributor._is_stuck(attributor, other.candidates, best)

    assert stuck(lag, -1000.0)
    assert not stuck(lag, -1999.0)  # near, and refitted anyway
    assert not stuck(lag, -1000.0, ended=True)
    assert not stuck(scale, -1000.0)  # does not look alike


def test_what_was_the_best_is_fitted_again_from_what_replaces_it() -> None:
    latency, lag = (replace(hypothesis({f"{kind}_at_y": (1.0, 0.1)}), score=0.0) for kind in ("latency", "lag"))
    better, begun = replace(lag, score=-20.0), list[tuple[Any, Hypothesis]]()

    def fit_all(trials: Any, start: Hypothesis, *_: Any, **__: Any) -> list[Hypothesis]:
        begun.append(([parts for parts, _ in trials], start))
        return [replace(lag, score=-15.0)]

    subject = SimpleNamespace(probed=True)
    search = SimpleNamespace(subject=subject, tried={}, fit_all=fit_all, fit_again=lambda hypotheses: [better])
    attributor: Any = SimpleNamespace(
        search=search,
        _replacements=lambda best: [(lag.candidates, None)],
        _is_stuck=lambda parts, best: False,
        _continued=lambda best, earlier: [],
    )
    assert attribution.Attributor._with_replacement(attributor, latency) is better
    assert begun[1:] == [([latency.candidates], better)]


def test_the_better_of_two_fits_of_a_set_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    earlier = replace(hypothesis({"lag": (1.0, 0.1)}), score=-10.0)
    search = Search.__new__(Search)
    fitted: Mapping[str, float] = {"worse": -5.0, "better": -20.0}
    for score in fitted.values():
        search.tried = {earlier.names: earlier}
        search.progress = lambda stage, share: None
        monkeypatch.setattr(Search, "cost", lambda self, parts: 0.0)
        monkeypatch.setattr(Search, "hypothesis", lambda self, *a, s=score, **k: replace(earlier, score=s))
        trials = [(earlier.candidates, None)]
        (kept,) = search.fit_all(trials, earlier, "again", 1.0, again=True)
        assert kept.score == min(score, earlier.score)
        assert search.fit_all(trials, earlier, "once", 1.0) == []
