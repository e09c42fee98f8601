"""Parameters per log: a value for each group of logs; for a sealed log of a new group the filter estimates it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.logs.log import Log
from cosim.refinement.refinement import Refinement
from cosim.refinement.study import read_study
from cosim.refinement.workflow import refine
from tests.logs import fly, measured, times, write_log
from tests.studies import replayed
from tests.tank import MODEL, tank_log

# Day 1's gauge is off by 50 mm; every other log was made on a day of its own.
OFFSETS = {"e1": 0.05, "e2": 0.05, "e3": -0.04, "e4": 0.10, "v1": 0.05, "v2": -0.09}
LISTED = "model: tank.py:Tank\nlogs:\n  estimation: [e1.csv, e2.csv, e3.csv, e4.csv]\n  validation: [v1.csv, v2.csv]\n"
PER_LOG = "per_log: [gauge_offset]\ngroups: {day1: [e1.csv, e2.csv, v1.csv]}\n"
NAME = "gauge_offset.value"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("days")
    (found / "tank.py").write_text(MODEL, encoding="utf-8")
    for seed, (name, offset) in enumerate(OFFSETS.items()):
        tank_log(found / f"{name}.csv", seed, 100.0, offset=offset, held=20)
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
    cut = log.rows // 2
    later = log.outputs["level"].copy()
    later[cut:] += 0.3
    (_, as_it_was), (_, changed) = read(log), read(replace(log, outputs={"level": later}))
    before = [k for k in as_it_was.starts if k < cut]
    assert len(before) >= 2
    assert [as_it_was.starts[k] for k in before] == [changed.starts[k] for k in before]
    assert as_it_was.outputs["level"][1:cut] == pytest.approx(changed.outputs["level"][1:cut], nan_ok=True)


FAULTY = """model: tank.py:Tank
logs:
  estimation: [e1.csv, e2.csv]
  validation: [v1.csv]
per_log: [gauge_ofset, leak.rate, gauge_offset]
groups:
  day1: [e1.csv, e7.csv]
  day2: [e1.csv]
  v1.csv: [v1.csv]
"""


def refused(study: Path, text: str) -> Any:
    """The faults of a study."""
    study.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_study(study)
    return caught.value.faults


def test_every_fault_of_groups_and_names_is_told_at_once(folder: Path) -> None:
    assert sorted(fault.line for fault in refused(folder / "faulty.yaml", FAULTY)) == [5, 5, 7, 8, 9]


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
