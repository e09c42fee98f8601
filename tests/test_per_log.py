"""Parameters per log: each group of logs has its own value, and a sealed log of no known group learns it as it goes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.core.errors import InputError
from cosim.estimation.per_log import own, spread
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Settings
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.building.file import load_model
from cosim.logs.log import Log, read_log
from cosim.refinement.refinement import Refinement
from cosim.refinement.study import read_study
from cosim.refinement.workflow import refine
from tests.logs import fly, measured, times, write_log
from tests.studies import replayed
from tests.tank import AREA, LEAK, MODEL, NOISE, OUTLET, STEP

# Day 1's gauge is off by 50 mm; every other log was made on a day of its own.
OFFSETS = {"e1": 0.05, "e2": 0.05, "e3": -0.04, "e4": 0.10, "v1": 0.05, "v2": -0.09}
LISTED = "model: tank.py:Tank\nlogs:\n  estimation: [e1.csv, e2.csv, e3.csv, e4.csv]\n  validation: [v1.csv, v2.csv]\n"
PER_LOG = "per_log: [gauge_offset]\ngroups: {day1: [e1.csv, e2.csv, v1.csv]}\n"
NAME = "gauge_offset.value"


def filled(path: Path, seed: int, offset: float, area: float = AREA, seconds: float = 100.0) -> Path:
    """A log of a tank that leaks, filled in steps; its gauge is off."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP) + 1)
    inflow = np.repeat(rng.uniform(0.01, 0.05, time.size // 20 + 1), 20)[: time.size]
    level = [1.0]
    for q in inflow[:-1]:

        def rate(_: float, h: np.ndarray, q: float = q) -> list[float]:
            return [(q - OUTLET * math.sqrt(max(h[0], 1e-6)) - LEAK * h[0]) / area]

        level.append(float(solve_ivp(rate, (0.0, STEP), [level[-1]], rtol=1e-9, atol=1e-12).y[0, -1]))
    read = np.array(level) + offset + NOISE * rng.standard_normal(time.size)
    return write_log(path, {"time": time, "inflow": inflow, "level": read})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("days")
    (found / "tank.py").write_text(MODEL, encoding="utf-8")
    for seed, (name, offset) in enumerate(OFFSETS.items()):
        filled(found / f"{name}.csv", seed, offset)
    (found / "study.yaml").write_text(LISTED + PER_LOG, encoding="utf-8")
    return found


@pytest.fixture(scope="module")
def days(folder: Path) -> Refinement:
    return refine(folder / "study.yaml", folder / "out", report=True)


@pytest.mark.thorough
def test_each_group_gets_its_own_value_and_the_effect_is_named_beside(days: Refinement) -> None:
    found = days.record["per_log"][NAME]
    assert [e["name"] for e in days.record["effects"]] == ["leak"]
    assert found["groups"].keys() == {"day1", "e3.csv", "e4.csv"}
    for group, truth in {"day1": 0.05, "e3.csv": -0.04, "e4.csv": 0.10}.items():
        estimate = found["groups"][group]
        half = estimate["ci95"][1] - estimate["value"]
        assert abs(estimate["value"] - truth) < 1.5 * half < 3e-3  # 1.5: 3 σ, for three at once


@pytest.mark.thorough
def test_a_sealed_log_takes_the_value_of_its_group_or_learns_it_from_what_is_past_alone(
    days: Refinement, tmp_path: Path
) -> None:
    found, horizon = days.record["per_log"][NAME], days.study.subject.horizon
    problem, grouped = days.problem, next(log for log in days.study.unseal() if log.path.name == "v1.csv")
    log = next(log for log in days.study.unseal() if log.path.name == "v2.csv")

    def read(each: Log) -> Any:
        return replayed(days.variants["after"], problem, [each], tmp_path)[horizon][0]

    shown, _ = read(grouped)  # in every row, from the first
    assert grouped.outputs["level"] - shown.outputs["level"] == pytest.approx(found["groups"]["day1"]["value"])
    assert found["followed"].keys() == {"v2.csv"}
    entry, offset = found["followed"]["v2.csv"], OFFSETS["v2"]
    assert 0.1 < abs(entry["expected"] - offset) < 2.0 * entry["spread"]  # so that there is something to learn
    assert entry["value"] == pytest.approx(offset, abs=5e-4)  # 100 s of a gauge of 1 mm
    cut = log.rows // 2
    later = log.outputs["level"].copy()
    later[cut:] += 0.3
    (_, as_it_was), (_, changed) = read(log), read(replace(log, outputs={"level": later}))
    before = [k for k in as_it_was.starts if k < cut]
    assert len(before) >= 2
    assert [as_it_was.starts[k] for k in before] == [changed.starts[k] for k in before]
    assert as_it_was.outputs["level"][1:cut] == pytest.approx(changed.outputs["level"][1:cut], nan_ok=True)


def test_a_known_constant_filters_as_the_parameter_would(folder: Path) -> None:
    """A base parameter of the equations: known, it is the number it was; unknown, the filter finds it."""
    model = load_model("tank.py:Tank", folder).model.with_values({"leak.rate": LEAK})
    path = filled(folder / "narrow.csv", 5, 0.0, area=0.4)
    log = read_log(path, model.inputs, model.outputs)
    plain = build_problem(ModelSubject.of(model), [log])
    settings = Settings(per_log=("area",), groups={path: "narrow"})
    problem = build_problem(ModelSubject.of(model), [log], settings=settings)
    noise = plain.plain
    as_number = plain.score({**plain.values, "area": 0.43}, noise).nll
    known = {**problem.values, own("area", "narrow"): 0.43}
    assert problem.score(known, noise).nll == pytest.approx(as_number, rel=1e-9)
    unknown = {**problem.values, spread("area", "narrow"): 0.2}
    last = problem.run(unknown, noise, 0, states=True).states[-1]
    assert last[problem.layout.constants["area"]] == pytest.approx(0.4, rel=0.02)


FAULTY = """model: tank.py:Tank
logs:
  estimation: [e1.csv, e2.csv]
  validation: [v1.csv]
per_log: [gauge_ofset, leak.rate, gauge_offset, gauge_offset.value, area]
candidates: [gauge_offset, area, leak]
groups:
  day1: [e1.csv, e7.csv]
  day2: [e1.csv]
  day3: []
  v1.csv: [v1.csv]
"""


def refused(study: Path, text: str) -> Any:
    """The faults of a study."""
    study.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_study(study)
    return caught.value.faults


def test_every_fault_of_groups_and_names_is_told_at_once(folder: Path) -> None:
    assert sorted(fault.line for fault in refused(folder / "faulty.yaml", FAULTY)) == [5, 5, 5, 6, 6, 8, 9, 10, 11]


@pytest.mark.parametrize("more", ["groups: {day1: [e1.csv]}\n", "per_log: []\n", "per_log: gauge_offset\n"])
def test_groups_go_with_parameters(folder: Path, more: str) -> None:
    assert refused(folder / "odd.yaml", LISTED + more)[0].line == 5


def test_what_no_filter_learns_wants_a_group(tmp_path: Path) -> None:
    """The delay of a command is no number of the equations: a sealed log of no group would say nothing of it."""
    for seed, name in enumerate(("e1.csv", "v1.csv"), 1):
        write_log(tmp_path / name, measured(fly(times(8.0), seed=seed), noise=1.0))
    (tmp_path / "model.yaml").write_text(
        "model: hovercraft\nparameters:\n  actuator_delay.time: 0.05\n", encoding="utf-8"
    )
    listed = "model: model.yaml\nlogs: {estimation: [e1.csv], validation: [v1.csv]}\nper_log: [actuator_delay.time]\n"
    study = tmp_path / "study.yaml"
    assert "put v1.csv in a group" in str(refused(study, listed)[0])
    study.write_text(listed + "groups: {rig: [e1.csv, v1.csv]}\n", encoding="utf-8")
    assert read_study(study).settings.per_log == ("actuator_delay.time",)
